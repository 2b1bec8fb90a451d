"""The shape of teeth: procedural incisor, dentin blend modes."""
