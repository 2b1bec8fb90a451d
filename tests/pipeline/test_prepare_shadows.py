"""The mask bit for shadows in a prepared store, for jobs that request it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import zarr
from numpy.typing import NDArray

from services.core.files.meshes import write_mesh
from services.core.records import MaskBit
from services.preprocess.masking.valid import valid_bits
from services.preprocess.quality.images import QualityReport
from services.preprocess.tasks import blocks
from services.preprocess.tasks.attempt_files import AttemptFiles
from services.preprocess.tasks.blocks import PreparationBlock
from services.preprocess.views.direct_light import expected_irradiance
from services.preprocess.views.projection import project
from services.preprocess.views.source import Bits
from tests.support.folder_captures import prepare
from tests.support.shadowed_ball import BALL_MM, albedo, ball, before_ball, behind_ball, camera, lights_mm

CAMERA = camera(0.125)
"""Camera with pixels half as large as those at which shadows are searched."""
SHADED, RADIUS_MM = 3, 2.5
"""Index of a light with a ball in front of it that is in no file of the capture, and the ball's radius."""


def write_capture(root: Path, lights: int) -> NDArray[np.bool_]:
    """Write a folder capture of a ball; returns the mask of the pixels in the shadow."""
    write_mesh(root / "teeth" / "11" / "outer.ply", ball(BALL_MM))
    view, rng = project(CAMERA, [ball(BALL_MM)]), np.random.default_rng(5)
    points = view.points_mm(CAMERA, slice(None))
    tree: dict[str, Any] = {
        "units": "mm",
        "channels": ["green"],
        "cameras": [CAMERA.model_dump()],
        "lights": [],
        "images": [],
    }
    for k, place in enumerate(lights_mm(lights)):
        irradiance = 1e6 * expected_irradiance(points, view.normal, tuple(place.tolist()), None)
        shadow = behind_ball(points.astype(np.float64), place, before_ball(lights_mm(lights)[SHADED], 9.0), RADIUS_MM)
        image = np.where(view.covered & ~shadow, albedo(points.astype(np.float64)) * irradiance, 0)
        image += (0.02 * image + 0.002) * rng.standard_normal(image.shape)
        np.save(root / f"{k}.npy", image[..., None].astype(np.float32))
        tree["lights"].append({"name": f"l{k}", "position_mm": place.tolist(), "intensity": [1e6]})
        tree["images"].append({"camera": "front", "light": f"l{k}", "file": f"{k}.npy", "held_out": k == 0})
        if k == SHADED:
            lit = view.covered & (irradiance > 0.15)
            of_light = shadow & lit
    (root / "capture.json").write_text(json.dumps(tree))
    return np.asarray(of_light)


def shadows(root: Path) -> NDArray[np.bool_]:
    valid = np.asarray(zarr.open_array(root / "prepared" / "prepared.zarr" / "valid", mode="r")[0])
    return valid & np.uint16(MaskBit.SHADOW) > 0


@pytest.fixture(scope="module")
def asked(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, NDArray[np.bool_]]:
    """Folder with a capture of eight lights and a job ``asked`` that asked for its shadows, and the true shadow."""
    root = tmp_path_factory.mktemp("shadows")
    (root / "capture").mkdir()
    shadow = write_capture(root / "capture", lights=8)
    prepare(root / "capture", root / "asked", shadows=True)
    return root, shadow


def test_shadows_are_flagged_where_a_job_asks(asked: tuple[Path, NDArray[np.bool_]], tmp_path: Path) -> None:
    root, shadow = asked
    prepare(root / "capture", tmp_path / "plain")
    assert not shadows(tmp_path / "plain").any()
    flagged = shadows(root / "asked")
    assert shadow.sum() > 500
    assert flagged[SHADED][shadow].mean() > 0.9
    others = np.delete(flagged, SHADED, axis=0)
    outside = zarr.open_array(root / "asked" / "prepared" / "prepared.zarr" / "valid", mode="r")[0, 0]
    assert others[:, np.asarray(outside) & np.uint16(MaskBit.OUTSIDE) == 0].mean() < 0.03
    sure = np.asarray(zarr.open_array(root / "asked" / "prepared" / "prepared.zarr" / "shadow", mode="r")[0])
    assert (sure[flagged] >= 50).all()
    report = QualityReport.model_validate_json((root / "asked" / "prepared" / "quality.json").read_text())
    shares = {image.light: image.masked.get("shadow", 0.0) for image in report.images}
    assert max(shares, key=lambda light: shares[light]) == f"l{SHADED}"


def test_shading_that_was_cut_off_is_done_again_on_another_worker(
    asked: tuple[Path, NDArray[np.bool_]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Dask runs a block again if its worker died between writing an image's flags and writing their record."""
    root, _ = asked
    kept = PreparationBlock.__call__

    def twice(block: PreparationBlock) -> None:
        if block.step == "shade":
            with monkeypatch.context() as patch:
                patch.setattr(AttemptFiles, "files_of", Mock(side_effect=KeyboardInterrupt))
                with pytest.raises(KeyboardInterrupt):
                    kept(block)
            assert [k for k in range(8) if block.files.image(0, k) is None]
        kept(block)

    monkeypatch.setattr(PreparationBlock, "__call__", twice)
    prepare(root / "capture", tmp_path / "cut_off", shadows=True)
    assert shadows(root / "asked").any()
    for path in (root / "asked" / "prepared").rglob("*"):
        if path.is_file() and path.name != "manifest.json":
            assert (tmp_path / "cut_off" / path.relative_to(root / "asked")).read_bytes() == path.read_bytes()


def test_a_shadow_is_found_among_pixels_that_are_masked_as_highlights(
    asked: tuple[Path, NDArray[np.bool_]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A highlight adds light, so what is dark in spite of it is shadowed."""
    root, shadow = asked
    kept = valid_bits

    def all_highlights(*args: Any) -> Bits:
        of_light = args[3].name == f"l{SHADED}"
        return kept(*args) | np.uint16(MaskBit.HIGHLIGHT if of_light else 0)

    monkeypatch.setattr(blocks, "valid_bits", all_highlights)
    prepare(root / "capture", tmp_path / "asked", shadows=True)
    flagged = shadows(tmp_path / "asked")[SHADED]
    assert flagged[shadow].mean() > 0.9
    assert flagged[~shadow].mean() < 0.03


def test_few_lights_tell_of_no_shadow(tmp_path: Path) -> None:
    (tmp_path / "capture").mkdir()
    write_capture(tmp_path / "capture", lights=5)
    prepare(tmp_path / "capture", tmp_path / "asked", shadows=True)
    assert not shadows(tmp_path / "asked").any()
