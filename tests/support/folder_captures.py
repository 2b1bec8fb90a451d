"""A small folder capture that preparation accepts, for tests to alter."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from services.core.files.meshes import write_mesh
from services.core.geometry import Mesh
from services.core.records import JobSpec
from services.core.results import PreparedManifest
from services.core.stage import LocalContext
from services.preprocess.stage import run

Tree = dict[str, Any]


def write_folder(root: Path) -> Tree:
    """Write a minimal capture: a ball, two cameras of different image size, two lights, two channels. Returns the
    contents of its ``capture.json``.
    """
    ball = trimesh.creation.icosphere(subdivisions=3, radius=4)
    write_mesh(
        root / "teeth" / "11" / "outer.ply", Mesh(np.asarray(ball.vertices), np.asarray(ball.faces, dtype=np.int32))
    )
    tree: Tree = {"units": "mm", "channels": ["green", "blue"], "cameras": [], "lights": [], "images": []}
    for name, size in (("front", (20, 16)), ("side", (24, 18))):
        K = [[1500, 0, size[0] / 2], [0, 1500, size[1] / 2], [0, 0, 1]]
        pose = np.eye(4)
        pose[2, 3] = 1000
        tree["cameras"].append({"name": name, "size": size, "K": K, "camera_from_world": pose.tolist()})
    for k, name in enumerate(("left", "right")):
        tree["lights"].append({"name": name, "position_mm": [(-900, 900)[k], 0, -400], "intensity": [1e6, 1e6]})
    rng = np.random.default_rng(3)
    for camera in tree["cameras"]:
        for light in tree["lights"]:
            file = f"{camera['name']}_{light['name']}.npy"
            width, height = camera["size"]
            np.save(root / file, rng.uniform(0.5, 1, (height, width, 2)).astype(np.float32))
            tree["images"].append({"camera": camera["name"], "light": light["name"], "file": file})
    write_tree(root, tree)
    return tree


def write_tree(root: Path, tree: Tree) -> None:
    (root / "capture.json").write_text(json.dumps(tree))


def prepare(folder: Path, root: Path, **options: Any) -> PreparedManifest:
    return run(JobSpec(capture=folder, **options), LocalContext(root))


def rename_camera(tree: Tree, name: str) -> None:
    for image in tree["images"]:
        image["camera"] = name if image["camera"] == tree["cameras"][0]["name"] else image["camera"]
    tree["cameras"][0]["name"] = name
