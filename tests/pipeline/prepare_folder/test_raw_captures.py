"""Preparation of raw folders: counts of a known sensor become the radiance that it received."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import zarr

from services.core.results import PreparedManifest
from services.core.store import read_record
from services.preprocess.captures.rig import STILL_PX
from services.preprocess.quality.images import QualityReport
from services.preprocess.raw.source import RawSource
from services.preprocess.views.subject import read_subject
from tests.support.folder_captures import prepare
from tests.support.mouth import smooth_image, write_mouth
from tests.support.raw_captures import write_raw_capture
from tests.support.raw_sensor import Sensor

SIZES = ((72, 56), (64, 48))


@pytest.fixture
def mouth(tmp_path: Path) -> Path:
    write_mouth(tmp_path / "mouth", lights=3, sizes=SIZES)
    tree = json.loads((tmp_path / "mouth" / "capture.json").read_text())
    for camera in tree["cameras"]:
        camera["K"][0][0] = camera["K"][1][1] = 500.0  # the tooth is 40 px across, enough to follow its motion
    (tmp_path / "mouth" / "capture.json").write_text(json.dumps(tree))
    return tmp_path / "mouth"


@pytest.fixture
def textured(mouth: Path) -> Path:
    """The mouth with waves of 8 pixels in its images, from which motion can be measured to a hundredth of a pixel."""
    for file in mouth.glob("c*_l*.npy"):
        image = np.load(file)
        y, x = np.mgrid[: image.shape[0], : image.shape[1]]
        np.save(file, (image * (1 + 0.6 * np.sin(0.8 * x) * np.cos(0.7 * y))[..., None]).astype(np.float32))
    return mouth


def prepared(root: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    store = root / "prepared" / "prepared.zarr"
    radiance, variance, valid = (
        np.asarray(zarr.open_array(store / name, mode="r")[:]) for name in ("radiance", "variance", "valid")
    )
    return radiance, variance, valid


def smooth_truth(manifest: PreparedManifest, shape: tuple[int, ...]) -> np.ndarray:
    seen = np.zeros(shape)
    for k, camera in enumerate(manifest.cameras):
        width, height = camera.size
        for j in range(len(manifest.lights)):
            seen[k, j, :height, :width] = smooth_image(width, height, 3, k, j)
    return seen


def test_colour_counts_of_three_exposures_become_radiance_with_its_variance(textured: Path, tmp_path: Path) -> None:
    """z-scores of all pixels below full scale: the mean square is 1 within 5 standard errors (4 %) plus 3 % for the
    error of the noise model.

    The tolerance of the mean is 0.05, because the noise of black and flat frames is common to all frames of a pixel or
    all pixels of a camera.
    """
    write_raw_capture(tmp_path / "raw", textured, Sensor(), (0.0125, 0.05, 0.2), flats=6)
    source = RawSource(tmp_path / "raw", None, 0.01, 0.002)
    subject = read_subject(source.root, whole=False)
    for k, camera in enumerate(source.description.cameras):
        view = subject.view_of(k, camera)
        motions = dict(source.match(view, source.matched_frames(k), subject.footprint_in))
        for j, image in source.images(view, source.lights_of(k), motions):
            truth = np.load(textured / f"c{k}_l{j}.npy")[view.window.rows, view.window.columns]
            assert image.motion_px is not None
            assert image.motion_px < STILL_PX
            seen = (image.bits == 0) & (image.radiance > 0).all(axis=-1)
            assert seen.mean() > 0.9
            z = (image.radiance - truth)[seen] / np.sqrt(image.variance[seen])
            assert abs(z.mean()) < 0.05
            assert abs((z**2).mean() - 1) < 5 * np.sqrt(2 / z.size) + 0.03
    assert any("read noise of" in note for note in source.notes)


@pytest.mark.parametrize("others_s", [(0.0005,), (5.0,), (0.0125, 3.2)])
def test_exposures_that_show_nothing_move_no_subject(
    textured: Path, tmp_path: Path, others_s: tuple[float, ...]
) -> None:
    """Without tracking frames, motion comes from matched edges. Exposures of pure noise or at full scale have no edges,
    so the motion is that of one good exposure.

    Edges are accurate to about a pixel; the same edges with a little more or less noise agree to a tenth of that.
    """
    found = []
    for name, exposures_s in (("one", (0.05,)), ("several", tuple(sorted((0.05, *others_s))))):
        write_raw_capture(tmp_path / name, textured, Sensor(), exposures_s, tracking=0)
        source = RawSource(tmp_path / name, None, 0.01, 0.002)
        subject = read_subject(source.root, whole=False)
        view = subject.view_of(0, source.description.cameras[0])
        motions = dict(source.match(view, source.matched_frames(0), subject.footprint_in))
        assert len(motions) == 3
        assert all(image.motion_px is not None for _, image in source.images(view, (0, 1, 2), motions))
        found.append([matched.coefficients[:, 0] for matched in motions.values()])
    one, several = found
    assert np.abs(np.subtract(one, several)).max() < 0.1


def test_a_mosaic_becomes_radiance_of_all_channels(mouth: Path, tmp_path: Path) -> None:
    """For waves of 28 pixels through a mosaic, interpolation and noise at 12 bits leave 3 % rms and less than 0.5 %
    bias.
    """
    write_raw_capture(tmp_path / "raw", mouth, Sensor(mosaic="GRBG"), (0.05, 0.2), flats=0)
    manifest = prepare(tmp_path / "raw", tmp_path / "job")
    radiance, _, valid = prepared(tmp_path / "job")
    error = (radiance / np.maximum(smooth_truth(manifest, radiance.shape), 1e-9) - 1)[valid == 0]
    assert np.sqrt((error**2).mean()) < 0.03
    assert abs(error.mean()) < 0.005
    assert any("are assumed" in note for note in manifest.notes)


def test_the_report_shows_the_motion_of_photographs_and_that_it_is_gone(tmp_path: Path) -> None:
    """The subject moves by 2 px at a time, which keeps the mosaic's pattern: 6 px from the first tracking frame.

    The optical flow's own errors are a tenth of a pixel.
    """
    write_mouth(tmp_path / "mouth", lights=6, sizes=((160, 120), (140, 100)))
    tree = json.loads((tmp_path / "mouth" / "capture.json").read_text())
    for camera in tree["cameras"]:
        camera["K"][0][0] = camera["K"][1][1] = 1100.0
    (tmp_path / "mouth" / "capture.json").write_text(json.dumps(tree))
    for file in (tmp_path / "mouth").glob("c*_l*.npy"):
        image = np.load(file)
        grain = np.random.default_rng(1).normal(size=image.shape[:2])
        texture = sum(sigma * cv2.GaussianBlur(grain, (0, 0), sigma) for sigma in (1.5, 4.0))
        np.save(file, (image * np.clip(1 + 0.25 * texture / texture.std(), 0.2, 3)[..., None]).astype(np.float32))
    raw = write_raw_capture(tmp_path / "raw", tmp_path / "mouth", Sensor(mosaic="RGGB"), blacks=2)
    for camera in raw["camera"]:
        own = [one for one in raw["frame"] if one["camera"] == camera["name"] and one["kind"] in {"tracking", "light"}]
        for number, frame in enumerate(own):
            counts = np.load(tmp_path / "raw" / frame["file"])
            np.save(tmp_path / "raw" / frame["file"], np.roll(counts, 2 * round(3 * number / (len(own) - 1)), axis=1))
    prepare(tmp_path / "raw", tmp_path / "job")
    flows = read_record(tmp_path / "job" / "prepared" / "quality.json", QualityReport).flows
    assert [flow.camera for flow in flows] == [camera["name"] for camera in raw["camera"]]
    for flow in flows:
        assert flow.before_px[0] == pytest.approx(6, abs=0.2)
        assert flow.after_px[0] < 0.2
        assert (tmp_path / "job" / "prepared" / "quality" / "flow" / f"{flow.camera}_after.png").is_file()
