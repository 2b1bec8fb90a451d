"""Uncertainty of a solution: sandwich covariance, undetermined directions, derived quantities by the delta method.

In whitened coordinates y, x = T y, in which the usable curvature J~'WJ~ + Lambda is the identity,

    Cov(y) = M^-1 (s D + C + Lambda + S + N) M^-T + r r'

=======  ===============================================================================================================
D        J~'W Sigma W J~, the noise of the measurements; s >= 1 is the factor by which residuals exceed it
C        Monte Carlo covariance of the final gradient, by pixels (``normal_equations``)
Lambda   precision of the weak prior, which alone determines directions without data
M        response of the solution, 1 where Jacobians are the images' own (``solve.final_uncertainty``)
S        covariance of the gradient by the errors of held mean cosines and moved bodies (``solve.final_uncertainty``)
N        variance of steps p that used M by the noise in M, diag(sum_b var(M_ab) p_b^2)
r        remaining step to the minimum, where the fit ended before it: M^-1 (gradient + Lambda (x - mean))
=======  ===============================================================================================================

Where the instrument's errors are coordinates, their prior is then used in full (``solve.recombination``), which moves
x.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from services.fit.coordinates.domain import Domain
from services.fit.coordinates.instrument_errors import kind_of_error
from services.fit.solve.elimination import eliminate
from services.fit.solve.final_uncertainty import FinalSums, Response, positive_part, response
from services.fit.solve.normal_equations import NormalEquations
from services.fit.solve.recombination import Fault
from services.fit.solve.sandwich import Sandwich, combine_with_prior

Array = NDArray[np.float64]
NOISE_FACTOR = 3.0
"""An eigenvalue below this many of its own standard deviations is not distinguished from zero."""
MIN_DATA_SHARE = 0.5
"""Share of the information that the data, not the prior, must give for a parameter to be determined."""


@dataclass(frozen=True)
class Uncertainty:
    """Solution x (F,), its covariance (F, F), and the scaled directions (F, K) that the data leave undetermined."""

    domain: Domain
    x: Array
    covariance: Array
    undetermined_directions: Array
    posterior: Array
    """(J'WJ + Lambda)^-1, (F, F)."""
    sandwich: Sandwich | None = None
    """Factors of the covariance without the term r r'."""
    parts: Mapping[str, Array] = field(default_factory=dict)
    """Covariances (F, F) that add up to the whole, by their source (``results.Estimate``)."""
    faults: tuple[Fault, ...] = ()
    """Instrument errors that lie too far from their prior: faults of the calibration, or where they are many the signs
    of another cause (``have_common_cause``)."""
    is_full_step: bool = True
    """Whether the full use of the prior of the instrument's errors moved x no farther than one linear model
    is valid."""

    def standard_error(self, slope: Array) -> float:
        """Standard error of a quantity with gradient ``slope`` (F,) with respect to x."""
        return float(np.sqrt(max(float(slope @ self.covariance @ slope), 0.0)))

    def se_parts(self, slope: Array) -> dict[str, float]:
        """Parts of that standard error by source, largest first; their squares add up to its square."""
        found = {name: float(np.sqrt(max(float(slope @ part @ slope), 0.0))) for name, part in self.parts.items()}
        return {name: se for name, se in sorted(found.items(), key=lambda one: -one[1]) if se > 0}

    def is_determined(self, slope: Array) -> bool:
        """Whether the data determine a quantity with gradient ``slope`` (F,): it avoids undetermined directions and
        bounds, and the prior gives less than half of its information.
        """
        _, precision = self.domain.prior
        scaled = slope * self.domain.scale
        size = float(scaled @ scaled)
        if size == 0.0:
            return False
        along_undetermined = float(((self.undetermined_directions.T @ scaled) ** 2).sum())
        low, high = self.domain.bounds
        on_bound = (self.x <= low) | (self.x >= high)

        # a'C Lambda C a / a'C a is the prior's share of the information: lambda / (d + lambda) for one coordinate.
        posterior_slope = self.posterior @ slope
        prior_share = float((precision * posterior_slope) @ posterior_slope) / max(
            float(slope @ posterior_slope), 1e-300
        )
        return (
            along_undetermined < 0.1 * size
            and float((scaled[on_bound] ** 2).sum()) < 0.1 * size
            and prior_share < 1 - MIN_DATA_SHARE
        )


@dataclass(frozen=True)
class Whitening:
    """Whitened coordinates y, x = T y, of unit curvature, each as near as possible to one of x, and the scaled
    directions (F, K) whose curvature lies below its noise.
    """

    transform: Array
    undetermined_directions: Array


def whitening(domain: Domain, equations: NormalEquations) -> Whitening:
    """Whitening coordinates of a curvature, with its undetermined directions.

    The curvature of an undetermined direction is set to its noise level, so that the direction has a large error and
    not a negative variance.
    """
    count, errors = domain.tissue_count, len(domain.errors.names)
    precision, scale = domain.prior[1][:count], domain.scale[:count]
    reduced = eliminate(equations, _of_errors(domain), np.zeros(count + errors), count)
    eigenvalues, vectors = np.linalg.eigh(reduced.hessian * np.outer(scale, scale))
    noise = reduced.eigenvalue_noise(scale[:, None] * vectors)
    tiny = 1e-12 * float(abs(eigenvalues).max()) + 1e-300
    is_undetermined = eigenvalues < np.maximum(NOISE_FACTOR * noise, tiny)
    usable = np.where(is_undetermined, np.maximum(noise, tiny), eigenvalues)
    curvature, axes = np.linalg.eigh((vectors * usable) @ vectors.T + np.diag(precision * scale**2))
    tissue = scale[:, None] * ((axes / np.sqrt(np.maximum(curvature, tiny))) @ axes.T)

    # Instrument errors follow the tissue and have coordinates of their own. None of their directions is undetermined,
    # because their prior is proper.
    own = np.concatenate([np.zeros((count, errors)), reduced.root])
    undetermined_directions = np.concatenate(
        [vectors[:, is_undetermined], np.zeros((errors, int(is_undetermined.sum())))]
    )
    return Whitening(np.concatenate([reduced.lift @ tissue, own], axis=1), undetermined_directions)


def _of_errors(domain: Domain) -> Array:
    # The prior's precision without the tissue's part, which is added after the curvature was compared with its noise.
    precision = domain.precision
    precision[: domain.tissue_count, : domain.tissue_count] = 0.0
    return precision


@dataclass(frozen=True)
class Pooled:
    """Gradient of the data in whitened coordinates (F,), its Monte Carlo covariance (F, F), and the distance (F,) over
    which it was carried by an assumed response.
    """

    gradient: Array
    noise: Array
    carried: Array


def _pooled(t: Array, equations: NormalEquations, sums: FinalSums, solved: Response) -> Pooled:
    # Weight two gradients by their noise: the solver's pooled one, carried by the measured response instead of its own
    # curvature, and that of the final uncertainty estimate. The difference of the two ways of carrying counts as error
    # of its own size, because images are linear over short distances only.
    carried = np.asarray(np.linalg.solve(t, equations.carried + np.zeros(len(t))), dtype=np.float64)
    correction = solved.excess @ carried
    known, known_noise = (
        t.T @ equations.gradient + correction,
        t.T @ equations.gradient_noise @ t + np.outer(correction, correction),
    )
    first, second = (max(float(np.trace(positive_part(noise))), 1e-300) for noise in (known_noise, sums.gradient_noise))
    share = first / (first + second)
    return Pooled(
        (1 - share) * known + share * sums.gradient,
        (1 - share) ** 2 * known_noise + share**2 * sums.gradient_noise,
        (1 - share) * carried,
    )


@dataclass(frozen=True)
class FinalModel:
    """Quadratic model at a solution after its response was measured: M^-1, and the gradient (F,) with its noise (F, F),
    in whitened coordinates.
    """

    domain: Domain
    x: Array
    whitened: Whitening
    inverse: Array
    gradient: Array
    noise: Array

    def step(self, part_count: int = 1) -> Array:
        """The last Newton step (F,) along the determined directions, no longer than one scale for each of
        ``part_count`` objects, inside the bounds.

        The instrument's errors move to their optimum for the tissue after this step, which differs from that after a
        whole step.
        """
        domain, scaled, count = self.domain, self._whole_step(), self.domain.tissue_count
        low, high = domain.bounds
        length = float(np.linalg.norm(scaled[:count])) / np.sqrt(part_count)
        step = np.clip(self.x + domain.scale * scaled / max(1.0, length), low, high) - self.x
        return np.asarray(np.concatenate([step[:count], self._errors_after(step[:count])]))

    def remaining_step(self) -> Array:
        """The whole remaining step to the minimum (F,) along the determined directions, with the errors at their
        optimum for the tissue.

        Errors that followed the tissue along an undetermined direction too would state a step that the tissue does not
        make.
        """
        tissue = (self.domain.scale * self._whole_step())[: self.domain.tissue_count]
        return np.asarray(np.concatenate([tissue, self._errors_after(tissue)]))

    def _whole_step(self) -> Array:
        # The Newton step (F,) in scales.
        scaled = -self.whitened.transform @ self.inverse @ self.gradient / self.domain.scale
        return np.asarray(
            scaled - self.whitened.undetermined_directions @ (self.whitened.undetermined_directions.T @ scaled)
        )

    def _errors_after(self, tissue: Array) -> Array:
        # Change of the errors (K,) that minimises F = g'z + z'z / 2, z = M y, after a step of the tissue, which alone
        # moves its part of y.
        count = len(tissue)
        if count == len(self.x):
            return np.zeros(0)
        whole = np.linalg.inv(self.inverse)
        y = np.linalg.solve(self.whitened.transform[:count, :count], tissue)
        own = np.linalg.lstsq(whole[:, count:], -(self.gradient + whole[:, :count] @ y))[0]
        low, high = (bound[count:] for bound in self.domain.bounds)
        change = self.whitened.transform[count:] @ np.concatenate([y, own])
        return np.asarray(np.clip(self.x[count:] + change, low, high) - self.x[count:])

    def slope(self, step: Array) -> float:
        """Directional derivative g'z of F at x along a step (F,), not divided by its length. A step that follows noise
        has a steeper one, by the part that noise alone causes.
        """
        return float(self.gradient @ self._moved(step))

    def predicted_change(self, step: Array) -> tuple[float, float]:
        """Predicted change of F by a step (F,) and its standard error by noise; the part that noise alone predicts is
        subtracted.

        Where J = J~ M describes the images' derivatives, F changes by g'z + z'z / 2, z = M y.
        """
        moved = self._moved(step)
        change = float(self.gradient @ moved + 0.5 * moved @ moved) + 0.5 * float(np.trace(self.noise))
        return change, float(np.sqrt(max(float(moved @ self.noise @ moved), 0.0)))

    def _moved(self, step: Array) -> Array:
        return np.asarray(np.linalg.solve(self.inverse, np.linalg.solve(self.whitened.transform, step)))


def final_model(domain: Domain, x: Array, equations: NormalEquations, sums: FinalSums) -> FinalModel:
    """Quadratic model at x, where the final uncertainty estimate was made."""
    whitened = whitening(domain, equations)
    t = whitened.transform
    solved = response(sums, t.T @ domain.precision @ t, domain.relation, len(domain.errors.names))
    pooled = _pooled(t, equations, sums, solved)
    return FinalModel(
        domain, x, whitened, solved.inverse, pooled.gradient + t.T @ domain.prior_slope(x), positive_part(pooled.noise)
    )


def uncertainty(
    domain: Domain,
    x: Array,
    equations: NormalEquations,
    sums: FinalSums | None = None,
    step: Array | None = None,
    moved: Sequence[str] = (),
    part_count: int = 1,
    unfinished: float = 1.0,
) -> Uncertainty:
    """Uncertainty at a solution, from the normal equations there.

    The returned x is the solution, moved where the prior of the instrument's errors is used in full.

    Args:
        sums: the final uncertainty estimate, made at ``x - step`` in the whitened coordinates of these equations; None
            where Jacobians are the images' own.
        step: the step (F,) that the fit made after the final uncertainty estimate.
        moved: kind, ``shape``, ``teeth`` or ``dome``, of each of the last changes of the final uncertainty estimate;
            the earlier changes are those of held mean cosines.
        part_count: number of objects that the fit treats as separate in the images, such as the teeth of a jaw.
        unfinished: share of the remaining step to the minimum that counts; less than 1 where comparisons refuted it.
    """
    misfit = max(1.0, equations.squares / equations.expected_squares) if equations.expected_squares > 0 else 1.0
    whitened = whitening(domain, equations)
    t, count = whitened.transform, len(x)
    prior = t.T @ domain.precision @ t
    parts = {"photographs": misfit * positive_part(t.T @ equations.data_noise @ t)} | _prior_parts(domain, t)
    meat, weighing = parts["photographs"] + t.T @ domain.prior_noise @ t, np.zeros_like(prior)
    solved: Response | None = None
    if sums is None:
        inverse = np.eye(count)
        parts["rendering"] = positive_part(t.T @ equations.gradient_noise @ t)
        meat = meat + parts["rendering"]
        remaining_gradient = t.T @ (equations.gradient + domain.prior_slope(x))
    else:
        solved, taken = (
            response(sums, prior, domain.relation, len(domain.errors.names)),
            np.linalg.solve(t, np.zeros(count) if step is None else step),
        )
        pooled, inverse = _pooled(t, equations, sums, solved), solved.inverse
        rendered, response_noise = positive_part(pooled.noise), np.diag(solved.variance @ (taken + pooled.carried) ** 2)
        kinds = ["mean_cosine"] * (len(sums.shifts) - len(moved)) + list(moved)
        parts |= {"rendering": rendered + response_noise}
        shifts = {
            kind: sums.shift_covariance(
                [k for k, own in enumerate(kinds) if own == kind], is_combined=bool(domain.errors.names)
            )
            for kind in dict.fromkeys(kinds)
        }
        parts |= shifts
        stated = sum(shifts.values(), np.zeros_like(prior))
        meat = meat + rendered + stated + response_noise
        weighing = sums.expected_shift_covariance(range(len(kinds))) - stated
        remaining_gradient = (
            pooled.gradient + t.T @ domain.prior_slope(x) + np.linalg.solve(inverse, taken) - prior @ taken
        )

    # Count the remaining step along the determined directions as error.
    model = FinalModel(domain, x, whitened, inverse, remaining_gradient, parts["rendering"])
    remaining = unfinished * model.remaining_step()
    combined = combine_with_prior(
        domain, x, Sandwich(t, inverse, meat, misfit, weighing), parts, np.outer(remaining, remaining), part_count
    )
    unknown = _left_to_start(domain, whitened.undetermined_directions, combined.covariance)
    if solved is not None:
        unknown = unknown + _blurred(domain, t, solved, combined.covariance)
    covariance = 0.5 * (combined.covariance + combined.covariance.T) + unknown
    return Uncertainty(
        domain,
        combined.x,
        covariance,
        whitened.undetermined_directions,
        t @ t.T,
        combined.sandwich,
        {**combined.parts, "prior": combined.parts["prior"] + unknown},
        combined.faults,
        combined.is_full_step,
    )


def _left_to_start(domain: Domain, directions: Array, covariance: Array) -> Array:
    """What a covariance (F, F) lacks along undetermined directions (F, K, scaled) of the error of the fit's start.

    No step is made along such a direction, so its error is that of the start, one scale or what the prior leaves if
    that is less, however little noise the gradient has there. Curvature that is noise would state less: the more noise
    the derivatives have, the less.
    """
    count, scale = domain.tissue_count, domain.scale
    own = directions[:count]
    precision = np.maximum(domain.prior[1][:count] * scale[:count] ** 2, 1.0)
    alone = np.linalg.inv((own.T * precision) @ own)
    stated = directions.T @ (covariance / np.outer(scale, scale)) @ directions
    missing = directions @ positive_part(alone - stated) @ directions.T
    return np.asarray(missing * np.outer(scale, scale))


def _blurred(domain: Domain, t: Array, solved: Response, covariance: Array) -> Array:
    """What a covariance (F, F) lacks along directions whose response lies below its noise.

    There the response has its noise level, or a step would follow noise. The error is larger than that states: by as
    much as the response is smaller, but no more than that of the fit's start.
    """
    count, scale = domain.tissue_count, domain.scale
    missing = np.zeros_like(covariance)
    for direction, ratio in zip(solved.blurred.T, solved.blurring, strict=True):
        scaled = t @ direction / scale
        scaled[count:] = 0.0
        scaled /= np.linalg.norm(scaled)
        stated = float(scaled @ (covariance / np.outer(scale, scale)) @ scaled)
        start = 1 / float(np.maximum(domain.prior[1][:count] * scale[:count] ** 2, 1.0) @ scaled[:count] ** 2)
        missing += max(min(stated * ratio**2, start) - stated, 0.0) * np.outer(scaled, scaled)
    return np.asarray(missing * np.outer(scale, scale))


def _prior_parts(domain: Domain, t: Array) -> dict[str, Array]:
    # The whitened noise of the prior, split into that of the tissue and of each kind of instrument error. The columns
    # of a Cholesky factor give positive semidefinite parts that add up; where kinds are correlated, their common part
    # counts for the first of them.
    count, precision = domain.tissue_count, domain.prior_noise
    parts = {"prior": t[:count].T @ precision[:count, :count] @ t[:count]}
    kinds = np.array([kind_of_error(name) for name in domain.errors.names])
    factor = np.linalg.cholesky(precision[count:, count:])
    for kind in dict.fromkeys(kinds.tolist()):
        half = t[count:].T @ (factor * (kinds == kind))
        parts[kind] = half @ half.T
    return parts
