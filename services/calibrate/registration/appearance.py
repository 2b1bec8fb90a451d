"""How much a pixel looks like tooth: learned in each photograph from the teeth's present outline, and from what lies around it."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.calibrate.registration.pose import Floats

BINS = 20
"""Along each feature, between its 1st and 99th percentile."""
SMOOTH_BINS = 1.0
INSIDE_PX, BAND_PX = 3, 25
"""Pixels this far inside an outline teach what tooth is; those from as far outside to this far, what it is not."""
SMOOTH_PX = 1.0
MAX_CHANNELS = 3
"""Of a camera with more, neighbouring ones are averaged: the features' joint histogram grows as the power of their number."""
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
    inner, outer = INSIDE_PX + round(size_px), BAND_PX + round(size_px)
    distance_in = cv2.distanceTransform(tooth.astype(np.uint8), cv2.DIST_L2, 5)
    distance_out = cv2.distanceTransform((~tooth).astype(np.uint8), cv2.DIST_L2, 5)
    inside, outside = distance_in > inner, (distance_out > inner) & (distance_out < outer)
    if not inside.any() or not outside.any():
        # No tooth is seen, or nothing else: every pixel is as likely, and no outline is found here.
        return Appearance(np.full(tooth.shape, 0.5, dtype=np.float32), np.zeros(tooth.shape, dtype=np.float32))
    low, high = np.percentile(features[inside | outside], [1, 99], axis=0)
    index = np.clip((features - low) / np.maximum(high - low, 1e-6) * BINS, 0, BINS - 1).astype(np.int64)
    flat = np.ravel_multi_index(tuple(np.moveaxis(index, -1, 0)), (BINS,) * features.shape[-1])
    odds = [_histogram(flat[where], features.shape[-1]) for where in (inside, outside)]
    likeness = (odds[0] / (odds[0] + odds[1]))[flat].astype(np.float32)
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


def _histogram(flat: NDArray[np.int64], dimensions: int) -> Floats:
    from scipy.ndimage import gaussian_filter

    counts = np.bincount(flat, minlength=BINS**dimensions).reshape((BINS,) * dimensions)
    smooth = gaussian_filter(counts / max(len(flat), 1), SMOOTH_BINS)
    return np.asarray(smooth.reshape(-1) + 1e-7)
