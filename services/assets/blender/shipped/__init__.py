"""Files that are copied into the asset unchanged.

They import nothing of this project: they run wherever the asset and Blender are.
"""
