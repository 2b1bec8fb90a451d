"""Import of photographs as a raw folder, with a description made from the names of the files."""
