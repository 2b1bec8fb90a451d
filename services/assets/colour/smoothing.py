"""Noise of a render taken out by a filter that the surface guides, for pictures to look at."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

SAME_SHADE = 3e-3
"""Variance of a normal's components below which the surface counts as flat: a tilt of some 3 degrees."""
COLOUR_RADII = 4
"""Radius of the squares for the channels' ratios, in those for their sum: a tooth's colour changes more slowly than its
brightness."""


def smoothed_colours(
    image: Floats, normals: Floats, covered: Floats, radius_px: int, known: NDArray[np.bool_] | None = None
) -> Floats:
    """``smoothed``, with the ratios of the channels from larger squares, because independent noise of the channels
    shows as coloured spots.
    """
    bright = smoothed(image.mean(axis=-1, keepdims=True), normals, covered, radius_px, known)
    colours = smoothed(image, normals, covered, COLOUR_RADII * radius_px, known)
    mean = colours.mean(axis=-1, keepdims=True)
    return np.asarray(bright * np.divide(colours, mean, out=np.ones_like(colours), where=mean > 0))


def smoothed_halves(image: Floats, normals: Floats, covered: Floats, radius_px: int) -> tuple[Floats, Floats]:
    """``smoothed_colours`` from every second pixel in the pattern of a chessboard, and from the others. Half their
    difference has the noise of the image from all.
    """
    even = np.indices(covered.shape).sum(axis=0) % 2 == 0
    one, two = (smoothed_colours(image, normals, covered, radius_px, known) for known in (even, ~even))
    return one, two


def smoothed(
    image: Floats, normals: Floats, covered: Floats, radius_px: int, known: NDArray[np.bool_] | None = None
) -> Floats:
    """An image without its noise, by the guided filter (He, Sun & Tang, IEEE PAMI 35, 2013, eqs. 11 and 14 to 16).

    In a square around each pixel the image is taken for a linear function of the surface's normal, fitted by least
    squares, because light that has scattered through a body changes with the shape of its surface and not from pixel to
    pixel. Pixels count by the share of them that shows the surface, so no background leaks in.

    Args:
        image: noisy values (H, W, C).
        normals: unit normals of the surface (H, W, 3); of no meaning where nothing is covered.
        covered: share (H, W) of each pixel that shows the surface.
        radius_px: half the side of the squares, pixels.
        known: pixels (H, W) from which the result is made; all by default.
    """
    from scipy.ndimage import gaussian_filter, uniform_filter

    side = 2 * radius_px + 1

    def mean(values: Floats) -> Floats:
        return np.asarray(uniform_filter(values, (side, side, *[1] * (values.ndim - 2)), mode="constant"))

    # Facets would show in the result, so the normals vary smoothly over a fraction of the square.
    spread = (radius_px / 4, radius_px / 4, 0)
    guide = gaussian_filter(normals * covered[..., None], spread, mode="constant")
    guide /= np.maximum(np.linalg.norm(guide, axis=-1, keepdims=True), 1e-12)
    used = covered if known is None else covered * known
    image = image if known is None else image * known[..., None]
    weight = np.maximum(mean(used), 1e-9)[..., None]
    centre = mean(used[..., None] * guide) / weight
    level = mean(image) / weight  # what a pixel shows is its surface's radiance times its covered share
    products = mean(used[..., None, None] * guide[..., :, None] * guide[..., None, :]) / weight[..., None]
    joint = mean(guide[..., :, None] * image[..., None, :]) / weight[..., None]
    variance = products - centre[..., :, None] * centre[..., None, :]
    covariance = joint - centre[..., :, None] * level[..., None, :]
    slope = np.linalg.solve(variance + SAME_SHADE * np.eye(3), covariance)
    constant = level - np.einsum("hwg,hwgc->hwc", centre, slope)
    # Each pixel lies in many squares; it takes the mean of their functions.
    slope = mean(used[..., None, None] * slope) / weight[..., None]
    constant = mean(used[..., None] * constant) / weight
    return np.asarray(covered[..., None] * (np.einsum("hwg,hwgc->hwc", guide, slope) + constant))
