"""Decides by the outlines in a camera's images under different lights whether the subject moved.

That it did not is the null hypothesis: an image stays where it is unless its outline lies farther from that of the
first image than its error explains, by both halves of the outline alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

MOVED_PX = 0.5
"""Smallest translation that is taken out of an image. A smaller one is within the errors of most outlines, and
resampling would blur as much as it aligns."""
MOVED_ERRORS = 3.0
"""Standard errors of either component beyond which a translation is no error: one still image in a hundred lies there
if errors are Gaussian."""
AGREEMENT = 0.5
"""Share of a translation that either half of the outline has to show along it."""


def decided(shifts_px: FloatArray, errors_px: FloatArray, arcs_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Displacements of a body in some images since the first one, and their standard errors.

    Args:
        shifts_px: (L, 2) translations from where the scan is, in the order of the images.
        errors_px: (L,) their standard errors by component; infinite where nothing is known.
        arcs_px: (L, 2, 2) the same translations by odd and by even arcs.

    Returns:
        Displacements (L, 2), zero for all images that are taken for still, and standard errors (L,) by component. An
        image of which little or nothing is known keeps its place with an error of ``MOVED_PX``.
    """
    known = np.isfinite(errors_px)
    errors = np.where(known, errors_px, MOVED_PX)
    # The place of the still images is that of the first well known one, and then the mean of all that are near it
    is_certain = errors <= np.maximum(MOVED_PX, np.where(known, errors, np.inf).min())
    first = int(np.argmax(known & is_certain))
    place, place_error = shifts_px[first], float(errors[first])
    for _ in range(2):
        near = known & ~_is_far(shifts_px - place, np.hypot(errors, place_error))
        near[first] = True
        weight = errors[near] ** -2.0
        place, place_error = weight @ shifts_px[near] / weight.sum(), float(weight.sum() ** -0.5)
    total, displacement = np.hypot(errors, place_error), shifts_px - place
    is_far = known & _is_far(displacement, total)
    is_far[first] = False
    moved = is_far & _do_arcs_agree(displacement, arcs_px - place)
    # An image that stays may have moved as far as its outline says, also where both halves of it disagree
    left = np.linalg.norm(np.where(moved[:, None], 0.0, displacement), axis=-1) / np.sqrt(2)
    error = np.hypot(total, left)
    return np.where(moved[:, None], displacement, 0.0), np.where(is_far, error, np.minimum(error, MOVED_PX))


def _is_far(displacement: FloatArray, error: FloatArray) -> NDArray[np.bool_]:
    return np.asarray(np.linalg.norm(displacement, axis=-1) > np.maximum(MOVED_PX, MOVED_ERRORS * error))


def _do_arcs_agree(displacement: FloatArray, arcs: FloatArray) -> NDArray[np.bool_]:
    length = np.linalg.norm(displacement, axis=-1)
    direction = displacement / np.maximum(length, 1e-12)[:, None]
    along = (arcs * direction[:, None]).sum(axis=-1)
    return np.asarray((along > AGREEMENT * length[:, None]).all(axis=-1))
