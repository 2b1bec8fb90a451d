"""Solver for the optical depths d of a stain texture's texels, a_t = exp(-d), under priors, from sums over all
measurements (teeth 2018 Eq. 1, 10).

A path's contribution is a product of factors exp(-d), one per face crossed. So with S_t = -(1/C) dC/dd_t, the share of
a pixel's light C that crossed texel t,

    carried_t = sum w C1 C2 S_t,   explained_t = sum w ref C S_t,   dF/dd_t = explained_t - carried_t.

A ratio step sets d to d - ln(explained / carried) / 2: the ratio of photograph to render, averaged over all lights and
views with the light that crosses a texel as weight. With two crossings per path sum_t S_t = 2, so 2 diag(carried)
bounds the curvature from above (Lange 2013, separable majorisation) and a ratio step lowers F however uneven the
texture. It is slow where neighbours differ, because that bound counts the entry crossings, which all texels share.
Momentum steps (Polyak 1964) with diag(carried) follow; their factors are optimal for curvatures between a quarter of
diag(carried), which exit crossings alone give, and twice diag(carried).

A common factor of all images is nearly equivalent to absorption in the media, and d cannot fall below 0. So the first
steps fit the pattern at a free common factor, with the cleanest part of the surface at d = 0; then the media's
parameters take up the factor, and the last steps fit the images without it.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

DEEPEST = 4.6
"""Largest optical depth: a_t = 0.01."""
CLEAN_SD = 0.5
"""Standard deviation of the prior around a clean surface, d = 0; a texel that no pixel sees stays there."""
NEIGHBOUR_SD = 0.2
"""Prior standard deviation of the difference in depth between neighbouring texels."""
MOMENTUM = 0.25
"""Share of the last step that a step with momentum adds."""
SLOWER_AFTER = 3
"""Number of exact steps after which a step is half as long."""
LONGEST_STEP = 0.7
"""Largest change of a texel's depth in one step: a factor of two."""
ENTRY_SHARE = 0.25
"""Curvature of a texel by entry crossings as a share of what they carry, where the remaining step is estimated."""
CLEAN_SHARE = 0.2
"""Share of the visible surface that counts as clean while depths are known only relative to each other."""


@dataclass(frozen=True)
class StainSums:
    """Sums over measurements: ``explained`` and ``carried`` (T,) for T texels."""

    explained: Array
    carried: Array
    squares: float
    """sum w (r^2 - its Monte Carlo variance)."""
    count: int = 0
    """Number of measurements; the weights make ``squares`` as large where only their noise is left."""

    def __add__(self, other: StainSums) -> StainSums:
        return StainSums(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))


@dataclass(frozen=True)
class StainState:
    """Optical depths (T,), the last step (T,), and the visibility and misfit that the step found."""

    depth: Array
    last_step: Array
    determined: Array
    """Mask (T,) of the texels that measurements determine better than the prior."""
    squares: float = 0.0

    def record(self) -> dict[str, Any]:
        """The state as JSON values; floats survive exactly."""
        return {
            "depth": self.depth.tolist(),
            "moved": self.last_step.tolist(),
            "seen": self.determined.astype(int).tolist(),
            "squares": self.squares,
        }

    @staticmethod
    def of(record: dict[str, Any]) -> StainState:
        """State from the JSON values of ``record``."""
        return StainState(
            np.array(record["depth"]),
            np.array(record["moved"]),
            np.array(record["seen"], dtype=bool),
            record["squares"],
        )


def clean_state(texels: int) -> StainState:
    """State of a surface without stains."""
    return StainState(np.zeros(texels), np.zeros(texels), np.zeros(texels, dtype=bool))


@dataclass(frozen=True)
class StainSolver:
    """Solver steps for T texels with E pairs of neighbours."""

    neighbours: NDArray[np.int64]
    """Indices (E, 2) of neighbouring texels."""
    texels: int

    def ratio_step(self, state: StainState, sums: StainSums) -> StainState:
        """The damped ratio update, at a free common factor."""
        carried = np.maximum(sums.carried, 0.0)
        ratio = sums.explained / np.where(carried > 0, carried, 1.0)
        slope = np.where(carried > 0, carried * np.log(np.maximum(ratio, 1e-3)), 0.0)
        return self._relative(state, self._stepped(state, sums, slope, 2.0, 0.0, -DEEPEST))

    def pattern_step(self, state: StainState, sums: StainSums) -> StainState:
        """A step with momentum along the gradient, at the common factor of all images that fits best."""
        total = float(np.maximum(sums.carried, 0.0).sum())
        factor = float(np.clip(sums.explained.sum() / total, 0.1, 10.0)) if total > 0 else 1.0
        scaled = StainSums(sums.explained * factor, sums.carried * factor**2, sums.squares)
        return self._relative(
            state, self._stepped(state, scaled, scaled.explained - scaled.carried, 1.0, MOMENTUM, -DEEPEST)
        )

    def exact_step(self, state: StainState, sums: StainSums, number: int) -> StainState:
        """A step with momentum along the exact gradient; later steps are shorter, so that noise averages out (Robbins
        and Monro 1951).

        Args:
            number: number of exact steps before this one.
        """
        return self._stepped(state, sums, sums.explained - sums.carried, 1 + number / SLOWER_AFTER, MOMENTUM, 0.0)

    def depth_errors(self, depth: Array, sums: StainSums, exits: Any) -> Array:
        """Standard errors (T,) of the depths (T,) at the end of a fit, with the media as they are.

        The covariance is M⁻¹ (s H + c Λ) M⁻¹ + r r', with the prior's precision Λ and M = H + Λ.

        - H is the curvature by exit crossings alone. Entry crossings spread over the texels around, which adds to the
          curvature of every pattern, so that H is a lower limit.
        - s >= 1 is the factor by which residuals exceed the noise of the measurements.
        - c >= 1 is that by which the squares of the depths that the data determine exceed the prior's variance: the
          prior only smooths, and a stained tooth is darker than it expects.
        - The remaining step r holds what the steps left and the Monte Carlo noise of the gradient, so that its square
          is averaged over neighbouring texels. ``ENTRY_SHARE`` of the entry crossings bounds it where a texel is seen
          by them alone.

        Args:
            depth: the fitted depths (T,).
            sums: sums at these depths, from seeds that no step used.
            exits: sparse matrix (T, T) of sum w C^2 b_t b_u, b being the share of a pixel that shows a texel.
        """
        prior, data = self._prior(), exits.toarray()
        inverse = np.linalg.inv(data + prior.toarray())
        excess = max(1.0, sums.squares / max(sums.count, 1)) - 1.0
        noise = excess * np.einsum("ij,ji->i", inverse @ data, inverse)
        known = data.diagonal() > prior.diagonal()
        expected = np.linalg.inv(prior.toarray()).diagonal()
        stained = max(1.0, float(np.mean(depth[known] ** 2 / expected[known]))) if known.any() else 1.0
        smoothing = (stained - 1.0) * np.einsum("ij,ji->i", inverse @ prior.toarray(), inverse)
        variance = inverse.diagonal() + noise + smoothing
        entered = ENTRY_SHARE * np.maximum(sums.carried - data.sum(axis=1), 0.0)
        gradient = sums.explained - sums.carried + prior @ depth
        step = np.linalg.solve(data + np.diag(entered) + prior.toarray(), gradient)
        # A depth that its bound holds at 0 has no step left.
        square, number = (np.clip(depth - step, 0.0, DEEPEST) - depth) ** 2, np.ones(self.texels)
        first, second = self.neighbours.T
        around = square.copy()
        for ours, theirs in ((first, second), (second, first)):
            np.add.at(around, ours, square[theirs])
            np.add.at(number, ours, 1.0)
        return np.asarray(np.sqrt(variance + around / number))

    def _relative(self, before: StainState, moved: StainState) -> StainState:
        # Depths relative to the cleanest part of the visible surface; the media take up the common factor.
        if not moved.determined.any():
            return before
        floor = float(np.quantile(moved.depth[moved.determined], CLEAN_SHARE))
        depth = np.where(moved.determined, np.clip(moved.depth - floor, 0.0, DEEPEST), 0.0)
        return StainState(depth, np.where(moved.determined, depth - before.depth, 0.0), moved.determined, moved.squares)

    def _prior(self) -> Any:
        # Sparse precision matrix (T, T) of the prior: each texel towards clean, and neighbours towards each other.
        from scipy import sparse

        ones = np.ones(len(self.neighbours))
        rows = np.arange(len(self.neighbours))
        difference = sparse.csr_matrix(
            (np.concatenate([ones, -ones]), (np.tile(rows, 2), self.neighbours.T.reshape(-1))),
            shape=(len(self.neighbours), self.texels),
        )
        return sparse.identity(self.texels, format="csr") / CLEAN_SD**2 + difference.T @ difference / NEIGHBOUR_SD**2

    def _stepped(
        self, state: StainState, sums: StainSums, slope: Array, bound: float, momentum: float, low: float
    ) -> StainState:
        from scipy import sparse
        from scipy.sparse.linalg import spsolve

        # Use the diagonal bound as the data's curvature and the exact curvature of the priors. Where noise makes
        # ``carried`` negative, the prior's curvature is left alone.
        prior, carried = self._prior(), np.maximum(sums.carried, 0.0)
        gradient = slope + prior @ state.depth
        step = -spsolve((sparse.diags(bound * carried) + prior).tocsc(), gradient) + momentum * state.last_step
        depth = np.clip(state.depth + np.clip(step, -LONGEST_STEP, LONGEST_STEP), low, DEEPEST)
        return StainState(depth, depth - state.depth, carried > prior.diagonal(), float(sums.squares))
