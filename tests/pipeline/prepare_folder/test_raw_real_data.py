"""Real raw data of other groups: linearity and black level of raw mosaics, and the merge of a series of exposures."""

from __future__ import annotations

import csv
import re
import shutil
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from services.core.calibration.cameras_and_lights import CalibratedCamera
from services.core.raw.folder import read_raw_folder
from services.core.raw.merge import merge
from services.core.raw.mosaic import sites
from services.preprocess.raw.camera import CameraFrames
from tests.support.raw_folders import write_toml
from tests.support.shared_data import shared_path

SIZE = (408, 342)
MIN_MEAN, MAX_COUNT = 10.0, 250.0
"""Limits used for the figures that the data's source states: least mean of a patch in the shorter exposure, and largest
count of a pixel."""


@pytest.fixture(scope="module")
def chart(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, CameraFrames]:
    """A raw folder of a ColorChecker under seven spectral bands in four exposures, with dark frames."""
    data, root = shared_path("data/colorchecker-raw"), tmp_path_factory.mktemp("chart")
    frames = []
    for path in sorted(data.rglob("captured_images/**/*.tif")):
        shutil.copy(path, root)
        told = re.search(r"(dark|(\d+)nm)_(\d+)ms", path.name)
        assert told is not None
        lit = {"kind": "light", "light": told[2]} if told[2] else {"kind": "black"}
        frames.append({"camera": "c", "file": path.name, "exposure_s": int(told[3]) / 1000, **lit})
    camera = {"name": "c", "size": list(SIZE), "bits": 8, "mosaic": "GBRG"}
    lights = [{"name": name} for name in sorted({one["light"] for one in frames if "light" in one})]
    write_toml(root, {"units": "mm", "camera": [camera], "light": lights, "frame": frames})
    pinhole = {
        "name": "c",
        "size": SIZE,
        "K": ((400, 0, 204), (0, 400, 171), (0, 0, 1)),
        "camera_from_world": np.eye(4),
    }
    calibrated = CalibratedCamera.model_validate(pinhole | {"camera_from_world": np.eye(4).tolist()})
    return root, CameraFrames(root, read_raw_folder(root), calibrated, (0.01, 0.002))


def patches(band: str = "550nm") -> np.ndarray:
    labels = shared_path(f"data/colorchecker-raw/colorChecker_labels/d2_colorChecker30cm_{band}_labels.png")
    return np.asarray(cv2.imread(str(labels), cv2.IMREAD_UNCHANGED))


def site_means(image: np.ndarray, labels: np.ndarray, reduce: str = "mean") -> np.ndarray:
    """Mean or largest value (4, 24) of each patch, by position in the mosaic's pattern."""
    views = zip(sites(image, "GBRG"), sites(labels, "GBRG"), strict=True)
    return np.array([[getattr(view[where == k], reduce)() for k in range(1, 25)] for (_, view), (_, where) in views])


def test_exposures_of_a_real_sensor_are_linear_above_their_black(chart: tuple[Path, CameraFrames]) -> None:
    """The source's figures over its 430 pairs are median 1.001, 5 % quantile 0.973 and 95 % quantile 1.040; the
    tolerances are 0.002, 0.005 and 0.005.
    """
    root, camera = chart
    assert camera.linearity.is_linear
    folder, labels, ratios = read_raw_folder(root), patches(), []
    for light in folder.light:
        own = [frame for frame in folder.frames_of("c", "light") if frame.light == light.name]
        seen = []
        for frame in own:
            exposure = camera.exposure(frame)
            counts = tifffile.imread(root / frame.file).astype(np.float32)
            means, most = site_means(exposure.signal, labels), site_means(counts, labels, "max")
            seen.append((frame.exposure_s, np.where(most <= MAX_COUNT, means, np.nan)))
        for (first_s, first), (second_s, second) in combinations(sorted(seen, key=lambda one: one[0]), 2):
            usable = (first > MIN_MEAN) & np.isfinite(second)
            ratios.append(second[usable] / first[usable] / (second_s / first_s))
    found = np.concatenate(ratios)
    assert np.median(found) == pytest.approx(1.001, abs=0.002)
    assert np.percentile(found, 5) == pytest.approx(0.973, abs=0.005)
    assert np.percentile(found, 95) == pytest.approx(1.040, abs=0.005)


def test_merged_exposures_of_the_grey_row_follow_its_measured_reflectance(chart: tuple[Path, CameraFrames]) -> None:
    """The source's correlations for single exposures are 0.996 to 0.9996 from 450 to 700 nm."""
    root, camera = chart
    folder, labels = read_raw_folder(root), patches()
    with shared_path("data/colorchecker-raw/spectral_data/spectra_averaged.csv").open() as stream:
        rows = list(csv.reader(stream))
    start = rows[0].index("dark skin")
    spectra = {
        int(float(row[0])): np.array(row[start : start + 24], dtype=float)
        for row in rows[1:]
        if row and row[0].strip()[:1].isdigit()
    }
    for band in (450, 500, 550, 600, 650, 700):
        own = [frame for frame in folder.frames_of("c", "light") if frame.light == str(band)]
        rate, _, lost = merge([camera.exposure(frame) for frame in own], camera.noise)
        means = site_means(np.where(lost, np.nan, rate), labels)[:, 18:24]
        brightest = means[int(np.nanargmax(np.nanmean(means, axis=1)))]
        correlation = np.corrcoef(brightest, spectra[band][18:24])[0, 1]
        assert correlation > 0.996
