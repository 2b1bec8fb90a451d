"""Demosaicing by linear filters, and the variance per pixel that gives sums over pixels the right variance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.core.raw.mosaic import site_channels, sites
from services.core.raw.records import Mosaic

Image = NDArray[np.float32]
BoolArray = NDArray[np.bool_]

SUPPORT = 5
"""Side of a filter in pixels; a saturated pixel spoils the square of this side around it."""
# Filters of Malvar, He and Cutler 2004, figure 2, in units of 1/8: bilinear interpolation plus the curvature of the
# other channels.
_GREEN = np.array([[0, 0, -1, 0, 0], [0, 0, 2, 0, 0], [-1, 2, 4, 2, -1], [0, 0, 2, 0, 0], [0, 0, -1, 0, 0]])
_BESIDE = np.array([[0, 0, 0.5, 0, 0], [0, -1, 0, -1, 0], [-1, 4, 5, 4, -1], [0, -1, 0, -1, 0], [0, 0, 0.5, 0, 0]])
_ACROSS = np.array([[0, 0, -1.5, 0, 0], [0, 2, 0, 2, 0], [-1.5, 0, 6, 0, -1.5], [0, 2, 0, 2, 0], [0, 0, -1.5, 0, 0]])
_SITES_OF_FOUR = (1, 2, 1)
"""Numbers of pixels that see red, green and blue among the four of a pattern."""


def channel_means(values: Image, mosaic: Mosaic) -> NDArray[np.float32]:
    """Mean brightness (3,) of the red, green and blue pixels of a mosaic (H, W)."""
    means = [np.mean([abs(float(own.mean())) for c, own in sites(values, mosaic) if c == k]) for k in range(3)]
    return np.array(means, dtype=np.float32)


def demosaic(values: Image, mosaic: Mosaic, means: NDArray[np.float32] | None = None) -> Image:
    """Interpolate a mosaic (H, W) to an image (H, W, 3).

    Args:
        values: (H, W) linear counts.
        mosaic: pattern at pixel (0, 0).
        means: channel means (3,) of the whole photograph, if ``values`` is a part of it; None to compute them. The
            channels are scaled to one mean for the filters and scaled back afterwards, because the filters take over
            edges of one channel into the others.
    """
    means = channel_means(values, mosaic) if means is None else means
    scale = np.where(means > 0, means / max(float(means.max()), 1e-30), 1).astype(np.float32)
    balanced = values.copy()
    for channel, own in sites(balanced, mosaic):
        np.divide(own, scale[channel], out=own)
    channels = site_channels(mosaic)
    image = np.repeat(balanced[..., None], 3, axis=2)
    filtered = {name: _filter(balanced, kernel) for name, kernel in _kernels().items()}
    for y in range(2):
        for x in range(2):
            own, site = channels[y, x], (slice(y, None, 2), slice(x, None, 2))
            for missing in {0, 1, 2} - {own}:
                # A green pixel has the missing colour beside it in its row or in its column; others have it at the
                # corners.
                beside = "row" if channels[y, 1 - x] == missing else "column"
                name = "green" if missing == 1 else beside if own == 1 else "across"
                image[*site, missing] = filtered[name][site]
    image *= scale
    return image


def demosaic_variance(variance: Image, mosaic: Mosaic) -> Image:
    """Variance (H, W, 3) per pixel that gives sums over many pixels the right variance.

    Interpolated pixels share noise with their neighbours. A channel that one pixel in four measures is therefore given
    four times the variance of such a pixel, so that its pixels can be treated as independent.

    Args:
        variance: (H, W) variance of the mosaic's pixels.
        mosaic: pattern at pixel (0, 0).
    """
    import cv2

    channels, tent = site_channels(mosaic), np.outer([1, 2, 1], [1, 2, 1]).astype(np.float32)
    result = np.empty((*variance.shape, 3), dtype=np.float32)
    for k in range(3):
        has_channel = np.tile(channels == k, (-(-variance.shape[0] // 2), -(-variance.shape[1] // 2)))
        mask = has_channel[: variance.shape[0], : variance.shape[1]].astype(np.float32)
        blurred, weight = (
            cv2.filter2D(one, -1, tent, borderType=cv2.BORDER_REFLECT_101) for one in (variance * mask, mask)
        )
        result[..., k] = np.float32(4 / _SITES_OF_FOUR[k]) * blurred / weight
    return result


def spoiled(lost: BoolArray) -> BoolArray:
    """Pixels (H, W) whose demosaicing filter reaches a lost pixel (H, W)."""
    import cv2

    return np.asarray(cv2.dilate(lost.astype(np.uint8), np.ones((SUPPORT, SUPPORT), np.uint8)) > 0)


def _kernels() -> dict[str, NDArray[np.float64]]:
    return {"green": _GREEN, "row": _BESIDE, "column": _BESIDE.T, "across": _ACROSS}


def _filter(values: Image, kernel: NDArray[np.float64]) -> Image:
    import cv2

    # Mirror without repeating the border pixel, which keeps the parity of the pattern.
    return np.asarray(cv2.filter2D(values, -1, (kernel / 8).astype(np.float32), borderType=cv2.BORDER_REFLECT_101))
