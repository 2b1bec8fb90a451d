"""Rigid alignment of a list of light positions, measured in a frame of its own, with the positions found from
highlights.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.calibrate.cameras.rotations import pose_matrix, pose_vector

Floats = NDArray[np.float64]
MIN_LIGHTS = 4
"""Smallest number of lights for an alignment: three determine a rigid motion, the fourth checks it."""
ROUNDS = 20
"""Number of rounds of the reweighted alignment."""
CAUCHY_SIGMAS = 3.0
"""Distance in σ at which a light's weight is halved: a good list loses almost nothing, and a light that is off by 10 σ
keeps a tenth of its weight."""
NOISE_FLOOR_MM = 0.5
"""Smallest σ of a list: nobody measures a lamp's position better by hand."""
OUTLIER_SIGMAS = 5.0
"""Distance in σ beyond which a light is an outlier."""
MIRRORED_TIMES = 5.0
"""Ratio of σ to that of the mirrored list above which the list counts as mirrored. Lights in one plane fit equally well
mirrored, and a right-handed list never fits five times better when mirrored."""
MIN_OUTLIER_MM = 20.0
"""Smallest distance of an outlier. Coordinates of a list measured by hand are off by some 4 mm, so lights closer than
this are not misplaced, however well the few lights fit."""
MEDIAN_LENGTH_SIGMAS = 1.538
"""Median length of a vector with three normal coordinates, in units of their σ."""


@dataclass(frozen=True)
class AlignedList:
    """A list of light positions in the world frame.

    Attributes:
        positions_mm: positions of all listed lights (L, 3).
        sigma_mm: standard deviation of one coordinate of the list about the found positions.
        distances_mm: distance between listed and found position (L,), NaN where no highlight was found.
        outliers: numbers of the lights that do not lie where they are listed.
        scale: median ratio of the distances between found lights to those between listed lights.
        is_mirrored: whether the list's mirror image fits far better, so that its frame is left-handed.
    """

    positions_mm: Floats
    sigma_mm: float
    distances_mm: Floats
    outliers: tuple[int, ...]
    scale: float
    is_mirrored: bool


def align_list(listed_mm: Floats, found_mm: Floats) -> AlignedList | None:
    """Align a list with the found lights by the rigid motion of least weighted squares (Kabsch 1976), with Cauchy's
    weights.

    Args:
        listed_mm: positions in the list's frame (L, 3).
        found_mm: positions in the world (L, 3), NaN where a light was not found.

    Returns:
        The aligned list; None where fewer than four lights were found.
    """
    known = np.isfinite(found_mm).all(axis=1)
    if np.count_nonzero(known) < MIN_LIGHTS:
        return None
    source, target = listed_mm[known], found_mm[known]
    motion, off, sigma = _robust_alignment(source, target)
    mirrored = source * [-1.0, 1.0, 1.0]
    distances = np.full(len(listed_mm), np.nan)
    distances[known] = off
    bad = np.flatnonzero(np.nan_to_num(distances) > max(OUTLIER_SIGMAS * sigma, MIN_OUTLIER_MM))
    return AlignedList(
        positions_mm=_moved(motion, listed_mm),
        sigma_mm=sigma,
        distances_mm=distances,
        outliers=tuple(int(n) for n in bad),
        scale=_scale(source, target),
        is_mirrored=MIRRORED_TIMES * _robust_alignment(mirrored, target)[2] < sigma,
    )


def _robust_alignment(source: Floats, target: Floats) -> tuple[Floats, Floats, float]:
    """Return the rigid motion (4, 4) of the alignment, the remaining distances (N,) in mm, and the standard deviation
    of one coordinate in mm.
    """
    weights = np.ones(len(source))
    for _ in range(ROUNDS):
        motion = _rigid(source, target, weights)
        off = np.linalg.norm(_moved(motion, source) - target, axis=1)
        sigma = max(float(np.median(off)) / MEDIAN_LENGTH_SIGMAS, NOISE_FLOOR_MM)
        weights = 1 / (1 + (off / (CAUCHY_SIGMAS * sigma)) ** 2)
    return motion, off, sigma


def _scale(source: Floats, target: Floats) -> float:
    """Return the median ratio, found to listed, of the distances between pairs of lights; it does not depend on the
    motion, and a few wrong lights do not change it.
    """
    one, two = np.triu_indices(len(source), 1)
    listed, found = (np.linalg.norm(points[one] - points[two], axis=1) for points in (source, target))
    is_apart = listed > NOISE_FLOOR_MM
    return float(np.median(found[is_apart] / listed[is_apart])) if is_apart.any() else 1.0


def swapped_names(found_mm: Floats, aligned: AlignedList) -> list[tuple[int, int]]:
    """Return pairs (a, b) where outlier a was found at the listed position of light b, within the list's scatter."""
    limit = max(OUTLIER_SIGMAS * aligned.sigma_mm, MIN_OUTLIER_MM)
    pairs = []
    for one in aligned.outliers:
        off = np.linalg.norm(aligned.positions_mm - found_mm[one], axis=1)
        nearest = int(np.argmin(off))
        if nearest != one and off[nearest] <= limit:
            pairs.append((one, nearest))
    return pairs


def _rigid(source: Floats, target: Floats, weights: Floats) -> Floats:
    share = weights / weights.sum()
    source_centre, target_centre = share @ source, share @ target
    u, _, vt = np.linalg.svd((target - target_centre).T @ (share[:, None] * (source - source_centre)))
    rotation = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = rotation, target_centre - rotation @ source_centre
    return pose_matrix(pose_vector(motion))


def _moved(motion: Floats, points: Floats) -> Floats:
    return np.asarray(points @ motion[:3, :3].T + motion[:3, 3])
