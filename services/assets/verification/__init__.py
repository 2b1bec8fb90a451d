"""Checks of an asset's files by the validators and programs of others that are installed."""
