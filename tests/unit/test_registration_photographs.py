"""Clicks are at the right place in the photographs, also where these were reduced or come from a mosaic."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from services.calibrate.registration import photographs as module
from services.calibrate.registration.photographs import clicks_of, photographs
from services.core.calibration.cameras_and_lights import CalibratedCamera, CalibratedLight
from services.core.calibration.record import Calibration
from services.core.raw.folder import read_raw_folder
from tests.support.raw_folders import write_toml

SIZE = (96, 64)
SPOT_PX = (61.3, 23.8)


def write_spot(root: Path, mosaic: str) -> Calibration:
    """One camera whose photograph is dark except for a round spot, on which a landmark was clicked."""
    y, x = np.mgrid[0 : SIZE[1], 0 : SIZE[0]] + 0.5
    spot = 64 + 3000 * np.exp(-((x - SPOT_PX[0]) ** 2 + (y - SPOT_PX[1]) ** 2) / (2 * 4.0**2))
    counts = spot if mosaic != "none" else np.repeat(spot[..., None], 3, axis=2)
    np.save(root / "all.npy", counts.round().astype(np.uint16))
    camera = {"name": "c0", "size": list(SIZE), "bits": 12, "mosaic": mosaic}
    seen = {
        "tooth": 11,
        "point": "edge",
        "xyz_mm": [0.0, 0.0, 0.0],
        "pixels": [{"camera": "c0", "xy_px": list(SPOT_PX)}],
    }
    frame = {"camera": "c0", "file": "all.npy", "kind": "tracking", "exposure_s": 1.0}
    write_toml(root, {"units": "mm", "camera": [camera], "frame": [frame], "landmark": [seen]})
    pose = ((1.0, 0, 0, 0), (0, 1.0, 0, 0), (0, 0, 1.0, 500.0), (0, 0, 0, 1.0))
    known = CalibratedCamera(
        name="c0",
        size=SIZE,
        K=((900.0, 0, 47.0), (0, 900.0, 33.0), (0, 0, 1.0)),
        camera_from_world=pose,
        black_counts=64.0,
        distortion=(-0.8, 0.0, 0.0, 0.0),
    )
    light = CalibratedLight(name="L0", position_mm=(0.0, 0.0, 900.0), intensity=(1.0, 1.0, 1.0))
    return Calibration(units="mm", channels=("red", "green", "blue"), cameras=(known,), lights=(light,))


@pytest.mark.parametrize(
    ("mosaic", "widest"), [("none", 2400), ("none", 48), ("RGGB", 2400), ("GBRG", 48), ("BGGR", 40)]
)
def test_a_click_is_where_its_photograph_shows_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mosaic: str, widest: int
) -> None:
    monkeypatch.setattr(module, "WIDEST_PX", widest)
    calibration = write_spot(tmp_path, mosaic)
    folder = read_raw_folder(tmp_path)
    views = photographs(tmp_path, folder, calibration)
    (click,) = clicks_of(folder, calibration, views)
    image = views["c0"].image.mean(axis=2)
    assert image.shape[1] == min(widest, SIZE[0])
    y, x = np.mgrid[0 : image.shape[0], 0 : image.shape[1]] + 0.5
    weight = np.where(image > 0.02 * image.max(), image, 0)
    seen = np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()
    # The colours of a mosaic are up to half a pixel apart, which the mean halves; a pixel cut off at 2 % adds
    # hundredths.
    np.testing.assert_allclose(click.pixel, seen, atol=0.1)
    (one,) = (camera for camera in calibration.cameras)
    assert views["c0"].camera.K[0][0] == pytest.approx(one.K[0][0] * image.shape[1] / SIZE[0])
