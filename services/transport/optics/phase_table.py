"""Phase functions given as tables: p(cos theta), linear in cos theta between nodes, normalised on the sphere.

Because values are piecewise linear in cos theta, all integrals have closed forms: the integral of a node's tent is pi
times the range of cosines that it spans, and a distribution is inverted by one square root. Nodes near a pole are
stored as deviations 1 - |cos theta| from it, which resolve even the narrowest peak.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.errors import InputError

FEWEST_NODES = 2


@dataclass(frozen=True)
class PhaseTable:
    """Phase function values at angles between propagation directions. They may be given in any unit and are normalised.

    Raises:
        InputError: fewer than two nodes, angles that do not increase from 0 to pi, or values that are negative, not
            finite or all zero.
    """

    angles_rad: tuple[float, ...]
    """Scattering angles from 0 to pi, increasing."""
    values: tuple[float, ...]
    """Phase function at each angle, 1/sr."""

    def __post_init__(self) -> None:
        angles = np.array(self.angles_rad, dtype=np.float64)
        values = tuple(float(value) for value in self.values)
        if len(values) < FEWEST_NODES or len(values) != len(angles):
            raise InputError(
                f"A phase table has {len(values)} values at {len(angles)} angles; give as many of each, at least two."
            )
        for angle, value in zip(angles, values, strict=True):
            if not math.isfinite(value) or value < 0:
                raise InputError(
                    f"The phase table's value at {math.degrees(angle):.4g} degrees is {value:g}; it must be finite and"
                    " not negative."
                )
        # The last angle may give pi with fewer digits.
        angles[-1] = math.pi if math.isclose(angles[-1], math.pi, rel_tol=1e-6) else math.nan
        if angles[0] != 0 or not (np.diff(_cosine_deviations(angles)) > 0).all():
            raise InputError("The angles of a phase table must increase from 0 to pi; add or sort them.")
        largest = max(values)
        if largest == 0:
            raise InputError("All values of the phase table are zero; give some light a direction.")
        relative = np.array(values) / largest
        integral = float(relative @ tent_weights(angles))
        object.__setattr__(self, "angles_rad", tuple(angles.tolist()))
        object.__setattr__(self, "values", tuple((relative / integral).tolist()))

    @property
    def mean_cosine(self) -> float:
        """First moment of the phase function."""
        # Simpson's rule is exact for the product of two linear functions.
        m, p = _cosine_deviations(np.array(self.angles_rad)), np.array(self.values)
        middle = (1 - 0.5 * (m[1:] + m[:-1])) * (p[1:] + p[:-1]) * 2
        ends = (1 - m) * p
        return float(2 * math.pi * np.sum(np.diff(m) / 6 * (ends[1:] + ends[:-1] + middle)))

    def hemisphere(self, *, back: bool) -> Hemisphere:
        """The half of the table around one pole, in the order of deviations from it."""
        m, p = _cosine_deviations(np.array(self.angles_rad)), np.array(self.values)
        if back:
            m, p = _cosine_deviations(math.pi - np.array(self.angles_rad))[::-1], p[::-1]
        # A node at the equator, which changes nothing, ends both halves.
        inner = m < 1
        nodes, values = np.append(m[inner], 1.0), np.append(p[inner], np.interp(1.0, m, p))
        masses = math.pi * np.diff(nodes) * (values[1:] + values[:-1])
        total = float(masses.sum())
        cumulative = np.concatenate([[0.0], np.cumsum(masses)]) / (total if total > 0 else 1.0)
        return Hemisphere(nodes, values, cumulative, total)


@dataclass(frozen=True)
class Hemisphere:
    """Nodes (N,) of one half of a table."""

    deviations: NDArray[np.float64]
    """1 - |cos theta|, from 0 at the pole to 1."""
    values: NDArray[np.float64]
    """Phase function at each node, 1/sr."""
    cumulative: NDArray[np.float64]
    """Share of the half's light between the pole and each node."""
    share: float
    """Share of the sphere's light in this half."""


def tent_weights(angles_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Integral over the sphere of each node's tent, sr; a tent whose integral is 1 has the inverse as its peak."""
    widths = np.diff(_cosine_deviations(angles_rad))
    return math.pi * (np.append(widths, 0.0) + np.insert(widths, 0, 0.0))


def _cosine_deviations(angles_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """1 - cos(theta), without cancellation."""
    return 2 * np.sin(0.5 * angles_rad) ** 2
