"""Start of a jaw's joint fit: each tooth from a fit of its own pixels, hidden teeth and those whose fit failed from the
others, gums from a fit of their own, and the cavity's wall from the gums.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from services.core.errors import InputError, MeshError, NonFiniteError
from services.fit.coordinates.domain import HELD_G, similar_tissue, to_dual, to_natural
from services.fit.coordinates.priors import GUMS_START
from services.transport.optics.half_space import half_space_reflectance
from services.transport.optics.parameters import Medium, Mouth, Tissue

MIN_TOOTH_PIXELS = 16
"""Least number of fitted pixels of a tooth over all views. A tooth with fewer is tied to the others, because so few do
not determine four parameters of media and their misfit."""
FRONT_DIGITS = (1, 2, 3)
"""Last digits of the FDI numbers of incisors and canines, which are lit and seen best (teeth 2018, section 7)."""
TOOTH_ERRORS = (InputError, NonFiniteError)
"""Errors that the data or meshes of one tooth can cause. Any other error has its cause in the machine or in its
operation and ends the job."""


@dataclass(frozen=True)
class ToothStart:
    """Start of one tooth."""

    fdi: int
    state: Literal["fitted", "tied", "failed"]
    sentence: str
    pixels: int
    tissue: Tissue | None
    """Tissue parameters; None where the tooth takes those of the others."""
    drops_dentin: bool = False
    """Whether its surfaces cannot bound media together, so that it is fitted as homogeneous."""

    @property
    def is_front(self) -> bool:
        """Whether the tooth is an incisor or a canine."""
        return self.fdi % 10 in FRONT_DIGITS


def start_tooth(fdi: int, pixels: int, fit: Callable[[], Tissue]) -> ToothStart:
    """Fit one tooth alone, unless too few of its pixels are fitted; an error that its own data or meshes cause becomes
    its state.
    """
    if pixels < MIN_TOOTH_PIXELS:
        visibility = f"shows in {pixels} usable pixels" if pixels else "is hidden or masked in every image"
        return ToothStart(
            fdi,
            "tied",
            f"Tooth {fdi} {visibility}, so its optics are held near those of the other teeth.",
            pixels,
            None,
        )
    try:
        return ToothStart(fdi, "fitted", "", pixels, fit())
    except TOOTH_ERRORS as problem:
        sentence = f"Tooth {fdi} could not be fitted and takes the optics of the other teeth: {problem.message}"
        return ToothStart(fdi, "failed", sentence, pixels, None, drops_dentin=isinstance(problem, MeshError))


def median_tissue(starts: Sequence[ToothStart], teeth: Sequence[Tissue | None]) -> Tissue:
    """Median tissue of the front teeth that were fitted, coordinate by coordinate, at mean cosine ``HELD_G``; where
    none of them was fitted, of all fitted teeth.

    Args:
        starts: start of each tooth.
        teeth: present tissue of each tooth, None where there is none yet.

    Raises:
        InputError: no tooth was fitted.
    """
    fitted = [
        (start, tissue)
        for start, tissue in zip(starts, teeth, strict=True)
        if start.state == "fitted" and tissue is not None
    ]
    chosen = [similar_tissue(tissue, HELD_G) for start, tissue in fitted if start.is_front] or [
        similar_tissue(tissue, HELD_G) for _, tissue in fitted
    ]
    if not chosen:
        raise InputError(f"No tooth of the jaw can be fitted; the first one says: {starts[0].sentence}")

    def median(part: str) -> Medium:
        values = {
            kind: to_natural(kind, statistics.median(to_dual(kind, getattr(t.medium(part), kind)) for t in chosen))
            for kind in ("sigma", "alpha")
        }
        return Medium(values["sigma"], values["alpha"], g1=HELD_G)

    return Tissue(median("enamel"), median("dentin"))


def start_mouth(starts: Sequence[ToothStart], gums: Medium | None, *, has_cavity: bool) -> Mouth:
    """Start of all parts of a mouth; the cavity's wall reflects like a half space of the gums (teeth 2018, section
    4.3).
    """
    common = median_tissue(starts, [start.tissue for start in starts])
    teeth = tuple(start.tissue or common for start in starts)
    return Mouth(teeth, gums, half_space_reflectance(gums or GUMS_START) if has_cavity else None)
