"""Position of an edge to a small fraction of a pixel, from the profile of the light across it instead of from the
likeness to tooth.

The value of a pixel that shows two things is the mean of their light, weighted by area. The integral of the inner
side's fraction along a line across the edge therefore gives the edge's position, whatever the blur by the lens, the
pixels and a mosaic's interpolation. The likeness to tooth is not such a mean: a pixel that shows the dark mouth and a
fifth of tooth has a tooth's colour and the brightness of a shaded tooth, so its likeness is high.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.calibrate.registration.pose import Floats

STEP_PX = 0.5
"""Distance between samples across an edge."""
HALF_PX, LEVEL_PX = 4.0, 2.0
"""Largest distance of the samples from the edge to both sides, and the distance from which on samples give the light of
either side. A pixel, a mosaic's interpolation and a lens together blur an edge by up to 1 px of standard deviation;
beyond 2 px a fortieth of such a blur remains."""
FARTHEST_PX = 1.5
"""Largest distance of an edge from the searched position: an edge farther away belongs to something else."""
COLOURED = 0.05
"""Smallest distance of the outer light from the colour of the inner light, as a fraction of the inner light, with which
shading across both sides can be separated from the edge. It is 0.15 for gums and less than 0.01 for the dark of the
mouth."""
DARKEST = 0.2
"""Smallest shading, as a fraction of the light of both sides, in which an edge is located."""
SAMPLES = np.arange(-HALF_PX, HALF_PX + STEP_PX / 2, STEP_PX)
INNER, OUTER = SAMPLES <= -LEVEL_PX, SAMPLES >= LEVEL_PX


def edges_in_light(
    image: NDArray[np.float32], pixels: Floats, outward: Floats, near_px: Floats
) -> tuple[Floats, NDArray[np.bool_]]:
    """Locate edges along lines through points of an outline.

    Args:
        image: image (H, W, C), linear in light.
        pixels: points (N, 2), pixel centres at half-integers.
        outward: unit vectors (N, 2) across the edge, out of the tooth.
        near_px: approximate distances (N,) of the edges from the points, outwards.

    Returns:
        Distances (N,) in px of the edges from the points, outwards, and a mask (N,) of the edges that could be located;
        the others keep ``near_px``.
    """
    shift, is_located = _locate(image, pixels + near_px[:, None] * outward, outward)
    # Repeat from the position found, because samples that are not centred on an edge miss more of its blur on one side.
    second_shift, is_located_again = _locate(image, pixels + (near_px + shift)[:, None] * outward, outward)
    is_located &= is_located_again & (np.abs(shift + second_shift) < FARTHEST_PX)
    return np.where(is_located, near_px + shift + second_shift, near_px), is_located


def _locate(image: NDArray[np.float32], pixels: Floats, outward: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    profile, is_within = _sampled(image, pixels[:, None] + SAMPLES[:, None] * outward[:, None])
    inside, outside = profile[:, INNER].mean(axis=1), profile[:, OUTER].mean(axis=1)
    share, is_located = _inner_share(profile, outside)
    unshaded, is_unshaded = _inner_share_in_any_shade(profile, inside, outside)
    coloured = _colour_distance(inside, outside) > COLOURED
    share, is_located = np.where(coloured[:, None], unshaded, share), np.where(coloured, is_unshaded, is_located)
    shift = np.trapezoid(share, SAMPLES, axis=1) - HALF_PX
    is_located &= is_within & (np.abs(shift) < FARTHEST_PX)
    return np.where(is_located, shift, 0.0), is_located


def _sampled(image: NDArray[np.float32], place: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    # Return the light (N, S, C) at positions (N, S, 2), and a mask of the rows that lie in the image.
    import cv2

    height, width, channels = image.shape
    x, y = (np.ascontiguousarray(place[..., k] - 0.5, dtype=np.float32) for k in range(2))
    planes = [np.ascontiguousarray(image[..., k]) for k in range(channels)]
    found = [cv2.remap(plane, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for plane in planes]
    is_within = ((x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)).all(axis=1)
    return np.stack(found, axis=-1).astype(np.float64), is_within


def _inner_share(profile: Floats, outside: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    # A tooth darkens towards its rim, so its light is extrapolated along a line; the light behind it does not depend on
    # the rim and is taken as constant.
    line = np.stack([np.ones_like(SAMPLES), SAMPLES], axis=1)
    inside = np.einsum("sk,kt,ntc->nsc", line, np.linalg.pinv(line[INNER]), profile[:, INNER])
    # Project on the difference between inner and outer light at the edge.
    contrast = inside - outside[:, None]
    edge_contrast = contrast[:, len(SAMPLES) // 2]
    full_contrast = np.einsum("nsc,nc->ns", contrast, edge_contrast)
    is_located = (full_contrast > 0).all(axis=1)
    projected = np.einsum("nsc,nc->ns", profile - outside[:, None], edge_contrast)
    return projected / np.where(is_located[:, None], full_contrast, 1.0), is_located


def _inner_share_in_any_shade(profile: Floats, inside: Floats, outside: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    # Write the light as a sum of the inner and the outer colour. Shading on both changes only the sum of the two
    # amounts, not their ratio.
    colours = np.stack([inside, outside], axis=2)
    amounts = np.einsum("nkc,nsc->nsk", np.linalg.pinv(colours), profile)
    both = amounts.sum(axis=2)
    is_located = (both > DARKEST).all(axis=1)
    return amounts[..., 0] / np.where(is_located[:, None], both, 1.0), is_located


def _colour_distance(inside: Floats, outside: Floats) -> Floats:
    # Return the distance (N,) of the outer light from the colour of the inner light, divided by the inner light.
    size = np.maximum((inside**2).sum(axis=1), np.finfo(np.float64).tiny)
    apart = outside - ((inside * outside).sum(axis=1) / size)[:, None] * inside
    return np.asarray(np.linalg.norm(apart, axis=1) / np.sqrt(size))
