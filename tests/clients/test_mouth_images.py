"""Cycles shows of a mouth what stock Mitsuba shows of the same media: a tooth with dentin whose root is in gums, a free
tooth, and a wall.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from services.assets.blender.scripts import write_scripts
from services.assets.mitsuba.mouth_scene import write_mouth_surfaces
from services.assets.mitsuba.scene import load_scene
from services.core.files.meshes import write_mesh
from services.core.geometry import Tooth
from services.core.records import Boundary
from services.transport.optics.parameters import MEDIUM_FIELDS, Medium
from services.transport.platform import prepare_device
from tests.support.clients import client_python, run_client
from tests.support.small_mouth import CORE, FREE, IOR, LIGHTS_MM, MOUTH, ROOTED, gums, stock_mouth, wall
from tests.support.small_tooth import INTENSITY, camera_at

CAMERA = camera_at((0.2, 1.0, 0.3), size=16, span_mm=16.0)
SEEDS = (1, 2, 3, 4)
PATHS = 128


def write_asset_of_the_mouth(folder: Path, boundary: Boundary) -> None:
    teeth = (Tooth(11, ROOTED, CORE), Tooth(12, FREE))
    for tooth in teeth:
        write_mesh(folder / f"teeth/{tooth.fdi}/outer.ply", tooth.outer)
    write_mesh(folder / "teeth/11/dentin.ply", CORE)
    write_mesh(folder / "cavity.ply", wall())
    write_mouth_surfaces(folder / "surfaces", teeth, gums(), wall())

    def table(prefix: str, medium: Medium) -> dict[str, dict[str, float]]:
        return {f"{prefix}.{name}": {"value": getattr(medium, name)} for name in MEDIUM_FIELDS}

    rooted, free = MOUTH.teeth
    assert MOUTH.gums is not None
    assert MOUTH.reflectance is not None
    numbers = table("11.enamel", rooted.enamel) | table("11.dentin", rooted.dentin) | table("12.enamel", free.enamel)
    numbers |= table("gums", MOUTH.gums) | {"cavity.reflectance": {"value": MOUTH.reflectance}}
    rig = {
        "boundary": boundary,
        "ior": IOR,
        "channels": ["green"],
        "cameras": ["c0"],
        "views": {"c0": CAMERA.model_dump(exclude={"name"})},
        "lights": {"l0": {"position_mm": LIGHTS_MM[0].tolist(), "intensity": [INTENSITY]}},
    }
    (folder / "rig.json").write_text(json.dumps(rig))
    (folder / "parameters.json").write_text(json.dumps({"green": numbers}))
    write_scripts(folder)


@pytest.mark.parametrize("boundary", ["matched", "thin"])
def test_a_mouth_looks_alike(boundary: Boundary, tmp_path: Path) -> None:
    client_python("bpy")
    prepare_device()
    import mitsuba as mi

    from services.assets.mitsuba.shipped import thin_boundary

    write_asset_of_the_mouth(tmp_path, boundary)
    thin_boundary.register()
    scene = load_scene(stock_mouth(tmp_path / "stock", CAMERA, 0, boundary, PATHS))
    images = []
    for seed in SEEDS:
        picture = tmp_path / f"{seed}.exr"
        script = tmp_path / "blender" / "blender_scene.py"
        words = ("--render", picture, "--scale", "1", "--flat", "--samples", str(PATHS), "--seed", str(seed))
        done = run_client("bpy", script, *words)
        assert done.returncode == 0, done.stderr
        ours = np.array(mi.Bitmap(str(picture)), dtype=np.float64)[..., 0]
        theirs = np.array(mi.render(scene, spp=PATHS, seed=seed), dtype=np.float64)[..., 0]
        images.append((ours, theirs))
    ours, theirs = np.array(images).transpose(1, 0, 2, 3)
    # Bands of the picture show the teeth, the gums and the wall in different shares.
    for rows in np.array_split(np.arange(CAMERA.size[1]), 4):
        means = [each[:, rows].mean(axis=(1, 2)) for each in (ours, theirs)]
        se = np.hypot(*(mean.std(ddof=1) / 2 / mean.mean() for mean in means))
        assert se < 0.02
        assert abs(means[0].mean() / means[1].mean() - 1) < 0.01 + 4 * se
