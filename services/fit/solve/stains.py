"""One step of a stain texture: optical depths d of its texels, a_t = exp(-d), under priors, from sums over all
measurements (teeth 2018 Eq. 1, 10).

A path's light is a product of factors exp(-d), one per face crossed, so with shares S_t = -(1/C) dC/dd_t of a pixel's
light in the texels it crossed,

    carried_t = sum w C1 C2 S_t,   explained_t = sum w ref C S_t,   dF/dd_t = explained_t - carried_t.

A ratio step sets d to d - ln(explained / carried) / 2: photograph over render, averaged over all lights and views by
the light that a texel passes. With two crossings per path sum_t S_t = 2, so 2 diag(carried) bounds the curvature from
above (Lange 2013, separable majorisation) and a ratio step lowers F however uneven the texture. It is slow where
neighbours differ, because that bound counts the way in, which all texels share. Momentum steps (Polyak 1964) with
diag(carried) finish; their factors are optimal for curvatures between a quarter of it, seen on the way out only, and
twice it.

A common factor of all images is nearly what the media's absorption does, and d cannot fall below 0. So the first steps
find the pattern at a free factor, with the cleanest part of the surface at d = 0; media then take the factor, and the
last steps leave it to the images.
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
"""Standard deviation of the prior around a clean surface, d = 0: what no pixel sees stays there."""
NEIGHBOUR_SD = 0.2
"""Standard deviation of the difference between neighbouring texels."""
MOMENTUM = 0.25
SLOWER_AFTER = 3
"""Exact steps after which they are half as long."""
LONGEST_STEP = 0.7
"""Largest change of a texel's depth in one step: a factor of two."""
CLEAN_SHARE = 0.2
"""Share of the seen surface that counts as clean while depths are known only relative to each other."""


@dataclass(frozen=True)
class StainSums:
    """Sums over measurements for T texels."""

    explained: Array
    carried: Array
    squares: float
    """sum w (r^2 - its Monte Carlo variance)."""

    def __add__(self, other: StainSums) -> StainSums:
        return StainSums(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))


@dataclass(frozen=True)
class StainState:
    """Depths (T,), the last step (T,), and what a step saw."""

    depth: Array
    moved: Array
    seen: Array
    """(T,) whether measurements say more of a texel than its prior."""
    squares: float = 0.0

    def record(self) -> dict[str, Any]:
        """As JSON values; floats survive exactly."""
        return {
            "depth": self.depth.tolist(),
            "moved": self.moved.tolist(),
            "seen": self.seen.astype(int).tolist(),
            "squares": self.squares,
        }

    @staticmethod
    def of(record: dict[str, Any]) -> StainState:
        """From ``record``."""
        return StainState(
            np.array(record["depth"]),
            np.array(record["moved"]),
            np.array(record["seen"], dtype=bool),
            record["squares"],
        )


def clean(texels: int) -> StainState:
    """A surface without stains."""
    return StainState(np.zeros(texels), np.zeros(texels), np.zeros(texels, dtype=bool))


@dataclass(frozen=True)
class StainSolver:
    """Steps of T texels with E pairs of neighbours."""

    neighbours: NDArray[np.int64]
    """(E, 2)"""
    texels: int

    def ratio_step(self, state: StainState, sums: StainSums) -> StainState:
        """The damped ratio update, at a free common factor."""
        carried = np.maximum(sums.carried, 0.0)
        ratio = sums.explained / np.where(carried > 0, carried, 1.0)
        slope = np.where(carried > 0, carried * np.log(np.maximum(ratio, 1e-3)), 0.0)
        return self._relative(state, self._moved(state, sums, slope, 2.0, 0.0, -DEEPEST))

    def pattern_step(self, state: StainState, sums: StainSums) -> StainState:
        """A step with momentum along the gradient at that common factor of all images which fits best."""
        total = float(np.maximum(sums.carried, 0.0).sum())
        factor = float(np.clip(sums.explained.sum() / total, 0.1, 10.0)) if total > 0 else 1.0
        scaled = StainSums(sums.explained * factor, sums.carried * factor**2, sums.squares)
        return self._relative(
            state, self._moved(state, scaled, scaled.explained - scaled.carried, 1.0, MOMENTUM, -DEEPEST)
        )

    def exact_step(self, state: StainState, sums: StainSums, number: int) -> StainState:
        """A step with momentum along the exact gradient; later ones are shorter, so that noise averages out (Robbins
        and Monro 1951).

        Args:
            number: of exact steps before this one.
        """
        return self._moved(state, sums, sums.explained - sums.carried, 1 + number / SLOWER_AFTER, MOMENTUM, 0.0)

    def _relative(self, before: StainState, moved: StainState) -> StainState:
        # Depths above that of the cleanest part of what is seen; media take the common factor.
        if not moved.seen.any():
            return before
        floor = float(np.quantile(moved.depth[moved.seen], CLEAN_SHARE))
        depth = np.where(moved.seen, np.clip(moved.depth - floor, 0.0, DEEPEST), 0.0)
        return StainState(depth, np.where(moved.seen, depth - before.depth, 0.0), moved.seen, moved.squares)

    def _prior(self) -> Any:
        # Precision matrix (T, T), sparse: towards clean, and neighbours towards each other.
        from scipy import sparse

        ones = np.ones(len(self.neighbours))
        rows = np.arange(len(self.neighbours))
        difference = sparse.csr_matrix(
            (np.concatenate([ones, -ones]), (np.tile(rows, 2), self.neighbours.T.reshape(-1))),
            shape=(len(self.neighbours), self.texels),
        )
        return sparse.identity(self.texels, format="csr") / CLEAN_SD**2 + difference.T @ difference / NEIGHBOUR_SD**2

    def _moved(
        self, state: StainState, sums: StainSums, slope: Array, bound: float, momentum: float, low: float
    ) -> StainState:
        from scipy import sparse
        from scipy.sparse.linalg import spsolve

        # Data by the diagonal bound, priors exactly; texels of which noise says nothing have the prior's curvature
        # alone.
        prior, carried = self._prior(), np.maximum(sums.carried, 0.0)
        gradient = slope + prior @ state.depth
        step = -spsolve((sparse.diags(bound * carried) + prior).tocsc(), gradient) + momentum * state.moved
        depth = np.clip(state.depth + np.clip(step, -LONGEST_STEP, LONGEST_STEP), low, DEEPEST)
        return StainState(depth, depth - state.depth, carried > prior.diagonal(), float(sums.squares))
