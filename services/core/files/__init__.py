"""Reading and writing what is kept in files: meshes, image headers, folders, private files."""
