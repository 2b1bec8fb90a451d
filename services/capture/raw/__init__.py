"""Raw folders as captures: a description made from the names of the files."""
