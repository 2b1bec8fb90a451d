"""Slopes of photographs along x and y, and what a move of the scan changes in the pixels of a view."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from services.fit.measurements.blocks import BlockMotion
from services.fit.measurements.instrument.pose import brightenings, displacements
from services.fit.measurements.view_stack import ViewStack
from services.transport.scene.recipe import SceneRecipe

Array = NDArray[np.float64]

NEIGHBOURS = tuple((i, j) for j in (-1, 0, 1) for i in (-1, 0, 1) if (i, j) != (0, 0))
"""Pixels around each, in x and y, whose plane gives its slopes. On the micro-CT incisor wider windows and differences
of two pixels found a moved scan no nearer."""
MIN_SPREAD = 0.5
"""Least determinant of the second moments of the usable neighbours' places, px^4, for a pixel to have slopes."""


def image_slopes(image: Array, usable: NDArray[np.bool_]) -> Array:
    """Slopes per pixel along x and y of an image (H, W), and the variance of each in variances of a pixel, (4, H, W).

    They are those of the plane through the usable neighbours of each pixel, without the pixel itself, and 0 where the
    neighbours do not determine a plane.
    """
    size = image.shape
    count, first, second, values, products = (np.zeros((*leading, *size)) for leading in ((), (2,), (2, 2), (), (2,)))
    values_of, weights_of = (np.pad(one, 1) for one in (np.where(usable, image, 0.0), usable.astype(np.float64)))
    for offset in NEIGHBOURS:
        x, y = offset
        cut = slice(1 + y, 1 + y + size[0]), slice(1 + x, 1 + x + size[1])
        weight, value, place = weights_of[cut], values_of[cut], np.array(offset, dtype=np.float64)
        count += weight
        values += value
        first += place[:, None, None] * weight
        products += place[:, None, None] * value
        second += np.multiply.outer(np.outer(place, place), weight)
    number = np.maximum(count, 1.0)
    spread = second - first[:, None] * first[None] / number
    along = products - first * values / number
    determinant = spread[0, 0] * spread[1, 1] - spread[0, 1] ** 2
    is_known = determinant > MIN_SPREAD
    safe = np.where(is_known, determinant, 1.0)
    found = [
        (spread[1, 1] * along[0] - spread[0, 1] * along[1]) / safe,
        (spread[0, 0] * along[1] - spread[0, 1] * along[0]) / safe,
        spread[1, 1] / safe,
        spread[0, 0] / safe,
    ]
    return np.where(is_known, np.array(found), 0.0)


def motions_of(scene: SceneRecipe, views: Sequence[ViewStack]) -> list[BlockMotion]:
    """For each view, the changes of all of its pixels under all lights of a scene by moves of the scan, with the slopes
    of its photographs.
    """
    from scipy.spatial import cKDTree

    from services.transport.rays import RayScene

    surfaces = [tooth.outer for tooth in scene.all_teeth] + ([] if scene.gums is None else [scene.gums])
    centre_mm = np.concatenate([tooth.outer.vertices_mm for tooth in scene.teeth]).mean(axis=0)
    rays, vertices_mm = RayScene(*surfaces), np.concatenate([one.vertices_mm for one in surfaces])
    samples_mm, changes = brightenings(scene.teeth[0].outer, scene.light_positions_mm, centre_mm)
    nearest_sample, found = cKDTree(samples_mm), list[BlockMotion]()
    for view in views:
        x, y = view.pixels.T + 0.5
        hits = rays.first_hits(*view.camera.rays(x, y))
        points_mm = np.where(hits.hit[:, None], hits.points_mm, 0.0)
        if not hits.hit.all():
            # The ray through the centre of a pixel of the outline may miss: take the vertex that appears nearest.
            seen = cKDTree(view.camera.project(vertices_mm)[0])
            points_mm[~hits.hit] = vertices_mm[seen.query(np.stack([x, y], axis=-1)[~hits.hit])[1]]
        slopes = np.zeros((4, *view.reference.shape)) if view.slopes is None else view.slopes
        moved = displacements(view.camera, points_mm, centre_mm)
        brighter = changes[:, :, nearest_sample.query(points_mm)[1]]
        found.append(BlockMotion(slopes[:2], slopes[2:], moved, brighter, centre_mm))
    return found
