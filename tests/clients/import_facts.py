"""Program for Blender's Python: import a USD or glTF file and print facts of its objects.

python import_facts.py asset.usda
"""

from __future__ import annotations

import json
import sys
from typing import Any

import bpy
import numpy as np


def plain(value: Any) -> Any:
    """A custom property as JSON holds it."""
    if hasattr(value, "to_dict"):
        return value.to_dict()
    return value.to_list() if hasattr(value, "to_list") else value


def properties(thing: Any) -> dict[str, Any]:
    """Custom properties of an object or material."""
    return {name: plain(thing[name]) for name in thing.keys() if name != "cycles"}  # noqa: SIM118


def values(of: Any, name: str, columns: int) -> np.ndarray:
    """An attribute of all elements, (N, columns)."""
    found = np.zeros(len(of) * columns, dtype=np.float32)
    of.foreach_get(name, found)
    return found.reshape(-1, columns)


def inputs_of(material: Any) -> dict[str, Any]:
    """What the first surface shader is told; the name of a picture where one is connected."""
    shader = next(node for node in material.node_tree.nodes if node.bl_idname == "ShaderNodeBsdfPrincipled")
    told: dict[str, Any] = {}
    for one in shader.inputs:
        if one.is_linked:
            node = one.links[0].from_node
            told[one.name] = getattr(getattr(node, "image", None), "name", node.bl_idname)
        elif hasattr(one, "default_value"):
            value = one.default_value
            told[one.name] = list(value) if hasattr(value, "__len__") and not isinstance(value, str) else value
    return told


def mesh_facts(thing: Any) -> dict[str, Any]:
    """Size, texture coordinates, normals and material of an object."""
    mesh = thing.data
    where = np.array(thing.matrix_world)
    points = values(mesh.vertices, "co", 3) @ where[:3, :3].T + where[:3, 3]
    linear = where[:3, :3] / np.cbrt(np.linalg.det(where[:3, :3]))
    (layer,) = mesh.uv_layers
    uv, corner = values(layer.data, "uv", 2), np.zeros(len(mesh.loops), dtype=np.int32)
    mesh.loops.foreach_get("vertex_index", corner)
    return {
        "metres": (points * bpy.context.scene.unit_settings.scale_length).tolist(),
        "corner_normals": (values(mesh.corner_normals, "vector", 3) @ linear.T).tolist(),
        "corner_uv": uv.tolist(),
        "corner_vertex": corner.tolist(),
        "smooth": all(face.use_smooth for face in mesh.polygons),
        "material": mesh.materials[0].name,
        "inputs": inputs_of(mesh.materials[0]),
        "properties": properties(thing) | properties(mesh),
        "material_properties": properties(mesh.materials[0]),
    }


def main() -> None:
    """Print one line of JSON, the last of the output."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    path = sys.argv[1]
    if path.endswith(".usda"):
        bpy.ops.wm.usd_import(filepath=path)
    else:
        bpy.ops.import_scene.gltf(filepath=path)
    print(
        json.dumps(
            {
                "meshes": {one.name: mesh_facts(one) for one in bpy.data.objects if one.type == "MESH"},
                "scene": properties(bpy.context.scene),
                "images": {one.name: list(one.size) for one in bpy.data.images if one.size[0]},
                "pixels": {one.name: float(np.mean(one.pixels[:])) for one in bpy.data.images if one.size[0]},
            }
        )
    )


main()
