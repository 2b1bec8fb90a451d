"""Real 8-bit raw frames of a colour chart under seven bands, as pairs of exposures, and how linear they are."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import combinations, pairwise

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from services.core.raw.mosaic import sites
from services.preprocess.raw.response import NEAR_FULL, Series
from tests.support.shared_data import shared_path

Image = NDArray[np.float32]

BANDS_NM = (400, 450, 500, 550, 600, 650, 700)
TIMES_MS = (25, 100, 500, 2000)
FULL = 255.0
MIN_MEAN, MAX_COUNT = 10.0, 250.0
"""Least mean of a patch in the shorter exposure, and largest count of a pixel, of the figures that the data's source
states."""
Correct = Callable[[Image], Image]


def bent(share: float) -> Correct:
    """The response of a sensor that counts this share more at full scale than a linear one."""
    return lambda signal: np.asarray(signal * (1 + share * signal / FULL), dtype=np.float32)


def as_counted(signal: Image) -> Image:
    """The counts as they are."""
    return signal


@lru_cache(maxsize=64)
def counts(band_nm: int, time_ms: int) -> tuple[Image, Image]:
    """Counts of a frame and its mean dark frame, by position in the mosaic's pattern (H, W, 4)."""
    folder = shared_path("data/colorchecker-raw") / "captured_images"
    (frame,) = folder.rglob(f"*_{band_nm}nm_{time_ms}ms_*.tif")
    dark = [tifffile.imread(path) for path in folder.rglob("*dark_*.tif") if re.search(rf"_{time_ms}ms_", path.name)]
    return _sites(tifffile.imread(frame)), _sites(np.mean(dark, axis=0))


def signal(band_nm: int, time_ms: int, most: float) -> Image:
    """Counts above black (H, W, 4), NaN above ``most``."""
    frame, dark = counts(band_nm, time_ms)
    return np.where(frame > most, np.nan, frame - dark).astype(np.float32)


def pairs(times_ms: Sequence[int], bands_nm: Sequence[int], correct: Correct = as_counted) -> list[Series]:
    """All pairs of neighbouring exposures, by light."""
    steps = [(band, *step) for band in bands_nm for step in pairwise(times_ms)]
    return [
        Series(
            correct(signal(band, shorter, NEAR_FULL * FULL)),
            correct(signal(band, longer, NEAR_FULL * FULL)),
            longer / shorter,
            (shorter, longer),
        )
        for band, shorter, longer in steps
    ]


def patch_ratios(times_ms: Sequence[int], bands_nm: Sequence[int], correct: Correct) -> NDArray[np.float64]:
    """(b / a) / (time b / time a) of patch means of all pairs of exposures, as the data's source measures them."""
    labels = _sites(_labels())
    found = []
    for band in bands_nm:
        for shorter, longer in combinations(times_ms, 2):
            plain = signal(band, shorter, MAX_COUNT)
            first, second = correct(plain), correct(signal(band, longer, MAX_COUNT))
            for site in range(4):
                for patch in range(1, 25):
                    own = labels[..., site] == patch
                    a, b = first[..., site][own], second[..., site][own]
                    if np.isfinite(a).all() and np.isfinite(b).all() and plain[..., site][own].mean() > MIN_MEAN:
                        found.append(b.mean() / a.mean() / (longer / shorter))
    return np.array(found)


@lru_cache(maxsize=1)
def _labels() -> NDArray[np.uint8]:
    path = shared_path("data/colorchecker-raw/colorChecker_labels/d2_colorChecker30cm_550nm_labels.png")
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))


def _sites(image: NDArray[np.generic]) -> Image:
    return np.stack([view for _, view in sites(image, "GBRG")], axis=-1).astype(np.float32)
