"""Folder captures as the prepare stage imports them."""
