"""The cell: interfaces, cameras and lights, and light in the medium, as pure functions of the material."""
