"""A camera's noise, measured from pairs of its own frames by photon transfer.

Two frames of the same thing differ by noise alone, whatever pattern both share. The variance of a count above black s
is

    variance(s) = (read * gain)² + 1/12 + counts_per_electron * gain * s

(Janesick 2007, Photon Transfer; EMVA 1288): what reading adds, what rounding adds, and the Poisson noise of the
electrons. So pairs of black frames tell the first, and pairs of lit ones the slope.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]

ROUNDING = 1 / 12
"""Variance of rounding to whole counts."""
CLIP_SIGMAS = 5.0
"""Differences beyond this are pixels that flicker or things that moved; 6e-7 of a normal distribution lie there."""
BINS = 24
"""Levels of signal at which the variance of a pair is looked at."""
MIN_IN_BIN = 200
"""Pixels without which a bin says little: its variance is unsure by 10 % then."""
MIN_SLOPE_SIGMAS = 5.0
"""A slope less certain than this is no measurement."""


@dataclass(frozen=True)
class NoiseModel:
    """Noise of one camera.

    Attributes:
        read_counts: standard deviation without light, before rounding, at gain 1; it grows with the gain.
        counts_per_electron: at gain 1.
        relative: noise in proportion to the signal; of an assumed model alone.
    """

    read_counts: float
    counts_per_electron: float
    relative: float = 0.0

    def variance(self, signal: Image, gain: float) -> Image:
        """Variance of a count whose expectation is ``signal`` above black; negative signals count as none."""
        light = np.maximum(signal, 0)
        constant = np.float32((self.read_counts * gain) ** 2 + ROUNDING)
        shot = np.float32(self.counts_per_electron * gain) * light
        return np.asarray(constant + shot + (np.float32(self.relative) * light) ** 2, dtype=np.float32)


@dataclass(frozen=True)
class LitPair:
    """Two frames of the same thing, counts above black; pixels that are full in either are NaN.

    Attributes:
        first, second: any shape, the same for both.
        gain: of both.
    """

    first: Image
    second: Image
    gain: float


def read_noise(black: Sequence[Image], gain: float) -> float | None:
    """Read noise at gain 1 before rounding, counts, from black frames of one exposure; None from fewer than two.

    Rounding adds 1/12 to the variance where the noise is above half a count; below that the result is a bound from
    above.
    """
    if len(black) < 2:
        return None
    variances = [clipped_variance(b - a) / 2 for a, b in pairwise(black)]
    return float(np.sqrt(max(sum(variances) / len(variances) - ROUNDING, 0.0))) / gain


def shot_noise(pairs: Iterable[LitPair], read_counts: float | None) -> tuple[float, float] | None:
    """Counts per electron at gain 1, and read noise at gain 1; None where the pairs do not tell the slope.

    Args:
        read_counts: the read noise where black frames told it; None to take it from the line's start.
    """
    rows, values, spread = [], [], []
    for pair in pairs:
        for ratio, level, variance, pixels in _bins(pair):
            # The variance of first - ratio * second is that of both, each taken at its own signal.
            rows.append([(1 + ratio**2) * pair.gain**2, level * (1 + ratio) * pair.gain])
            values.append(variance - (1 + ratio**2) * ROUNDING)
            spread.append(variance * np.sqrt(2 / pixels))
    if len(rows) < 2:
        return None
    design, target, sigma = np.array(rows), np.array(values), np.array(spread)
    if read_counts is not None:
        target, design = target - design[:, 0] * read_counts**2, design[:, 1:]
    weighted = design / sigma[:, None]
    solution, *_ = np.linalg.lstsq(weighted, target / sigma, rcond=None)
    slope_se = float(np.sqrt(np.linalg.pinv(weighted.T @ weighted)[-1, -1]))
    slope = float(solution[-1])
    if slope < MIN_SLOPE_SIGMAS * slope_se:
        return None
    return slope, float(np.sqrt(max(solution[0], 0.0))) if read_counts is None else read_counts


def clipped_variance(values: Image) -> float:
    """Variance of differences around their mean, without the few that are no noise."""
    kept = np.asarray(values, dtype=np.float64).ravel()
    for _ in range(5):
        mean, sigma = kept.mean(), kept.std()
        inside = np.abs(kept - mean) <= CLIP_SIGMAS * sigma
        if inside.all():
            break
        kept = kept[inside]
    return float(kept.var())


def _bins(pair: LitPair) -> Iterable[tuple[float, float, float, int]]:
    """Ratio of brightness, mean signal of the first frame, variance of the difference, number of pixels; per level of
    signal.
    """
    usable = np.isfinite(pair.first) & np.isfinite(pair.second)
    first, second = pair.first[usable].astype(np.float64), pair.second[usable].astype(np.float64)
    if first.size < MIN_IN_BIN or second.sum() <= 0 or first.sum() <= 0:
        return
    # The ratio of the sums takes out a flickering light as well as another exposure.
    ratio = float(first.sum() / second.sum())
    difference = first - ratio * second
    # The sum of both frames is uncorrelated with this difference where shot noise prevails, so binning by it selects no
    # noise.
    level = (first + second) * ratio / (1 + ratio)
    for chosen in np.array_split(np.argsort(level, kind="stable"), max(1, min(BINS, first.size // MIN_IN_BIN))):
        if len(chosen) >= MIN_IN_BIN:
            yield (
                ratio,
                float(level[chosen].mean()),
                clipped_variance(difference[chosen].astype(np.float32)),
                len(chosen),
            )
