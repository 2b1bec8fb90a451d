"""Part of a jaw that each pixel of the photographs shows, by casting a ray through it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from services.core.errors import CaptureInputError
from services.fit.measurements.blocks import CAVITY, GUMS, PixelParts
from services.fit.measurements.observations import Observations
from services.fit.measurements.view_stack import ViewStack
from services.transport.rays import RayScene


def label_views(views: Sequence[ViewStack], observations: Observations) -> tuple[ViewStack, ...]:
    """The views with the part that each pixel shows at its centre; pixels whose centre shows none are left out.

    Raises:
        CaptureInputError: no pixel shows anything.
    """
    from scipy.spatial import cKDTree

    surroundings = {
        part: mesh for part, mesh in ((GUMS, observations.gums), (CAVITY, observations.cavity)) if mesh is not None
    }
    numbers = np.array([*range(len(observations.teeth)), *surroundings], dtype=np.int16)
    scene = RayScene(*(tooth.outer for tooth in observations.teeth), *surroundings.values())
    nearest = cKDTree(np.concatenate([tooth.outer.vertices_mm for tooth in observations.teeth]))
    tooth_of = np.repeat(
        np.arange(len(observations.teeth), dtype=np.int16),
        [len(tooth.outer.vertices_mm) for tooth in observations.teeth],
    )

    labelled = []
    for view in views:
        x, y = view.pixels.T + 0.5
        hits = scene.first_hits(*view.camera.rays(x, y))
        shown = numbers[hits.mesh[hits.hit]]
        tooth = np.where(shown >= 0, shown, tooth_of[nearest.query(hits.points_mm[hits.hit])[1]]).astype(np.int16)
        if hits.hit.any():
            labelled.append(replace(view.of(hits.hit), parts=PixelParts(shown, tooth)))
    if not labelled:
        raise CaptureInputError(
            "No valid pixel shows a tooth, gums or cavity; check that meshes and cameras share one frame in"
            " millimetres."
        )
    return tuple(labelled)


def views_of_parts(views: Sequence[ViewStack], *parts: int) -> tuple[ViewStack, ...]:
    """Pixels that show one of some parts (position of a tooth, GUMS, CAVITY); views without such pixels are
    left out.
    """
    return _select(views, [np.isin(_parts(view).shown, parts) for view in views])


def views_without_teeth(views: Sequence[ViewStack], teeth: Sequence[int]) -> tuple[ViewStack, ...]:
    """Pixels that show none of these teeth."""
    return _select(views, [~np.isin(_parts(view).shown, teeth) for view in views])


def fitted_pixels(views: Sequence[ViewStack]) -> int:
    """Number of pixels, over all views, with a measurement that the fit may use."""
    return sum(int(view.fitted.any(axis=0).sum()) for view in views)


def _parts(view: ViewStack) -> PixelParts:
    assert view.parts is not None
    return view.parts


def _select(views: Sequence[ViewStack], chosen: Sequence[NDArray[np.bool_]]) -> tuple[ViewStack, ...]:
    return tuple(view.of(pixels) for view, pixels in zip(views, chosen, strict=True) if pixels.any())
