"""Order of a scan's teeth along their arch, which tells exchanged numbers."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from services.anatomy.templates.average_arch import side_of_front
from services.core.errors import MeshError

MIN_GAIN_MM = 4.0
"""Least length by which an exchange of two numbers shortens the way along the arch, mm, where it counts as a mistake:
the narrowest neighbours stand 5 mm apart, and a wrong number adds at least that."""

ALIKE_MM = 1.0
"""Difference of two such lengths that says nothing, mm: people's arches are not symmetric."""


def require_order(teeth: tuple[int, ...], middles_mm: NDArray[np.float64], what: str) -> None:
    """Refuse teeth whose numbers do not follow each other along the arch.

    Args:
        teeth: FDI numbers of the teeth.
        middles_mm: middles (N, 3) of their crowns.
        what: the scan's name for the message.

    Raises:
        MeshError: the way along the arch is shorter with the numbers of two teeth exchanged; the message names them.
    """
    order = sorted(range(len(teeth)), key=lambda k: side_of_front(teeth[k]) * (teeth[k] % 10))
    along = middles_mm[order]
    gains_mm = {}
    for one, other in combinations(range(len(order)), 2):
        exchanged = along.copy()
        exchanged[[one, other]] = along[[other, one]]
        gains_mm[one, other] = _length(along) - _length(exchanged)

    # Of exchanges that shorten the way alike, as the mirror image of the right order does, take that of the two
    # nearest to each other.
    most_mm = max(gains_mm.values(), default=0.0)
    if most_mm > MIN_GAIN_MM:
        alike = [pair for pair, gain_mm in gains_mm.items() if gain_mm > most_mm - ALIKE_MM]
        one, other = min(alike, key=lambda pair: pair[1] - pair[0])
        first, second = sorted((teeth[order[one]], teeth[order[other]]))
        raise MeshError(
            f"Teeth {first} and {second} of {what} do not stand in the order of their numbers; exchange the two"
            " numbers."
        )


def _length(points_mm: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(np.diff(points_mm, axis=0), axis=1).sum())
