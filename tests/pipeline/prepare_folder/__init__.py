"""Import of folder captures by the prepare stage."""
