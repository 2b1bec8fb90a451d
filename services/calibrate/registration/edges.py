"""Where an edge lies to a small part of a pixel: by how much light it lets through, not by what its pixels look like.

A pixel that shows two things is a mean of their light, so the share of the inner one's light across an edge sums to
where the edge is, however wide the lens, the pixels and a mosaic's interpolation make it. Likeness to tooth is no such
mean: a pixel of the dark with a fifth of tooth in it has a tooth's colour and a shaded tooth's brightness, and looks
like tooth.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.calibrate.registration.pose import Floats

STEP_PX = 0.5
"""Between samples across an edge."""
HALF_PX, LEVEL_PX = 4.0, 2.0
"""Samples reach so far to both sides; those beyond the second tell the light of either side. A pixel, a mosaic's
interpolation and a lens together blur an edge by up to 1 px of standard deviation, of which 2 px leave a fortieth."""
FARTHEST_PX = 1.5
"""An edge farther from where it was looked for is another one's."""
COLOURED = 0.05
"""Of the inner light: how far the outer one lies from its colour where a shade across both can be told from the edge.
Gums come to 0.15, the dark of the mouth to less than 0.01."""
DARKEST = 0.2
"""Of both sides' light together: in a darker shade nothing is told."""
SAMPLES = np.arange(-HALF_PX, HALF_PX + STEP_PX / 2, STEP_PX)
INNER, OUTER = SAMPLES <= -LEVEL_PX, SAMPLES >= LEVEL_PX


def edges_in_light(
    image: NDArray[np.float32], pixels: Floats, outward: Floats, near_px: Floats
) -> tuple[Floats, NDArray[np.bool_]]:
    """Distances (N,) of edges from points, and whether there is one that can be told.

    Args:
        image: (H, W, C), linear in light.
        pixels: (N, 2), pixel centres at half-integers.
        outward: (N, 2), unit vectors across the edge, out of the tooth.
        near_px: (N,) from the points along these, to where an edge is.
    """
    moved, is_told = _looked_at(image, pixels + near_px[:, None] * outward, outward)
    # Once more from there: samples that lie unevenly about an edge lose more of its blur on one side.
    again, is_told_again = _looked_at(image, pixels + (near_px + moved)[:, None] * outward, outward)
    is_told &= is_told_again & (np.abs(moved + again) < FARTHEST_PX)
    return np.where(is_told, near_px + moved + again, near_px), is_told


def _looked_at(image: NDArray[np.float32], pixels: Floats, outward: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    seen, is_within = _sampled(image, pixels[:, None] + SAMPLES[:, None] * outward[:, None])
    inside, outside = seen[:, INNER].mean(axis=1), seen[:, OUTER].mean(axis=1)
    share, is_told = _share(seen, outside)
    unshaded, is_unshaded = _share_in_any_shade(seen, inside, outside)
    coloured = _away(inside, outside) > COLOURED
    share, is_told = np.where(coloured[:, None], unshaded, share), np.where(coloured, is_unshaded, is_told)
    moved = np.trapezoid(share, SAMPLES, axis=1) - HALF_PX
    is_told &= is_within & (np.abs(moved) < FARTHEST_PX)
    return np.where(is_told, moved, 0.0), is_told


def _sampled(image: NDArray[np.float32], place: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    # Light (N, S, C) at places (N, S, 2), and which rows lie in the image.
    import cv2

    height, width, channels = image.shape
    x, y = (np.ascontiguousarray(place[..., k] - 0.5, dtype=np.float32) for k in range(2))
    planes = [np.ascontiguousarray(image[..., k]) for k in range(channels)]
    found = [cv2.remap(plane, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for plane in planes]
    is_within = ((x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)).all(axis=1)
    return np.stack(found, axis=-1).astype(np.float64), is_within


def _share(seen: Floats, outside: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    # A tooth darkens towards its rim, so its light is carried on along a line; what is behind it knows nothing of the
    # rim.
    line = np.stack([np.ones_like(SAMPLES), SAMPLES], axis=1)
    inside = np.einsum("sk,kt,ntc->nsc", line, np.linalg.pinv(line[INNER]), seen[:, INNER])
    # The way from the outer light to the inner, along their difference at the edge.
    way = inside - outside[:, None]
    across = way[:, len(SAMPLES) // 2]
    whole = np.einsum("nsc,nc->ns", way, across)
    is_told = (whole > 0).all(axis=1)
    gone = np.einsum("nsc,nc->ns", seen - outside[:, None], across)
    return gone / np.where(is_told[:, None], whole, 1.0), is_told


def _share_in_any_shade(seen: Floats, inside: Floats, outside: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    # Light is so much of the inner and so much of the outer colour; a shade on both changes their sum alone.
    colours = np.stack([inside, outside], axis=2)
    amounts = np.einsum("nkc,nsc->nsk", np.linalg.pinv(colours), seen)
    both = amounts.sum(axis=2)
    is_told = (both > DARKEST).all(axis=1)
    return amounts[..., 0] / np.where(is_told[:, None], both, 1.0), is_told


def _away(inside: Floats, outside: Floats) -> Floats:
    # Distance (N,) of the outer light from the inner one's colour, over the inner light.
    size = np.maximum((inside**2).sum(axis=1), np.finfo(np.float64).tiny)
    apart = outside - ((inside * outside).sum(axis=1) / size)[:, None] * inside
    return np.asarray(np.linalg.norm(apart, axis=1) / np.sqrt(size))
