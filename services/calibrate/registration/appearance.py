"""How much a pixel looks like tooth: learned in each photograph from the teeth's present outline, and from what lies
around it.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.calibrate.registration.pose import Floats

BINS = 20
"""Along each feature, between its 1st and 99th percentile."""
SMOOTH_BINS = 1.0
INSIDE_PX, OUTSIDE_PX, BAND_PX = 1, 3, 25
"""Pixels this far inside an outline teach what tooth is; those from so far outside to this far, what it is not. Teeth
darken towards their rims, so that what is learned from their middles alone puts an outline up to 1.5 pixels too far
in."""
TOOTH_BINS = 2.0
"""Of brightness, that tooth is smoothed by: it comes in more shades than the few pixels at its rims show."""
PERHAPS = 0.3
"""Likeness to tooth from which a pixel outside teaches nothing, as it may be of a tooth that the scan does not have."""
LOOKS = 3
"""How often that is learned, each time without such pixels."""
MIN_LEFT = 1 / 3
"""Share of the pixels outside that must go on teaching; where teeth and their surroundings look alike, all would be
left out."""
SMOOTH_PX = 1.0
MAX_CHANNELS = 3
"""Of a camera with more, neighbouring ones are averaged: the features' joint histogram grows as the power of their
number."""
FLOOR = 1e-3
"""Of the brightest pixels, added before the logarithm: darker ones are noise."""


@dataclass(frozen=True)
class Appearance:
    """Two images (H, W) in which outlines are looked for."""

    likeness: NDArray[np.float32]
    """Probability of tooth by colour and brightness, 0 to 1."""
    brightness: NDArray[np.float32]
    """Logarithm of the mean of the channels, smoothed."""


def learn_appearance(image: NDArray[np.float32], tooth: NDArray[np.bool_], size_px: float = 1.0) -> Appearance:
    """Learn from one photograph.

    Args:
        image: (H, W, C), 0 at black.
        tooth: (H, W), where the scan is seen at the present pose.
        size_px: by how many pixels the pose may be off: so much further from its outline is learned from.
    """
    import cv2

    features = _features(image)
    inner, beside, outer = (margin + round(size_px) for margin in (INSIDE_PX, OUTSIDE_PX, BAND_PX))
    distance_in = cv2.distanceTransform(tooth.astype(np.uint8), cv2.DIST_L2, 5)
    distance_out = cv2.distanceTransform((~tooth).astype(np.uint8), cv2.DIST_L2, 5)
    inside, outside = distance_in > inner, (distance_out > beside) & (distance_out < outer)
    if not inside.any() or not outside.any():
        # No tooth is seen, or nothing else: every pixel is as likely, and no outline is found here.
        return Appearance(np.full(tooth.shape, 0.5, dtype=np.float32), np.zeros(tooth.shape, dtype=np.float32))
    low, high = np.percentile(features[inside | outside], [1, 99], axis=0)
    index = np.clip((features - low) / np.maximum(high - low, 1e-6) * BINS, 0, BINS - 1).astype(np.int64)
    flat = np.ravel_multi_index(tuple(np.moveaxis(index, -1, 0)), (BINS,) * features.shape[-1])
    tooth_density = _histogram(flat[inside], features.shape[-1], TOOTH_BINS)
    likeness, fewest = np.zeros(tooth.shape, dtype=np.float32), MIN_LEFT * np.count_nonzero(outside)
    for _ in range(LOOKS):
        if np.count_nonzero(outside) < fewest:
            break
        other_density = _histogram(flat[outside], features.shape[-1], SMOOTH_BINS)
        likeness = (tooth_density / (tooth_density + other_density))[flat].astype(np.float32)
        outside = outside & (likeness < PERHAPS)
    return Appearance(
        cv2.GaussianBlur(likeness, (0, 0), SMOOTH_PX),
        cv2.GaussianBlur(features[..., 0].astype(np.float32), (0, 0), SMOOTH_PX),
    )


def _features(image: NDArray[np.float32]) -> Floats:
    # Logarithms: brightness, and the ratios of neighbouring channels, which shading does not change.
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
