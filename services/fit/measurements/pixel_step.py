"""Choice of the squares of pixels whose means a fit compares.

A photograph at full resolution has far more pixels than a fit needs: over squares of 0.26 and of 0.45 mm the standard
errors by the photographs alone were the same. And the noise of rendering is smaller with squares, because the same
number of paths tells more about fewer means: on a tooth at 0.064 mm the same noise of the media took a 15th to a 45th
of the time, that of the enamel's mean cosine a quarter. Stains are finer than squares and are fitted pixel by pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Camera
from services.core.records import JobSpec
from services.core.results import PreparedManifest
from services.core.store import StoredArray
from services.core.values import AUTO, MAX_SQUARE_MM
from services.fit.measurements.levels import whole_squares

MIN_KEPT = 0.5
"""Least share of the valid pixels that lies in squares without a masked pixel; only such squares are compared."""
MAX_IMAGES = 12
"""Largest number of images whose masks are counted for that."""


def chosen_pixel_step(folder: Path, manifest: PreparedManifest, centre_mm: NDArray[np.float64], spec: JobSpec) -> int:
    """Edge in pixels of the squares that a job fits.

    Args:
        folder: folder of the prepared capture.
        manifest: its manifest.
        centre_mm: centre of the teeth (3,).
        spec: the job.
    """
    if spec.pixel_step != AUTO:
        return int(spec.pixel_step)
    if spec.stains:
        return 1
    pixel_mm = float(np.median([camera.pixel_mm(centre_mm) for camera in manifest.cameras]))
    masks = _masks(StoredArray(folder / "prepared.zarr" / "valid"), manifest.cameras, len(manifest.lights))
    step = max(int(MAX_SQUARE_MM / pixel_mm), 1)
    while step > 1 and kept_share(masks, step) < MIN_KEPT:
        step -= 1
    return step


def kept_share(masks: Sequence[NDArray[np.bool_]], step: int) -> float:
    """Share of the valid pixels of some masks (H, W) that lies in wholly valid squares."""
    valid = sum(int(mask.sum()) for mask in masks)
    return step**2 * sum(int(whole_squares(mask, step).sum()) for mask in masks) / max(valid, 1)


def _masks(bits: StoredArray, cameras: tuple[Camera, ...], lights: int) -> list[NDArray[np.bool_]]:
    images = [(number, light) for light in range(lights) for number in range(len(cameras))]
    chosen = np.unique(np.linspace(0, len(images) - 1, min(MAX_IMAGES, len(images))).astype(int))
    masks = []
    for number, light in (images[k] for k in chosen):
        width, height = cameras[number].size
        masks.append(np.asarray(bits[number, light, :height, :width]) == 0)
    return masks
