"""Pixels that are full below the largest count of their bits are found, masked and said."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, cast

import cv2
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from services.core.calibration.cameras_and_lights import CalibratedCamera
from services.core.geometry import Camera, Light
from services.core.raw.folder import read_raw_folder
from services.core.raw.fullness import Fullness, piled_up
from services.core.records import FolderCapture, ImageEntry, MaskBit
from services.preprocess.captures.folder import FolderSource
from services.preprocess.raw.camera import CameraFrames
from services.preprocess.views.window import Window
from tests.support.dng_files import write_dng
from tests.support.raw_folders import Tree, write_toml
from tests.support.raw_sensor import Sensor

if TYPE_CHECKING:
    from services.preprocess.views.source import View

SIZE = (96, 64)
SENSOR = Sensor(bits=12, black=64, counts_per_electron=0.5)


def radiance(seed: int = 0) -> NDArray[np.float64]:
    """A bright patch that fades to black, (64, 96, 3); red is half as bright."""
    y, x = np.mgrid[0:64, 0:96]
    blob = np.exp(-((x - 48) ** 2 + (y - 32) ** 2) / 800) * (1 + 0.1 * np.sin(seed))
    return 4200 * blob[..., None] * np.array([0.5, 1.0, 0.9])


def measured(root: Path, name: str, frames: list[NDArray[np.uint16]], **camera: object) -> CameraFrames:
    """The camera's frames as a preparation reads them; the first is a black one."""
    tree: Tree = {"units": "mm", "camera": [{"name": "c", "size": list(SIZE)} | camera], "light": [], "frame": []}
    for k, values in enumerate(frames):
        file = f"f{k}{name}"
        if name == ".dng":
            write_dng(root / file, values, white=3240)
        elif name == ".npy":
            np.save(root / file, values)
        elif name == ".tif":
            tifffile.imwrite(root / file, values, photometric="rgb" if values.ndim == 3 else "minisblack")
        elif name == ".exr":
            import OpenEXR

            header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
            OpenEXR.File(header, {"RGB": values.astype(np.float32)}).write(str(root / file))
        else:
            cv2.imwrite(str(root / file), values[..., ::-1] if values.ndim == 3 else values)
        frame = {"camera": "c", "file": file, "exposure_s": 1.0, "kind": "black" if k == 0 else "light"}
        tree["frame"].append(frame | ({} if k == 0 else {"light": f"L{k}"}))
        if k:
            tree["light"].append({"name": f"L{k}"})
    write_toml(root, tree)
    folder = read_raw_folder(root)
    calibrated = CalibratedCamera(
        name="c", size=SIZE, K=((100, 0, 48), (0, 100, 32), (0, 0, 1)),
        camera_from_world=((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 100), (0, 0, 0, 1)), radiance_per_count=(1, 1, 1),
    )  # fmt: skip
    return CameraFrames(root, folder, calibrated, (0.01, 1e-3))


def frames_of(sensor: Sensor) -> list[NDArray[np.uint16]]:
    rng = np.random.default_rng(3)
    dark = sensor.counts(np.zeros((64, 96, 3)), 1.0, rng)
    return [dark, *(sensor.counts(radiance(k), 1.0, rng) for k in range(2))]


@pytest.mark.parametrize("suffix", [".png", ".tif", ".npy", ".exr"])
def test_counts_cut_below_full_scale_are_masked_and_said_in_every_format(suffix: str, tmp_path: Path) -> None:
    clean = frames_of(SENSOR)
    cut = [np.minimum(one, 3240) for one in clean]
    bits = {} if suffix == ".exr" else {"bits": 12}
    frames = measured(tmp_path, suffix, cut, **bits)
    lit = frames._folder.frame[1]
    exposure = frames.exposure(lit)
    np.testing.assert_array_equal(exposure.headroom <= 0, clean[1] >= 3240)
    assert (clean[1] >= 3240).mean() > 0.05
    (note,) = (one for one in frames.notes if "end at" in one)
    assert "3240 (green), 3240 (blue)" in note
    assert "red" not in note


def test_a_raw_files_white_level_masks_even_single_pixels(tmp_path: Path) -> None:
    sensor = Sensor(bits=12, black=64, counts_per_electron=0.5, mosaic="RGGB")
    frames = measured(tmp_path, ".dng", frames_of(sensor), bits=12, mosaic="RGGB")
    lit = frames._folder.frame[1]
    exposure = frames.exposure(lit)
    clean = frames_of(sensor)[1]
    np.testing.assert_array_equal(exposure.headroom <= 0, clean >= 3240)
    assert any("3240" in note for note in frames.notes)


def test_a_few_full_pixels_are_known_from_the_cameras_brighter_frames(tmp_path: Path) -> None:
    dark, bright, dim = frames_of(SENSOR)
    dim = np.minimum((dim // 2 + 32), 1700).astype(np.uint16)
    dim[:2, :3, 1] = 3240
    frames = measured(tmp_path, ".npy", [dark, np.minimum(bright, 3240), dim], bits=12)
    full = frames.exposure(frames._folder.frame[2]).headroom <= 0
    assert full[..., 1].sum() == 6


@pytest.mark.parametrize(
    ("changed", "end"),
    [
        (lambda v: np.round(np.minimum(v, 4095) * (65535 / 4095)), 65535),
        (lambda v: np.minimum(v, 4095) * 16, 65520),
        (lambda v: np.round(np.minimum(v, 3000) * 1.3), 3900),
        (lambda v: np.minimum(v, 255), 255),
        (lambda v: np.minimum(v, 4000) / 4000, 1.0),
    ],
    ids=["12 bits stretched to 16", "12 bits moved up", "digital gain", "8 bits", "floating point"],
)
def test_an_end_is_found_after_any_scale(changed: object, end: float) -> None:
    values = SENSOR.counts(radiance() * 1.3, 1.0, np.random.default_rng(0))[..., 1].astype(np.float64)
    made = changed(values)  # type: ignore[operator]
    made = made.astype(np.float32 if end == 1.0 else np.uint16)
    assert piled_up(made, np.inf) == end


def test_light_that_is_not_full_has_no_end() -> None:
    rng = np.random.default_rng(1)
    scenes = [radiance(k)[..., 1] * scale for k in range(20) for scale in (0.02, 0.2, 0.7)]
    scenes += [np.full((64, 96), level) for level in (5.0, 50.0, 500.0, 3000.0)]  # an even source
    scenes += [np.where(np.arange(96) < 48, 2000.0, 100.0) * np.ones((64, 1))]
    for bits in (8, 12):
        for scene in scenes:
            counts = SENSOR.counts(scene[..., None], 1.0, rng)[..., 0] >> (12 - bits)
            assert piled_up(counts.astype(np.uint16), 2.0**bits - 1) is None


def test_an_image_that_is_full_everywhere_is_full_and_a_dark_one_is_not() -> None:
    assert piled_up(np.full((20, 20), 3240, np.uint16), 4095) == 3240
    assert piled_up(np.full((20, 20), 64, np.uint16), 4095) is None
    assert piled_up(np.zeros((20, 20), np.float32), np.inf) is None


def test_the_end_of_each_pixel_of_a_mosaic_and_of_a_window() -> None:
    full = Fullness((10.0, 20.0, 30.0, 40.0), (4, 6), is_mosaic=True)
    np.testing.assert_array_equal(full.at()[:2, :2], [[10, 20], [30, 40]])
    np.testing.assert_array_equal(full.at((slice(1, 3), slice(3, 5))), [[40, 30], [20, 10]])
    np.testing.assert_array_equal(full.at(np.ix_(np.array([0, 3]), np.array([1, 2]))), [[20, 10], [40, 30]])
    windowed = Fullness((5.0, 6.0), (3, 3), is_mosaic=False, window=(1, 3, 0, 2)).at()
    assert windowed.shape == (3, 3, 2)
    assert np.isneginf(windowed[0]).all()
    assert np.isneginf(windowed[:, 2]).all()
    np.testing.assert_array_equal(windowed[1:, :2], np.broadcast_to([5, 6], (2, 2, 2)))


def test_linear_images_that_were_cut_are_masked_too(tmp_path: Path) -> None:
    pose = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 100.0), (0.0, 0.0, 0.0, 1.0))
    camera = Camera(name="c", size=SIZE, K=((100.0, 0.0, 48.0), (0.0, 100.0, 32.0), (0.0, 0.0, 1.0)),
                    camera_from_world=pose)  # fmt: skip
    light = Light(name="L", position_mm=(0.0, 0.0, -300.0), intensity=(1.0, 1.0, 1.0))
    image = ImageEntry(camera="c", light="L", file="i.npy")
    described = FolderCapture(
        units="mm", channels=("red", "green", "blue"), cameras=(camera,), lights=(light,), images=(image,)
    )
    (tmp_path / "capture.json").write_text(described.model_dump_json())
    clean = frames_of(SENSOR)[1].astype(np.float32) / 4000
    np.save(tmp_path / "i.npy", np.minimum(clean, np.float32(0.75)))
    covered = np.zeros(SIZE[::-1], dtype=bool)
    covered[5:-5, 5:-5] = True
    window = Window(0, SIZE[1], 0, SIZE[0])
    view = SimpleNamespace(number=0, whole=camera, window=window, footprint=SimpleNamespace(covered=covered))
    source = FolderSource(tmp_path, 0.01, 0.002)
    ((_, found),) = source.images(cast("View", view), [0], {})
    full = (found.bits & np.uint16(MaskBit.SATURATED)) > 0
    np.testing.assert_array_equal(full, (clean >= 0.75).any(axis=-1))
    assert full.any()
