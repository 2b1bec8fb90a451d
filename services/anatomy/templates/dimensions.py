"""Average dimensions of the upper teeth and root lengths of both jaws: Wheeler's averages, some recalled from memory,
all in steps of 0.5 mm.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from services.core.errors import CaptureInputError

Status = Literal["Wheeler", "from memory"]
"""``Wheeler``: Wheeler's table of averages (Wheeler's Dental Anatomy, Physiology and Occlusion); ``from memory``: the
same table, recalled."""


@dataclass(frozen=True)
class ToothDimensions:
    """Average dimensions of one kind of upper tooth."""

    name: str
    position: int
    """Place from the midline: the second digit of the FDI number."""
    crown_length_mm: float
    """Length from the cervical line to the incisal edge or highest cusp."""
    md_crown_mm: float
    """Mesiodistal diameter of the crown, at its widest."""
    md_cervix_mm: float
    """Mesiodistal diameter at the cervix."""
    ll_crown_mm: float
    """Labio- or buccolingual diameter of the crown, at its widest."""
    ll_cervix_mm: float
    """Labio- or buccolingual diameter at the cervix."""
    curvature_mesial_mm: float
    """Rise of the cervical line towards the edge on the mesial side."""
    curvature_distal_mm: float
    """Rise of the cervical line towards the edge on the distal side."""
    status: Status
    """Source of the values."""


UPPER_TEETH = (
    ToothDimensions("central incisor", 1, 10.5, 8.5, 7.0, 7.0, 6.0, 3.5, 2.5, "Wheeler"),
    ToothDimensions("lateral incisor", 2, 9.0, 6.5, 5.0, 6.0, 5.0, 3.0, 2.0, "Wheeler"),
    ToothDimensions("canine", 3, 10.0, 7.5, 5.5, 8.0, 7.0, 2.5, 1.5, "from memory"),
    ToothDimensions("first premolar", 4, 8.5, 7.0, 5.0, 9.0, 8.0, 1.0, 0.0, "from memory"),
    ToothDimensions("second premolar", 5, 8.5, 7.0, 5.0, 9.0, 8.0, 1.0, 0.0, "from memory"),
    ToothDimensions("first molar", 6, 7.5, 10.0, 8.0, 11.0, 10.0, 1.0, 0.0, "from memory"),
    ToothDimensions("second molar", 7, 7.0, 9.0, 7.0, 11.0, 10.0, 1.0, 0.0, "from memory"),
    ToothDimensions("third molar", 8, 6.5, 8.5, 6.5, 10.0, 9.5, 1.0, 0.0, "from memory"),
)


UPPER_ROOTS_MM = (13.0, 13.0, 17.0, 14.0, 14.0, 13.0, 12.0, 11.0)
LOWER_ROOTS_MM = (12.5, 14.0, 16.0, 14.0, 14.5, 14.0, 13.0, 11.0)
"""Lengths from cervical line to apex, mm, of the teeth at the places 1 to 8 from the midline, recalled from Wheeler's
table of averages; for molars that of the longest root."""


def root_length_mm(position: int, *, is_upper: bool) -> float:
    """Average root length of the tooth at a place 1 to 8 from the midline."""
    return (UPPER_ROOTS_MM if is_upper else LOWER_ROOTS_MM)[position - 1]


def upper_tooth(position: int) -> ToothDimensions:
    """Dimensions of the tooth at a place 1 to 8 from the midline.

    Raises:
        CaptureInputError: no tooth has this place.
    """
    if not 1 <= position <= len(UPPER_TEETH):
        raise CaptureInputError(
            f"No tooth stands at place {position} from the midline; FDI numbers end in 1 to {len(UPPER_TEETH)}, so"
            " renumber the tooth."
        )
    return UPPER_TEETH[position - 1]
