"""Dictionary ``mie``: homogeneous spheres of many radii in the sample's medium (Lorenz-Mie theory).

The coefficients a_n and b_n come from miepython; the sums over orders are those of Bohren and Huffman (1983), section
4.4, so that no normalisation of a library's version enters.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
from numpy.typing import NDArray

from services.core.errors import PlatformError
from services.slab.cell.dictionary import ANGLES_RAD, KNOTS
from services.slab.dictionaries.chosen import ChosenDictionary, Sample, Spheres
from services.slab.solve.mixture import Mixtures, unit_atoms

Array = NDArray[np.float64]
Amplitudes = NDArray[np.complex128]

SMALLEST_SIZE, LARGEST_SIZE = 0.5, 30.0
"""Smallest and largest size parameter 2 pi n r / wavelength. Below, spheres scatter alike whatever their size; above,
the forward peak is as narrow as a tent."""
ATOMS = 84
"""Number of atoms, with a factor of 1.05 in radius from one to the next. With 1.10 spheres of one size came out 4 %
wrong in reduced scattering."""
RADII_PER_ATOM = 3
"""Number of radii over which an atom is averaged, spaced evenly in their logarithm: the rings of a single large sphere
belong to no real sample."""


def spheres(sample: Sample) -> ChosenDictionary:
    """One atom for each of ``ATOMS`` ranges of radius, evenly spaced in its logarithm.

    Raises:
        PlatformError: miepython is not installed.
    """
    options = sample.options
    assert options.particle_index is not None  # the options check this
    relative = complex(options.particle_index, options.particle_absorption) / sample.index
    um_per_size = sample.wavelength_nm / 1000 / (2 * math.pi * sample.index)
    edges = np.geomspace(SMALLEST_SIZE, LARGEST_SIZE, ATOMS + 1)
    radii, values, volumes = np.zeros(ATOMS), np.zeros((KNOTS, ATOMS)), np.zeros(ATOMS)
    for atom, (low, high) in enumerate(itertools.pairwise(edges)):
        sizes = np.exp(np.linspace(math.log(low), math.log(high), 2 * RADII_PER_ATOM + 1)[1::2])
        scattered_light = [scattered(relative, float(size)) for size in sizes]
        # An atom has as many spheres of each radius, so cross-sections and volumes add up.
        values[:, atom] = sum(intensity for intensity, _ in scattered_light)
        areas_um2 = (
            sum(efficiency * size**2 for (_, efficiency), size in zip(scattered_light, sizes, strict=True)) * math.pi
        )
        contents_um3 = 4 / 3 * math.pi * float((sizes**3).sum())
        volumes[atom] = contents_um3 / areas_um2 * um_per_size / 1000
        radii[atom] = math.sqrt(low * high) * um_per_size
    names = tuple(f"radius={radius:.3f}um" for radius in radii)
    return ChosenDictionary(Mixtures(unit_atoms(values)), names, Spheres(radii, volumes))


def scattered(relative_index: complex, size: float) -> tuple[Array, float]:
    """Light scattered by one sphere at the knots (KNOTS,), up to a factor that all spheres share, and its scattering
    efficiency.

    Args:
        relative_index: index of the sphere over that of its surroundings, imaginary part positive where it absorbs.
        size: 2 pi n r / wavelength.
    """
    a, b = _coefficients(relative_index, size)
    order = np.arange(1, len(a) + 1)
    efficiency = 2 / size**2 * float(((2 * order + 1) * (np.abs(a) ** 2 + np.abs(b) ** 2)).sum())
    pi, tau = _angular(len(a))
    weights = (2 * order + 1) / (order * (order + 1))
    first, second = pi @ (weights * a) + tau @ (weights * b), tau @ (weights * a) + pi @ (weights * b)
    return np.asarray((np.abs(first) ** 2 + np.abs(second) ** 2) / 2), efficiency


def _coefficients(relative_index: complex, size: float) -> tuple[Amplitudes, Amplitudes]:
    try:
        from miepython import an_bn
    except ImportError as problem:
        raise PlatformError(
            "dictionary = mie needs the package miepython; install dentine with its extra mie, or choose another"
            " dictionary."
        ) from problem
    # In miepython an absorbing sphere has a negative imaginary part.
    a, b = an_bn(relative_index.conjugate(), size)
    return np.asarray(a, dtype=np.complex128), np.asarray(b, dtype=np.complex128)


def _angular(orders: int) -> tuple[Array, Array]:
    """pi_n and tau_n at the knots (KNOTS, orders), by their recurrence."""
    cosine = np.cos(ANGLES_RAD)
    pi, tau = np.zeros((KNOTS, orders + 1)), np.zeros((KNOTS, orders + 1))
    pi[:, 1] = 1
    for n in range(1, orders + 1):
        if n > 1:
            pi[:, n] = (2 * n - 1) / (n - 1) * cosine * pi[:, n - 1] - n / (n - 1) * pi[:, n - 2]
        tau[:, n] = n * cosine * pi[:, n] - (n + 1) * pi[:, n - 1]
    return pi[:, 1:], tau[:, 1:]
