"""The gallery's tooth with a rough dielectric surface, by stock Mitsuba."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from services.bench.figures import gallery
from services.bench.figures.gallery import ROUGHNESS, VIEWS, gallery_scene, main
from services.bench.figures.refracting import refracting_picture
from services.core.files.meshes import write_mesh
from services.transport.optics.parameters import Medium, Tissue
from tests.support.mitsuba_variants import variant
from tests.support.prepared import sphere

SIZE = (16, 20)


def shown(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image).astype(float)


@pytest.mark.dear("paths of hundreds of scattering events in stock Mitsuba")
def test_a_white_tooth_in_a_white_room_is_white(tmp_path: Path) -> None:
    write_mesh(tmp_path / "outer.ply", sphere(5.0))
    write_mesh(tmp_path / "dentin.ply", sphere(3.0))
    white = Tissue(Medium(1.0, 1.0, g1=0.2), Medium(2.0, 1.0, g1=0.2))
    with variant("llvm_ad_rgb"):
        scene: dict[str, Any] = gallery_scene(VIEWS["front"], tmp_path, None, SIZE)
        del scene["lamp"], scene["table"]
        scene["sky"] = {"type": "constant", "radiance": 1.0}
        image = refracting_picture(scene, (white, white, white), ROUGHNESS, 32)
    # The scene's compensation is 1.4 % too bright for light out of a ball at a roughness of 0.15. Some 120 pixels of
    # 96 paths, whose weights scatter by a tenth, add 0.1 %.
    middle = image[7:13, 5:11]
    assert middle.mean() == pytest.approx(1.0, abs=0.03)
    np.testing.assert_allclose(image[:2], 1.0, atol=1e-4)


@pytest.mark.dear("paths of hundreds of scattering events in stock Mitsuba")
def test_the_gallery_shows_both_surfaces_beside_each_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gallery, "COLUMNS", 24)
    arguments = ["--out", str(tmp_path), "--views", "front", "--size", *map(str, SIZE), "--samples", "256"]
    with variant("llvm_ad_rgb"):
        assert main(arguments) == 0
    thin, rough, both = (shown(tmp_path / f"{name}.png") for name in ("front", "front-rough", "gallery"))
    assert thin.shape == rough.shape == (*SIZE[::-1], 3)
    assert both.shape[0] > 2 * SIZE[1]
    # The same media are darker behind a surface that sends light back inside, and everything else is as bright.
    tooth, table = (slice(8, 13), slice(6, 10)), (slice(0, 3), slice(0, 16))
    assert rough[tooth].mean() < 0.97 * thin[tooth].mean()
    assert rough[table].mean() == pytest.approx(thin[table].mean(), rel=0.05)
