"""A scene that no rig has is refused in a sentence before it is rendered: what stands inside what."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.assets.mitsuba.scene import load_scene, nested_scene
from services.core.files.meshes import write_mesh
from services.core.geometry import Mesh
from tests.physics.test_integrator import CAMERA, CORE, LAMP, OUTER, TISSUE, properties, sentence, write_tooth
from tests.support.small_tooth import INTENSITY, LIGHTS_MM, SEMI_AXES_MM, camera_at

SceneDict = dict[str, Any]


@pytest.fixture(scope="module")
def tooth(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the small tooth's surfaces, and with dentin that leaves it; the plug-in is registered."""
    folder = write_tooth(tmp_path_factory.mktemp("tooth"))
    write_mesh(folder / "beside.ply", Mesh(CORE.vertices_mm + np.array([1.2 * SEMI_AXES_MM[0], 0, 0]), CORE.faces))
    write_mesh(folder / "larger.ply", Mesh(1.05 * OUTER.vertices_mm, OUTER.faces))
    return folder


def picture(
    folder: Path, dentin: str = "dentin.ply", camera: Any = CAMERA, light: Any = LIGHTS_MM[0], **shapes: Any
) -> Any:
    """Render a scene with one sample a pixel."""
    import mitsuba as mi

    described = nested_scene({"11": (folder / "outer.ply", folder / dentin)}, TISSUE, (camera,), light, INTENSITY)
    scene = load_scene(described | shapes)
    return np.array(mi.render(scene, integrator=mi.load_dict(properties()), spp=1))


def inside_lamp() -> SceneDict:
    place = 0.2 * np.eye(4)
    place[3, 3] = 1
    return {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": 1.0}}


def sky(value: float) -> SceneDict:
    import mitsuba as mi

    pixels = np.ones((8, 16, 1), dtype=np.float32)
    pixels[2, 3] = value
    return {"type": "envmap", "bitmap": mi.Bitmap(np.repeat(pixels, 3, axis=2))}


IMPOSSIBLE: dict[str, tuple[Any, str]] = {
    "camera inside": (
        lambda folder: picture(folder, camera=camera_at((0.0, 1.0, 0.0), size=8, span_mm=9.0, distance_mm=0.5)),
        "camera stands inside a tooth",
    ),
    "dentin beside enamel": (lambda folder: picture(folder, dentin="beside.ply"), "Dentin 'dentin_11' lies outside"),
    "dentin around enamel": (lambda folder: picture(folder, dentin="larger.ply"), "Dentin 'dentin_11' lies outside"),
    "a point of light inside": (lambda folder: picture(folder, light=(0.1, 0.1, 0.1)), "stands inside a tooth"),
    "a lamp inside": (lambda folder: picture(folder, lamp=inside_lamp()), "Light 'lamp' .* stands inside a tooth"),
    "a sky with NaN": (lambda folder: picture(folder, sky=sky(float("nan"))), "no finite number"),
    "a sky with infinity": (lambda folder: picture(folder, sky=sky(float("inf"))), "no finite number"),
}


@pytest.mark.parametrize("case", IMPOSSIBLE)
def test_an_impossible_scene_is_refused(case: str, tooth: Path) -> None:
    make, words = IMPOSSIBLE[case]
    with pytest.raises(RuntimeError) as refused:
        make(tooth)
    assert re.search(words, sentence(refused.value))


def test_possible_scenes_are_rendered(tooth: Path) -> None:
    image = picture(tooth, lamp=LAMP, sky=sky(2.0))
    assert np.isfinite(image).all()
    assert image.max() > 0
