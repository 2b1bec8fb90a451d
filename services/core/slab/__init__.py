"""What all rooms know of a material in a cell: its folder and the names of its dictionaries."""
