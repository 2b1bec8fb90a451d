"""Gaussian priors of the fit's coordinates, in the unbounded domain: weak ones, those of the literature, and those
towards other teeth.

sigma and g are nearly one parameter, and a fit holds g1 at ``HELD_G``. So a measured medium enters by its reduced
scattering and its absorption: a fit would report the medium that has these at that mean cosine.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np

from services.anatomy.neighbours import USUAL_WEIGHT
from services.fit.coordinates.domain import HELD_G, similar_medium, to_dual
from services.transport.optics.parameters import Medium

MIN_SD = {"sigma": 0.2, "alpha": 0.1}
"""Smallest standard deviation of a prior towards other teeth, however well few of them agree."""

Priors = Mapping[str, tuple[float, float]]
"""Mean and standard deviation in the unbounded domain, by name of the parameter; a parameter not named has a flat
prior."""

_LEAVES = {
    "g1": (to_dual("g1", 0.8), 0.35),
    "alpha": (2.3, 1.0),
    "beta": (to_dual("beta", 0.9), 1.0),
    "g2": (to_dual("g2", -0.1), 0.35),
}
WEAK: Priors = MappingProxyType(
    {f"{part}.{leaf}": prior for part in ("enamel", "dentin") for leaf, prior in _LEAVES.items()}
)
"""One-sigma ranges of g1: 0.64 to 0.89; 1 - alpha: 5e-4 to 5e-2; beta: 0.77 to 0.96; g2: -0.42 to 0.25."""
COSINE = (to_dual("cosine", 0.7), 0.35)
"""Prior of the mean cosine of a single lobe that replaces two: 0.48 to 0.84 (one sigma). Similarity of second order
gives 0.5 to 0.7 for the lobes of teeth."""
GUMS_START = Medium(8.5, 0.97, g1=HELD_G)
"""Generic soft tissue at the start: reduced scattering 1.65 per mm at 540 nm (Jacques 2013), absorption between that of
red and green."""
GUMS_SD = {"sigma": 1.0, "alpha": 0.7}
"""Prior standard deviations of the gums' parameters about their start, in the unbounded domain; wide, because gums were
never measured alone."""
SHAPE = (USUAL_WEIGHT, 0.3)
"""Prior of a blend weight."""


@dataclass(frozen=True)
class Measured:
    """Reduced scattering and absorption of one source, per mm; the absorption is None where the source gives none."""

    tissue: str
    wavelength_nm: float
    sigma_s_reduced: float
    sigma_a: float | None
    source: str


LITERATURE_TABLE = (
    Measured("enamel", 633, 2.11, None, "Zijp, ten Bosch & Groenhuis 1995"),
    Measured("enamel", 632, 0.24, 0.1, "Fried et al. 1995"),
    Measured("enamel", 780, 0.0287, 0.1, "Hoffmann et al. 2021"),
    Measured("enamel", 400, 0.08, 0.06, "Zoller et al. 2018"),
    Measured("enamel", 700, 0.02, 0.02, "Zoller et al. 2018"),
    Measured("dentin", 632, 1.96, 0.35, "Fried et al. 1995"),
    Measured("dentin", 780, 3.77, 0.35, "Hoffmann et al. 2021"),
    Measured("dentin", 400, 0.504, 0.2, "Zoller et al. 2018"),
    Measured("dentin", 700, 0.245, 0.1, "Zoller et al. 2018"),
)
"""Measurements of which both reduced scattering and source are known. Fried's absorption of enamel is an upper
limit."""


def towards(part: str, media: Iterable[Medium]) -> Priors:
    """Prior around the mean of other media, with their spread as its width: teeth of the same mouth (teeth 2018,
    section 7), or other authors' teeth.

    Args:
        part: ``enamel`` or ``dentin``, or with a tooth's number before it.
        media: at least one.
    """
    similar_media = [similar_medium(medium, HELD_G) for medium in media]
    priors = {}
    for leaf, least in MIN_SD.items():
        x = np.array([to_dual(leaf, getattr(medium, leaf)) for medium in similar_media])
        spread = float(x.std(ddof=1)) if len(x) > 1 else 0.0
        priors[f"{part}.{leaf}"] = (float(x.mean()), max(spread, least))
    return priors


def literature() -> Priors:
    """Prior towards ``LITERATURE_TABLE``; a source without absorption gets the geometric mean of the others'
    absorption.

    Lobes keep the weak priors.
    """
    priors = dict(WEAK)
    for part in ("enamel", "dentin"):
        rows = [row for row in LITERATURE_TABLE if row.tissue == part]
        usual = float(np.exp(np.mean([np.log(row.sigma_a) for row in rows if row.sigma_a is not None])))
        absorbed = [usual if row.sigma_a is None else row.sigma_a for row in rows]
        media = [
            Medium(row.sigma_s_reduced + a, row.sigma_s_reduced / (row.sigma_s_reduced + a))
            for row, a in zip(rows, absorbed, strict=True)
        ]
        priors |= towards(part, media)
    return priors


def priors_of(kind: Literal["weak", "literature"]) -> Priors:
    """The priors that a job's option names."""
    return WEAK if kind == "weak" else literature()
