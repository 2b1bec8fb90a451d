"""The unknowns in which a solver moves a medium, and their priors.

``Knots`` are ln f at the 200 knots under a smoothness prior; ``mixture.Mixtures`` are the weights of a dictionary's
atoms. Both end with sigma_a. The forward model gives derivatives with respect to ln f and sigma_a, and each kind of
unknowns converts them by the chain rule.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from services.slab.cell.dictionary import ANGLES_RAD, KNOTS, Material, cosine_moments, tent_solid_angles
from services.slab.solve.measured_directions import measured_directions
from services.slab.solve.normal import UNKNOWNS
from services.slab.solve.prior import (
    RIDGE,
    SCALES,
    Quadratic,
    flag_scales,
    near_poles,
    precision,
    pull_covariance,
    sharp_scales,
)

Array = NDArray[np.float64]

LARGEST_CHANGE = 1.0
"""Largest change of ln f at a knot in one step; each knot is limited by itself, so that the worst one does not slow the
others."""

MAX_LN_SCATTERING_CHANGE = 0.3
"""Largest change of ln sigma_s in one step of a thick cell."""
BROAD_COSINES = 9
"""Number of multiples of the angle, from 0: the smallest feature is 22 degrees wide, and thick cells resolve none that
is smaller."""
MAX_SEEN_ERROR = 0.1
"""Largest standard error of ln f by the images alone, at half of the knots around a pole, at which the pole is seen."""


class Coordinates(Protocol):
    """One kind of unknowns x (U,)."""

    def initial_medium(self, guess: Material) -> Material:
        """A medium of this kind near the guess, from which the search begins."""

    def unknowns(self, material: Material) -> Array:
        """Unknowns (U,) of a medium that ``initial_medium`` or ``material_at`` gave."""

    def material_at(self, x: Array) -> Material:
        """The medium with these unknowns."""

    def chain(self, material: Material) -> Array | None:
        """Derivatives of ln f and sigma_a with respect to the unknowns (UNKNOWNS, U); None where they are the unknowns
        themselves.
        """

    def scale(self, material: Material, quadratic: Quadratic, *, sharp: bool) -> float | Array:
        """Scale of the prior near a medium, chosen from the quadratic of its images; ``sharp`` where it follows that
        medium.
        """

    def precision(self, scale: float | Array) -> Array:
        """Inverse covariance of the prior (U, U) for one scale."""

    def pull_covariance(self, material: Material, quadratic: Quadratic, scale: float | Array) -> Array:
        """Covariance (U, U) of the prior's pull on a medium like this one, as a gradient."""

    def weak_precision(self, material: Material) -> Array:
        """The same for a prior so weak that its information is not taken for a measurement."""

    def broad_directions(self) -> Array:
        """Few directions (U, K) that matter in any sample, in which a noisy matrix is judged by itself; none where
        unknowns are few.
        """

    def broad_standard_deviations(self, material: Material) -> Array:
        """Standard deviations (K,) of a medium's error along these directions."""

    def minimum(self, matrix: Array, right: Array) -> Array:
        """The x (U,) within bounds at which x^T matrix x / 2 - right^T x is least."""

    def clipped_step(self, change: Array, material: Material) -> Array:
        """A step in which no unknown moves further than a linearisation holds."""

    def linear_change(self, change: Array) -> Array:
        """The step (U,) in unknowns that agree with these to first order and in which f is linear."""

    def similarity_step(self, change: Array, material: Material) -> Array:
        """A step adapted to a thick cell, whose images hardly change with sigma_s at a constant sigma_s' but much with
        sigma_s'.
        """

    def is_at_bound(self, x: Array) -> NDArray[np.bool_]:
        """Mask (U,) of the unknowns that lie at a bound which they may not pass."""


@dataclass(frozen=True)
class Knots:
    """Coordinates ln f at the knots, and sigma_a not below zero."""

    def initial_medium(self, guess: Material) -> Material:
        """The guess itself, which is such a medium."""
        return guess

    def unknowns(self, material: Material) -> Array:
        """Ln f and sigma_a (UNKNOWNS,)."""
        return np.append(np.log(material.scattering), material.absorption_per_mm)

    def material_at(self, x: Array) -> Material:
        """The inverse of ``unknowns``."""
        return Material(np.exp(x[:KNOTS]), max(float(x[-1]), 0.0))

    def chain(self, material: Material) -> None:
        """None, because the forward model's derivatives are with respect to these unknowns."""

    def scale(self, material: Material, quadratic: Quadratic, *, sharp: bool) -> float | Array:
        """The scale with the largest evidence; a ``sharp`` one is that of ``prior.sharp_scales``, with the poles that
        the images determine. A peak that no camera sees would follow the noise of the angles beside it.
        """
        seen = seen_poles(quadratic) if sharp else ()
        return self._likeliest(quadratic, sharp_scales(material, seen) if sharp else SCALES)

    def pull_covariance(self, material: Material, quadratic: Quadratic, scale: float | Array) -> Array:
        """Covariance of the pull on media that bend as the evidence says, which may be more sharply than the prior
        allows at a pole that the images do not determine.
        """
        bends = scale
        if np.ndim(scale) > 0:
            bends = np.maximum(scale, self._likeliest(quadratic, sharp_scales(material, near_poles())))
        return pull_covariance(scale, bends)

    def _likeliest(self, quadratic: Quadratic, scales: Sequence[float | Array]) -> float | Array:
        return max(scales, key=lambda scale: self.log_evidence(quadratic, scale))

    def precision(self, scale: float | Array) -> Array:
        """Inverse covariance of a smooth ln f; the absorption has a flat prior."""
        return precision(scale)

    def weak_precision(self, material: Material) -> Array:  # noqa: ARG002 - as ln f needs no size
        """Inverse covariance of a ln f that may bend as sharply as any."""
        return precision(flag_scales())

    def broad_directions(self) -> Array:
        """Cosines of multiples of the angle, and the absorption (UNKNOWNS, BROAD_COSINES + 1); the first cosine is a
        change of sigma_s, the second about one of g.
        """
        directions = np.zeros((UNKNOWNS, BROAD_COSINES + 1))
        directions[:KNOTS, :BROAD_COSINES] = np.cos(np.outer(ANGLES_RAD, np.arange(BROAD_COSINES)))
        directions[KNOTS, BROAD_COSINES] = 1
        return directions

    def broad_standard_deviations(self, material: Material) -> Array:
        """Standard deviations of a Henyey-Greenstein start: a factor of e in sigma_s, and less in directions that vary
        faster with the angle.
        """
        return np.append(1 / np.maximum(np.arange(BROAD_COSINES), 1.0) ** 2, 0.1 * material.extinction_per_mm)

    def minimum(self, matrix: Array, right: Array) -> Array:
        """The minimum over all unknowns; where its absorption is negative, over the others with an absorption of
        zero.
        """
        x = np.asarray(np.linalg.solve(matrix, right), dtype=np.float64)
        if x[-1] < 0:
            x = np.append(np.asarray(np.linalg.solve(matrix[:-1, :-1], right[:-1]), dtype=np.float64), 0.0)
        return x

    def clipped_step(self, change: Array, material: Material) -> Array:  # noqa: ARG002 - as ln f needs no size
        """The step with each unknown limited by itself."""
        return np.clip(change, -LARGEST_CHANGE, LARGEST_CHANGE)

    def linear_change(self, change: Array) -> Array:
        """The relative change of f at the knots, and that of sigma_a."""
        return np.append(np.expm1(change[:KNOTS]), change[-1])

    def similarity_step(self, change: Array, material: Material) -> Array:
        """The step, limited to ``MAX_LN_SCATTERING_CHANGE``, with f scaled so that sigma_s' becomes what the step says
        to first order.
        """
        slope = reduced_scattering_slope(material)
        length = abs(float(material.slope_of_scattering() @ change)) / material.scattering_per_mm
        step = change * min(1.0, MAX_LN_SCATTERING_CHANGE / max(length, 1e-300))
        scaled = self.material_at(self.unknowns(material) + step)
        ln_reduced = math.log(material.reduced_scattering_per_mm) + float(slope @ step)
        step[:KNOTS] += ln_reduced - math.log(scaled.reduced_scattering_per_mm)
        return np.asarray(step)

    def is_at_bound(self, x: Array) -> NDArray[np.bool_]:
        """All false: ln f has no bound, and an absorption at zero has the standard error of a free one."""
        return np.zeros(len(x), dtype=bool)

    def log_evidence(self, quadratic: Quadratic, scale: float | Array) -> float:
        """Log evidence of a scale of the prior, up to a constant that all scales share.

        The mean derivatives are treated as if they were exact: the matrix is then positive, and a scale cannot win by
        following directions of negative curvature, which the unbiased matrix has.
        """
        prior = precision(scale)
        linear, total = quadratic.linear + quadratic.noise_linear, quadratic.matrix + quadratic.noise + prior
        x = self.minimum(total + RIDGE * float(np.diag(total).max()) * np.eye(UNKNOWNS), -linear)
        sign, log_determinant = np.linalg.slogdet(total)
        return (
            float(-(linear @ x + 0.5 * x @ total @ x) - 0.5 * log_determinant - (KNOTS - 1) * np.log(scale).mean())
            if sign > 0
            else -np.inf
        )


def seen_poles(quadratic: Quadratic) -> list[Array]:
    """The poles (see ``prior.near_poles``) around which images alone determine ln f to ``MAX_SEEN_ERROR``."""
    alone = np.linalg.inv(measured_directions(quadratic, precision(flag_scales())).total)
    errors = np.sqrt(np.diag(alone)[:KNOTS])
    return [near for near in near_poles() if np.median(errors[near >= 0.5]) <= MAX_SEEN_ERROR]


def reduced_scattering_slope(material: Material) -> Array:
    """Derivatives of ln sigma_s' with respect to ln f and sigma_a (UNKNOWNS,)."""
    parts = material.scattering * (tent_solid_angles() - cosine_moments())
    return np.append(parts / material.reduced_scattering_per_mm, 0.0)
