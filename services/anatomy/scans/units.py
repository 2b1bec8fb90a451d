"""Check of a scan's unit of length by the distances between its teeth."""

from __future__ import annotations

from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from services.anatomy.templates.average_arch import is_upper, side_of_front
from services.anatomy.templates.dimensions import upper_tooth
from services.core.errors import MeshError

Unit = Literal["mm", "cm", "m", "um", "inch"]

MM_PER_UNIT = MappingProxyType({"mm": 1.0, "cm": 10.0, "m": 1000.0, "um": 0.001, "inch": 25.4})
PLAUSIBLE_RATIO = (0.6, 1.6)
"""Smallest and largest plausible ratio of the distance between neighbouring teeth to that of average upper teeth, as a
median over a jaw. Lower incisors are narrower by a third, a person's teeth differ from the average by up to 20 %, and
crowded or gapped arches by as much again."""


def neighbour_ratio(teeth: tuple[int, ...], middles: NDArray[np.float64]) -> float | None:
    """Median distance between the middles (N, 3) of neighbouring teeth, relative to average widths in mm.

    It is None if no two of the teeth are neighbours.
    """
    along = {side_of_front(fdi) * (fdi % 10) - (side_of_front(fdi) > 0): k for k, fdi in enumerate(teeth)}
    ratios = [
        float(np.linalg.norm(middles[along[position + 1]] - middles[k]))
        / _pitch_mm(teeth[k], teeth[along[position + 1]])
        for position, k in along.items()
        if position + 1 in along and is_upper(teeth[k]) == is_upper(teeth[along[position + 1]])
    ]
    return float(np.median(ratios)) if ratios else None


def require_anatomical_scale(teeth: tuple[int, ...], middles_mm: NDArray[np.float64], unit: Unit, what: str) -> None:
    """Refuse a scan whose teeth are implausibly far apart or close together, and name the unit that would fit.

    Args:
        teeth: FDI numbers of the teeth.
        middles_mm: middles (N, 3) of the crowns, after conversion from ``unit``.
        unit: assumed unit of the scan.
        what: the scan's name for the message.

    Raises:
        MeshError: the distances are implausible; the message names a unit that fits, if there is one.
    """
    ratio = neighbour_ratio(teeth, middles_mm)
    if ratio is None or PLAUSIBLE_RATIO[0] <= ratio <= PLAUSIBLE_RATIO[1]:
        return
    scaled = {name: ratio * factor / MM_PER_UNIT[unit] for name, factor in MM_PER_UNIT.items()}
    fitting = sorted(
        (name for name, value in scaled.items() if PLAUSIBLE_RATIO[0] <= value <= PLAUSIBLE_RATIO[1]),
        key=lambda name: abs(float(np.log(scaled[name]))),
    )
    problem = f"Teeth in {what} stand {ratio:.3g} times as far apart as average ones if its unit is {unit}"
    remedy = f"it seems to be in {fitting[0]}: say units = '{fitting[0]}'" if fitting else "export it in millimetres"
    raise MeshError(f"{problem}; {remedy}.")


def _pitch_mm(one: int, two: int) -> float:
    return (upper_tooth(one % 10).md_crown_mm + upper_tooth(two % 10).md_crown_mm) / 2
