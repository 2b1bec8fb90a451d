"""Fit of one roughness to the highlights of many photographs, with the surface's and the background's errors.

Unknown are the roughness, the brightness of all highlights and of each light's, the height of the surface's error and
each photograph's background. The sum of squares is minimised by Gauss and Newton's steps with Levenberg's damping;
pixels far off weigh less (Huber). The backgrounds are eliminated photograph by photograph. The sizes of the surface's
and the backgrounds' errors follow from the photographs themselves (MacKay 1992, the evidence's fixed point).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.fit.measurements.roughness.background import START_SHARE, Background, background_of
from services.fit.measurements.roughness.patches import Patch
from services.fit.measurements.roughness.surface import (
    SPACING,
    SurfaceError,
    coefficient_se,
    spread_centres,
    tangents_of,
    tilts,
)

Array = NDArray[np.float64]

MODEL_ERROR = 0.02
"""Error of a pixel's reflection beside its noise, relative: places within a pixel instead of its area."""
BACKGROUND_ERROR = 0.01
"""Error of a pixel's background beside its noise, relative: what no smooth function has."""
HUBER = 2.5
"""Standard deviations beyond which a pixel's weight falls."""
BRIGHTNESS_SE = 0.7
"""Standard error of the logarithm of all highlights' brightness, a factor of two: a film of water has a third of the
reflectance of bare enamel, so the roughness shall follow from the highlights' form."""
LIGHT_SE = 0.05
"""Relative standard error of one light's highlights against those of the others."""
PRIOR_COUNT = 8.0
"""Number of coefficients by which the assumed size of the surface's and of the backgrounds' errors counts."""
MAX_STEPS = 40
"""Largest number of steps, refused ones included."""
MAX_STEP = 0.3
"""Largest change of the logarithms of roughness and brightness in a step."""
CONVERGED = 1e-3
"""Change of the roughness' logarithm, in a step, that ends the fit: a hundredth of what is asked of it."""
SETTLED = 0.02
"""Relative change of the errors' sizes that does not hinder the end."""
FIRST = 2
"""Number of unknowns before those of the lights: the logarithms of roughness and brightness."""
DIFFERENCE = 1e-4
"""Step of the derivatives by differences, relative or rad."""


@dataclass(frozen=True)
class LobeFit:
    """Result of the fit.

    Attributes:
        ln_roughness, ln_brightness: logarithms of the roughness, and of the brightness over the one that index and
            calibration predict.
        covariance: (2, 2) of these.
        height_mm: standard deviation of the surface's error by the photographs, mm.
        background_share: size of the backgrounds' bumps, as a share of the radiance.
        misfit: mean squared residual, in standard deviations of the noise; 1 where the model leaves nothing out.
        pixels: number of pixels.
        converged: whether the steps came to an end.
    """

    ln_roughness: float
    ln_brightness: float
    covariance: Array
    height_mm: float
    background_share: float
    misfit: float
    pixels: int
    converged: bool


@dataclass(frozen=True)
class _Term:
    """One patch with what does not change from step to step."""

    patch: Patch
    background: Background
    tangents: Array
    tilts: Array
    """(2, N, K') of the bumps that reach the patch."""
    unknowns: NDArray[np.intp]
    """Places of its unknowns among all: roughness, brightness, its light's, its bumps' heights."""


@dataclass(frozen=True)
class _Sizes:
    """Sizes of the errors that are themselves estimated."""

    coefficient_mm: float
    share: float


@dataclass
class _Sums:
    """Sums over all patches at one place."""

    objective: float
    curvature: Array
    scores: Array
    """(P, F): each patch's part of the gradient."""
    misfit: float = 0.0
    freedom: float = 0.0
    bump_squares: float = 0.0
    bumps: int = 0


def fit_lobe(
    patches: Sequence[Patch], ior: float, roughness: float, error: SurfaceError, background_mm: float
) -> LobeFit:
    """Fit the roughness.

    Args:
        patches: pixels around the highlights.
        ior: refractive index.
        roughness: first guess.
        error: the surface's error; its height is only where the estimate begins.
        background_mm: correlation length of the backgrounds' bumps.
    """
    problem = _Problem(patches, ior, error, background_mm)
    x = np.zeros(problem.count)
    x[0] = np.log(roughness)
    sizes = _Sizes(problem.coefficient_se, START_SHARE)
    sums, damping, converged = problem.at(x, sizes), 1e-3, False
    for step_number in range(MAX_STEPS):
        prior = problem.prior(sizes)
        matrix = sums.curvature + np.diag(prior)
        step = np.linalg.solve(matrix + damping * np.diag(np.diag(matrix)), sums.scores.sum(axis=0) - prior * x)
        step *= min(1.0, MAX_STEP / max(float(np.abs(step[:FIRST]).max()), 1e-300))
        tried = problem.at(x + step, sizes)
        if problem.whole(tried, x + step, sizes) >= problem.whole(sums, x, sizes):
            damping *= 8
            if damping > 1e6:
                converged = True
                break
            continue
        x, sums, damping = x + step, tried, max(damping / 5, 1e-7)
        if step_number == 0:
            continue
        before, sizes = sizes, problem.sizes_at(x, sums, sizes)
        change = max(abs(sizes.coefficient_mm / before.coefficient_mm - 1), abs(sizes.share / before.share - 1))
        if abs(step[0]) < CONVERGED and change < SETTLED:
            converged = True
            break
        sums = problem.at(x, sizes)
    return problem.result(x, sums, sizes, converged)


class _Problem:
    def __init__(self, patches: Sequence[Patch], ior: float, error: SurfaceError, background_mm: float) -> None:
        points = np.concatenate([patch.points_mm for patch in patches])
        centres = spread_centres(points, SPACING * error.length_mm)
        some = points[:: max(1, len(points) // 3000)]
        lights = sorted({patch.photograph[1] for patch in patches})
        self.ior, self.error, self._background_mm = ior, error, background_mm
        self.coefficient_se = coefficient_se(centres, some, error)
        self.bumps = FIRST + len(lights)
        self.count = self.bumps + len(centres)
        self._prior = np.full(self.count, 0.0)
        self._prior[1], self._prior[FIRST : self.bumps] = 1 / BRIGHTNESS_SE**2, 1 / LIGHT_SE**2
        self._terms = [self._term(patch, centres, FIRST + lights.index(patch.photograph[1])) for patch in patches]

    def _term(self, patch: Patch, centres: Array, light: int) -> _Term:
        normal = patch.normals.mean(axis=1)
        tangents = tangents_of(normal / np.linalg.norm(normal, axis=1, keepdims=True))
        moved = tilts(patch.points_mm, tangents, centres, self.error)
        reaching = np.flatnonzero((moved != 0).any(axis=(0, 1)))
        unknowns = np.concatenate([[0, 1, light], self.bumps + reaching])
        return _Term(patch, background_of(patch, self._background_mm), tangents, moved[:, :, reaching], unknowns)

    def prior(self, sizes: _Sizes) -> Array:
        """Inverse variances (F,) of the unknowns before any photograph is seen."""
        prior = self._prior.copy()
        prior[self.bumps :] = 1 / sizes.coefficient_mm**2
        return prior

    def whole(self, sums: _Sums, x: Array, sizes: _Sizes) -> float:
        """What is minimised."""
        return sums.objective + 0.5 * float((self.prior(sizes) * x**2).sum())

    def at(self, x: Array, sizes: _Sizes) -> _Sums:
        """Sums at unknowns x (F,)."""
        sums = _Sums(0.0, np.zeros((self.count, self.count)), np.zeros((len(self._terms), self.count)))
        for number, term in enumerate(self._terms):
            self._add(sums, number, term, x[term.unknowns], sizes.share)
        return sums

    def _add(self, sums: _Sums, number: int, term: _Term, x: Array, share: float) -> None:
        patch, terms = term.patch, term.background.terms
        roughness, brightness = float(np.exp(x[0])), float(np.exp(x[1] + x[2]))
        tilt = np.einsum("tnk,k,tnx->nx", term.tilts, x[3:], term.tangents)

        def lobe(roughness: float, tilt: Array) -> Array:
            return brightness * patch.lobe(roughness, self.ior, tilt)

        reflected = lobe(roughness, tilt)
        deviation = np.sqrt(patch.variance + (MODEL_ERROR * reflected) ** 2 + (BACKGROUND_ERROR * patch.value) ** 2)
        prior = term.background.precision(share)
        rest, robust = patch.value - reflected, np.ones(len(patch.value))
        for _ in range(3):
            weight = robust / deviation**2
            weighted = terms * weight[:, None]
            normal = weighted.T @ terms + np.diag(prior)
            coefficients = np.linalg.solve(normal, weighted.T @ rest)
            residual = rest - terms @ coefficients
            size = np.abs(residual) / deviation
            robust = np.minimum(1, HUBER / np.maximum(size, 1e-9))
        loss = np.where(size < HUBER, size**2 / 2, HUBER * (size - HUBER / 2)) + np.log(deviation)
        sums.objective += float(loss.sum() + 0.5 * (prior * coefficients**2).sum())
        sums.misfit += float((robust * size**2).sum())
        inverse, free = np.linalg.inv(normal), term.background.free
        sums.freedom += len(rest) - float((inverse * (weighted.T @ terms)).sum())
        sums.bump_squares += float((coefficients[free:] ** 2).sum() + np.trace(inverse[free:, free:]))
        sums.bumps += len(coefficients) - free

        # Derivatives by differences; a change of a light's brightness is one of all
        of_roughness = (lobe(roughness * np.exp(DIFFERENCE), tilt) - reflected) / DIFFERENCE
        of_tilt = [(lobe(roughness, tilt + DIFFERENCE * one) - reflected) / DIFFERENCE for one in term.tangents]
        of_bumps = sum(one[:, None] * moved for one, moved in zip(of_tilt, term.tilts, strict=True))
        jacobian = np.concatenate([np.stack([of_roughness, reflected, reflected], axis=1), of_bumps], axis=1)
        across = weighted.T @ jacobian
        own = (jacobian * weight[:, None]).T @ jacobian - across.T @ inverse @ across
        sums.curvature[np.ix_(term.unknowns, term.unknowns)] += own
        sums.scores[number, term.unknowns] += (jacobian * weight[:, None]).T @ residual

    def sizes_at(self, x: Array, sums: _Sums, sizes: _Sizes) -> _Sizes:
        """The sizes of the errors by the unknowns and what is left uncertain of them."""
        left = np.linalg.inv(sums.curvature + np.diag(self._regular(self.prior(sizes))))
        squares = float((x[self.bumps :] ** 2).sum() + np.trace(left[self.bumps :, self.bumps :]))
        count = self.count - self.bumps
        height = (squares + PRIOR_COUNT * self.coefficient_se**2) / (count + PRIOR_COUNT)
        share = (sums.bump_squares + PRIOR_COUNT * START_SHARE**2) / (sums.bumps + PRIOR_COUNT)
        return _Sizes(float(np.sqrt(height)), float(np.sqrt(share)))

    def result(self, x: Array, sums: _Sums, sizes: _Sizes, converged: bool) -> LobeFit:
        """The result at the end of the steps."""
        prior = self._regular(self.prior(sizes))
        inverse = np.linalg.inv(sums.curvature + np.diag(prior))
        misfit = sums.misfit / max(sums.freedom, 1.0)
        own = inverse[:FIRST, :FIRST] * max(misfit, 1.0)
        # Residuals of a photograph go together. Take the spread of the photographs' parts of the gradient for what
        # they tell (White's sandwich by clusters), where it is larger
        parts = sums.scores @ inverse[:, :FIRST]
        count = len(parts)
        spread = (parts.T @ parts) * count / max(count - 1, 1) + inverse[:FIRST] @ np.diag(prior) @ inverse[:, :FIRST]
        scale = np.sqrt(np.maximum(np.diag(spread) / np.diag(own), 1.0))
        height = self.error.height_mm * sizes.coefficient_mm / self.coefficient_se
        pixels = sum(len(term.patch.value) for term in self._terms)
        return LobeFit(
            float(x[0]), float(x[1]), own * np.outer(scale, scale), height, sizes.share, misfit, pixels, converged
        )

    @staticmethod
    def _regular(prior: Array) -> Array:
        return np.maximum(prior, 1e-6)
