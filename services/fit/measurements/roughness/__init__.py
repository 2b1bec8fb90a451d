"""The roughness of a surface, measured by the highlights of photographs."""
