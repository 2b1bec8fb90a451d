"""Writes a folder from which Blender 5 builds the measured scene, with its media: surfaces, numbers and scripts."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np

from services.assets.blender.scripts import write_scripts
from services.assets.content import AssetContent
from services.core.errors import CorruptStoreError, InputError
from services.core.files.meshes import write_mapped_mesh
from services.core.geometry import OBJECT, Mesh, teeth_folder

KEPT = ("*.json", "*.ply", "teeth/**/*", "object/*", "surfaces/*")
"""Files of an asset that the scripts read; manifests and scenes of other programs stay behind."""
LEFT_OUT = ("asset.json", "manifest.json")


class BlenderExporter:
    """Exporter to Blender: its script runs in Blender, or as ``python blender/blender_scene.py --save tooth.blend``."""

    def check(self) -> None:
        """Nothing is needed: the scripts run where Blender is."""

    def write(self, content: AssetContent, folder: Path) -> None:
        """Copy surfaces and numbers of the asset, put the textures' coordinates into the outer surfaces, and write the
        scripts beside them.

        Raises:
            CorruptStoreError: the asset is of an earlier version, whose rig.json says nothing of cameras.
            InputError: it is of a slab.
        """
        if not any(part.tissue in {"enamel", "body"} for part in content.parts):
            raise InputError("The script for Blender builds teeth and objects; export a slab with --to usd or gltf.")
        rig = content.folder / "rig.json"
        if not rig.is_file() or "views" not in json.loads(rig.read_text(encoding="utf-8")):
            raise CorruptStoreError(
                f"{rig} is of an earlier version and describes no cameras; write the asset again with dentine export,"
                " without --to."
            )
        for pattern in KEPT:
            for source in sorted(content.folder.glob(pattern)):
                target = folder / source.relative_to(content.folder)
                if source.is_file() and source.name not in LEFT_OUT:
                    target.parent.mkdir(parents=True, exist_ok=True)
                    shutil.copyfile(source, target)
        for part in content.parts:
            if part.tissue in {"enamel", "body"}:
                outer = teeth_folder(folder, OBJECT if part.fdi is None else part.fdi) / "outer.ply"
                write_mapped_mesh(
                    outer, Mesh(part.mesh.vertices_mm, part.mesh.faces.astype(np.int32)), part.mesh.corners_uv
                )
        write_scripts(folder)
