"""Likeness of each pixel to tooth, learned in each photograph from the pixels inside and around the teeth's outline at
the present pose.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.calibrate.registration.pose import Floats

BINS = 20
"""Number of histogram bins along each feature, between its 1st and 99th percentile."""
SMOOTH_BINS = 1.0
"""Width in bins (standard deviation) of the Gaussian that smooths the histograms."""
INSIDE_PX, OUTSIDE_PX, BAND_PX = 1, 3, 25
"""Training pixels of tooth lie farther than the first distance inside an outline, those of its surroundings between the
second and the third distance outside. The first is small because teeth darken towards their rims: learning from their
middles alone puts an outline up to 1.5 pixels too far in."""
TOOTH_BINS = 2.0
"""Width in bins of the Gaussian that smooths the tooth's histogram along brightness, because teeth have more shades
than the few pixels at their rims show."""
MAX_OUTSIDE_LIKENESS = 0.3
"""Likeness to tooth from which a pixel outside is no longer used for training, because it may show a tooth that the
scan does not have."""
TRAINING_ROUNDS = 3
"""Number of rounds of training, each without the pixels that the previous round left out."""
MIN_REMAINING_SHARE = 1 / 3
"""Smallest fraction of the pixels outside that must remain for training. Where teeth and their surroundings look alike,
all of them would be left out."""
SMOOTH_PX = 1.0
"""Width in px of the Gaussian that smooths the two resulting images."""
MAX_CHANNELS = 3
"""Largest number of channels: neighbouring channels of a camera with more are averaged, because the size of the
features' joint histogram grows exponentially with their number."""
FLOOR = 1e-3
"""Offset added before the logarithm, as a fraction of the 99th percentile: darker pixels are noise."""


@dataclass(frozen=True)
class Appearance:
    """Two images (H, W) in which outlines are searched."""

    likeness: NDArray[np.float32]
    """Probability of tooth by colour and brightness, 0 to 1."""
    brightness: NDArray[np.float32]
    """Logarithm of the mean of the channels, smoothed."""


def learn_appearance(image: NDArray[np.float32], tooth: NDArray[np.bool_], size_px: float = 1.0) -> Appearance:
    """Learn the appearance of tooth and of its surroundings from one photograph.

    Args:
        image: linear image (H, W, C), 0 at black.
        tooth: mask (H, W) of the pixels that show the scan's teeth at the present pose.
        size_px: possible error of the pose in px; training pixels keep this additional distance from the outline.

    Returns:
        Likeness and brightness; 0.5 and 0 everywhere if there are no training pixels inside or outside, so that no
        outline is found.
    """
    import cv2

    features = _features(image)
    inner, beside, outer = (margin + round(size_px) for margin in (INSIDE_PX, OUTSIDE_PX, BAND_PX))
    distance_in = cv2.distanceTransform(tooth.astype(np.uint8), cv2.DIST_L2, 5)
    distance_out = cv2.distanceTransform((~tooth).astype(np.uint8), cv2.DIST_L2, 5)
    inside, outside = distance_in > inner, (distance_out > beside) & (distance_out < outer)
    if not inside.any() or not outside.any():
        return Appearance(np.full(tooth.shape, 0.5, dtype=np.float32), np.zeros(tooth.shape, dtype=np.float32))
    low, high = np.percentile(features[inside | outside], [1, 99], axis=0)
    index = np.clip((features - low) / np.maximum(high - low, 1e-6) * BINS, 0, BINS - 1).astype(np.int64)
    flat = np.ravel_multi_index(tuple(np.moveaxis(index, -1, 0)), (BINS,) * features.shape[-1])
    tooth_density = _histogram(flat[inside], features.shape[-1], TOOTH_BINS)
    likeness, fewest = np.zeros(tooth.shape, dtype=np.float32), MIN_REMAINING_SHARE * np.count_nonzero(outside)
    for _ in range(TRAINING_ROUNDS):
        if np.count_nonzero(outside) < fewest:
            break
        other_density = _histogram(flat[outside], features.shape[-1], SMOOTH_BINS)
        likeness = (tooth_density / (tooth_density + other_density))[flat].astype(np.float32)
        outside = outside & (likeness < MAX_OUTSIDE_LIKENESS)
    return Appearance(
        cv2.GaussianBlur(likeness, (0, 0), SMOOTH_PX),
        cv2.GaussianBlur(features[..., 0].astype(np.float32), (0, 0), SMOOTH_PX),
    )


def _features(image: NDArray[np.float32]) -> Floats:
    # Features (H, W, F): logarithms of the brightness and of the ratios of neighbouring channels, which shading does
    # not change.
    bright = np.percentile(image, 99)
    groups = np.array_split(np.maximum(image, 0), min(image.shape[-1], MAX_CHANNELS), axis=-1)
    logs = [np.log(group.mean(axis=-1) + FLOOR * bright) for group in groups]
    ratios = [one - two for one, two in itertools.pairwise(logs)]
    return np.stack([np.log(np.maximum(image, 0).mean(axis=-1) + FLOOR * bright), *ratios], axis=-1).astype(np.float64)


def _histogram(flat: NDArray[np.int64], dimensions: int, bright_bins: float) -> Floats:
    from scipy.ndimage import gaussian_filter

    counts = np.bincount(flat, minlength=BINS**dimensions).reshape((BINS,) * dimensions)
    smooth = gaussian_filter(counts / max(len(flat), 1), [bright_bins] + [SMOOTH_BINS] * (dimensions - 1))
    return np.asarray(smooth.reshape(-1) + 1e-7)
