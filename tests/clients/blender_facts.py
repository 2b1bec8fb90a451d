"""Program for Blender's Python: open a .blend file, or run the script as Blender's text editor does; print facts.

python blender_facts.py tooth.blend
python blender_facts.py --text blender_scene.py [-- options of the script]
"""

from __future__ import annotations

import json
import sys
from typing import Any

import bpy
import numpy as np


def node_facts(material: Any) -> dict[str, Any]:
    """Numbers of the volume nodes, and the kinds of all nodes."""
    kinds = sorted(node.bl_idname for node in material.node_tree.nodes)
    volumes = [node for node in material.node_tree.nodes if node.bl_idname == "ShaderNodeVolumeCoefficients"]
    coefficients = [
        {
            "absorption": list(node.inputs["Absorption Coefficients"].default_value),
            "scattering": list(node.inputs["Scatter Coefficients"].default_value),
            "g": node.inputs["Anisotropy"].default_value,
        }
        for node in volumes
    ]
    return {"kinds": kinds, "volumes": coefficients}


def uv_range(mesh: Any) -> list[list[float]]:
    """Least and greatest u and v of the first layer."""
    if not mesh.uv_layers:
        return []
    uv = np.zeros(2 * len(mesh.loops), dtype=np.float32)
    mesh.uv_layers[0].data.foreach_get("uv", uv)
    pairs = uv.reshape(-1, 2)
    return [pairs.min(axis=0).tolist(), pairs.max(axis=0).tolist()]


def mesh_facts(thing: Any) -> dict[str, Any]:
    """Size, volume and what the faces carry."""
    mesh = thing.data
    places = np.zeros(3 * len(mesh.vertices))
    mesh.vertices.foreach_get("co", places)
    corners = np.zeros(3 * len(mesh.polygons), dtype=np.int32)
    mesh.polygons.foreach_get("vertices", corners)
    a, b, c = places.reshape(-1, 3)[corners.reshape(-1, 3)].transpose(1, 0, 2)
    return {
        "dimensions": list(thing.dimensions),
        "volume": float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6),
        "faces": len(mesh.polygons),
        "uv_layers": [layer.name for layer in mesh.uv_layers],
        "uv_range": uv_range(mesh),
        "attributes": sorted(one.name for one in mesh.attributes if not one.name.startswith(".")),
        "smooth": all(face.use_smooth for face in mesh.polygons),
        "material": node_facts(mesh.materials[0]),
        "sigma_per_mm": list(thing.get("sigma_per_mm", [])),
    }


def scene_facts(scene: Any) -> dict[str, Any]:
    """What a test asks about a scene."""
    cycles = scene.cycles
    lamps = {thing.name: thing for thing in scene.objects if thing.type == "LIGHT"}
    return {
        "meshes": {thing.name: mesh_facts(thing) for thing in scene.objects if thing.type == "MESH"},
        "lamps": {
            name: {
                "energy": lamp.data.energy,
                "color": list(lamp.data.color),
                "radius": lamp.data.shadow_soft_size,
                "soft": lamp.data.use_soft_falloff,
                "hidden": lamp.hide_render,
                "location": list(lamp.location),
            }
            for name, lamp in lamps.items()
        },
        "cameras": sorted(thing.name for thing in scene.objects if thing.type == "CAMERA"),
        "camera": scene.camera.name,
        "size": [scene.render.resolution_x, scene.render.resolution_y],
        "unit": [scene.unit_settings.system, scene.unit_settings.scale_length],
        "engine": scene.render.engine,
        "bounces": {
            name: getattr(cycles, name)
            for name in ("max_bounces", "volume_bounces", "glossy_bounces", "transparent_max_bounces")
        },
        "clamps": [cycles.sample_clamp_direct, cycles.sample_clamp_indirect, cycles.blur_glossy],
        "threshold": cycles.light_sampling_threshold,
        "changed_pixels": [cycles.use_denoising, cycles.use_adaptive_sampling],
        "filter": cycles.pixel_filter_type,
        "world": scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value,
    }


def main() -> None:
    """Print one line of JSON, the last of the output."""
    if sys.argv[1] == "--text":
        text = bpy.data.texts.load(sys.argv[2])
        for _ in range(2):  # a second run replaces the scene of the first
            with bpy.context.temp_override(edit_text=text):
                bpy.ops.text.run_script()
    else:
        bpy.ops.wm.open_mainfile(filepath=sys.argv[1])
    scenes = {scene.name: scene_facts(scene) for scene in bpy.data.scenes if scene.name.startswith("teeth")}
    texts = {text.name: text.as_string() for text in bpy.data.texts if text.name.startswith("notes")}
    print(
        json.dumps(
            {
                "scenes": scenes,
                "others": [scene.name for scene in bpy.data.scenes if scene.name not in scenes],
                "texts": texts,
                "images": [[image.name, bool(image.packed_file)] for image in bpy.data.images if image.size[0]],
            }
        )
    )


main()
