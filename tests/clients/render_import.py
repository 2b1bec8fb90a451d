"""Program for Blender's Python: render an imported USD or glTF file as the asset's script renders its own scene.

python render_import.py asset.usda FOLDER-OF-THE-ASSET-FOR-BLENDER picture.exr LIGHT SKY SAMPLES SEED

The highlight is left out, as a fit with the matched boundary has none.
"""

from __future__ import annotations

import json
import runpy
import sys
from pathlib import Path

import bpy
import numpy as np

METRES_PER_MM = 0.001


def main() -> None:
    """Render one picture at the size of the photograph, its tooth shaded flat like the one that it is compared with."""
    path, asset, picture, light, sky, samples, seed = sys.argv[1:]
    sys.argv = sys.argv[:1]
    script = runpy.run_path(str(Path(asset) / "blender" / "blender_scene.py"))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    if path.endswith(".usda"):
        bpy.ops.wm.usd_import(filepath=path)
    else:
        bpy.ops.import_scene.gltf(filepath=path)
    scene = bpy.context.scene
    for material in bpy.data.materials:
        for node in material.node_tree.nodes:
            if node.bl_idname == "ShaderNodeBsdfPrincipled":
                node.inputs["Specular IOR Level"].default_value = 0.0
    for mesh in bpy.data.meshes:
        mesh.polygons.foreach_set("use_smooth", np.zeros(len(mesh.polygons), dtype=bool))
    rig = json.loads((Path(asset) / "rig.json").read_text())
    (name,) = rig["cameras"]
    script["add_camera"](scene, name, rig["views"][name], METRES_PER_MM)
    scene.camera = scene.objects[name]
    if light != "none":
        lamp = rig["lights"][light]
        script["add_lamp"](scene, light, lamp["position_mm"], np.array(lamp["intensity"]), METRES_PER_MM)
    script["set_world"](scene, float(sky), None)
    script["set_up_cycles"](scene, int(samples), int(seed))
    scene.render.resolution_x, scene.render.resolution_y = rig["views"][name]["size"]
    script["render_scene"](scene, Path(picture))


main()
