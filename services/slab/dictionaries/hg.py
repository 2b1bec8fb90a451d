"""Dictionary ``hg``: a mix of Henyey-Greenstein lobes of given mean cosines."""

from __future__ import annotations

import numpy as np

from services.slab.cell.dictionary import hg_values
from services.slab.dictionaries.chosen import ChosenDictionary, Sample
from services.slab.solve.mixture import Mixtures, unit_atoms

COSINES = (-0.9, -0.75, -0.6, -0.45, -0.3, -0.15, 0.0, 0.15, 0.3, 0.45, 0.6, 0.7, 0.8, 0.85, 0.9, 0.95)
"""Mean cosines, closer to each other where lobes are narrow: a lobe between two neighbours is their mix within 2 % of
its norm."""


def lobes(sample: Sample) -> ChosenDictionary:  # noqa: ARG001 - the same for every sample
    """One lobe for each of ``COSINES``."""
    values = np.stack([hg_values(g) for g in COSINES], axis=1)
    return ChosenDictionary(Mixtures(unit_atoms(values)), tuple(f"g={g:g}" for g in COSINES))
