"""Results of a fit by a dictionary of few atoms: each atom's part of the scattering, and sizes where the atoms are
spheres.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.slab.cell.dictionary import Material
from services.slab.dictionaries.chosen import ChosenDictionary, Spheres
from services.slab.results.result import Quantity, SlabUnit
from services.slab.solve.mixture import Mixture
from services.slab.solve.uncertainty import LARGEST_COEFFICIENT_SHARE, Uncertainty

Array = NDArray[np.float64]

LARGEST_SIZE_SHARE = 0.1
"""Largest standard error, as a share of the value, at which a radius or a volume is determined."""


def atoms_of(dictionary: ChosenDictionary, material: Material, uncertainty: Uncertainty) -> dict[str, Quantity]:
    """Quantities by the names of ``parameters.json``: ``atoms.<name>`` is an atom's part of sigma_s; empty where there
    are no atoms.

    For spheres also ``volumes.<name>``, their share of the sample's volume, ``volume_fraction``, which is the sum of
    these, and ``mean_radius``, the mean by volume.
    """
    if not isinstance(material, Mixture):
        return {}
    weights, sigma_s = material.atom_weights, material.scattering_per_mm
    unit_slopes = np.eye(len(weights))
    quantities = {
        f"atoms.{name}": _quantity(float(weight), slope, uncertainty, "1/mm", LARGEST_COEFFICIENT_SHARE * sigma_s)
        for name, weight, slope in zip(dictionary.names, weights, unit_slopes, strict=True)
    }
    if dictionary.spheres is None:
        return quantities
    return (
        _of_spheres(dictionary.spheres, weights, uncertainty) | quantities | _volumes(dictionary, weights, uncertainty)
    )


def _of_spheres(spheres: Spheres, weights: Array, uncertainty: Uncertainty) -> dict[str, Quantity]:
    parts = spheres.volume_mm * weights
    total = float(parts.sum())
    mean_um = float(parts @ spheres.radii_um) / total
    slope_of_mean = spheres.volume_mm * (spheres.radii_um - mean_um) / total
    return {
        "volume_fraction": _quantity(total, spheres.volume_mm, uncertainty, "1", LARGEST_SIZE_SHARE * total),
        "mean_radius": _quantity(mean_um, slope_of_mean, uncertainty, "um", LARGEST_SIZE_SHARE * mean_um),
    }


def _volumes(dictionary: ChosenDictionary, weights: Array, uncertainty: Uncertainty) -> dict[str, Quantity]:
    assert dictionary.spheres is not None
    factors = dictionary.spheres.volume_mm
    max_error = LARGEST_SIZE_SHARE * float(factors @ weights)
    return {
        f"volumes.{name}": _quantity(float(factor * weight), factor * slope, uncertainty, "1", max_error)
        for name, factor, weight, slope in zip(dictionary.names, factors, weights, np.eye(len(weights)), strict=True)
    }


def _quantity(value: float, slope: Array, uncertainty: Uncertainty, unit: SlabUnit, max_error: float) -> Quantity:
    """A quantity from its derivatives with respect to the weights; determined where its error, and that by the images
    alone, are at most ``max_error``.
    """
    by_unknowns = np.append(slope, 0.0)
    chosen, alone = (float(np.sqrt(by_unknowns @ one @ by_unknowns)) for one in uncertainty.of_unknowns)
    return Quantity(value=value, se=chosen, unit=unit, determined=max(chosen, alone) <= max_error)
