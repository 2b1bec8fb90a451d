"""Dictionary ``tents``: a phase function that is linear between 200 angles, its logarithm held smooth."""

from __future__ import annotations

from services.slab.dictionaries.chosen import ChosenDictionary, Sample
from services.slab.solve.coordinates import Knots


def tents(sample: Sample) -> ChosenDictionary:  # noqa: ARG001 - the same for every sample
    """The 200 tents of Gkioulekas et al. (2013)."""
    return ChosenDictionary(Knots())
