"""A camera's noise, measured from pairs of its own frames by photon transfer.

Two frames of the same scene differ by noise alone, whatever fixed pattern both share. The variance of a count whose
signal above black is s is

    variance(s) = (read * gain)² + 1/12 + counts_per_electron * gain * s

(Janesick 2007, Photon Transfer; EMVA 1288): the sum of read noise, rounding, and the Poisson noise of the electrons.
So pairs of black frames give the read noise, and pairs of lit frames the slope.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]

ROUNDING = 1 / 12
"""Variance of rounding to whole counts, counts²."""
CLIP_SIGMAS = 5.0
"""Number of standard deviations beyond which differences are left out, as flickering pixels or things that moved; 6e-7
of a normal distribution lie there."""
BINS = 24
"""Largest number of signal levels at which the variance of a pair is estimated."""
MIN_IN_BIN = 200
"""Least number of pixels in a bin; the standard error of its variance is 10 % then."""
MIN_SLOPE_SIGMAS = 5.0
"""Smallest ratio of a slope to its standard error; a less certain slope counts as not measured."""


@dataclass(frozen=True)
class NoiseModel:
    """Noise of one camera.

    Attributes:
        read_counts: standard deviation without light, before rounding, at gain 1; it is proportional to the gain.
        counts_per_electron: counts per electron at gain 1.
        relative: standard deviation in proportion to the signal, as a fraction; only an assumed model has it.
    """

    read_counts: float
    counts_per_electron: float
    relative: float = 0.0

    def variance(self, signal: Image, gain: float) -> Image:
        """Variance, counts², of counts whose expectation above black is ``signal``; negative signals count as 0."""
        light = np.maximum(signal, 0)
        constant = np.float32((self.read_counts * gain) ** 2 + ROUNDING)
        shot = np.float32(self.counts_per_electron * gain) * light
        return np.asarray(constant + shot + (np.float32(self.relative) * light) ** 2, dtype=np.float32)


@dataclass(frozen=True)
class LitPair:
    """Two frames of the same scene; pixels that are saturated in either are NaN.

    Attributes:
        first, second: counts above black, any shape, the same for both.
        gain: linear gain of both.
    """

    first: Image
    second: Image
    gain: float


def read_noise(black: Sequence[Image], gain: float) -> float | None:
    """Read noise at gain 1 before rounding, counts, from black frames of one exposure; None for fewer than two frames.

    Rounding adds 1/12 to the variance where the noise is above half a count; below that the result is an upper bound.
    """
    if len(black) < 2:
        return None
    variances = [clipped_variance(b - a) / 2 for a, b in pairwise(black)]
    return float(np.sqrt(max(sum(variances) / len(variances) - ROUNDING, 0.0))) / gain


def shot_noise(pairs: Iterable[LitPair], read_counts: float | None) -> tuple[float, float] | None:
    """Counts per electron and read noise in counts, both at gain 1; None where the pairs do not determine the slope.

    Fits the line of variance against signal by least squares, weighted by the standard errors of the variances.

    Args:
        read_counts: read noise at gain 1 as measured from black frames; None to estimate it as the line's intercept.
    """
    rows, values, spread = [], [], []
    for pair in pairs:
        for ratio, level, variance, pixels in _bins(pair):
            # The variance of first - ratio * second is the sum of both terms' variances, each at its own signal.
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
    """Variance of differences around their mean, without outliers beyond ``CLIP_SIGMAS``."""
    kept = np.asarray(values, dtype=np.float64).ravel()
    for _ in range(5):
        mean, sigma = kept.mean(), kept.std()
        inside = np.abs(kept - mean) <= CLIP_SIGMAS * sigma
        if inside.all():
            break
        kept = kept[inside]
    return float(kept.var())


def _bins(pair: LitPair) -> Iterable[tuple[float, float, float, int]]:
    """For each level of signal: ratio of brightness, mean signal of the first frame, variance of the difference, and
    number of pixels.
    """
    usable = np.isfinite(pair.first) & np.isfinite(pair.second)
    first, second = pair.first[usable].astype(np.float64), pair.second[usable].astype(np.float64)
    if first.size < MIN_IN_BIN or second.sum() <= 0 or first.sum() <= 0:
        return
    # Scaling by the ratio of the sums removes the flicker of a light as well as a different exposure.
    ratio = float(first.sum() / second.sum())
    difference = first - ratio * second
    # The sum of both frames is uncorrelated with this difference where shot noise dominates, so binning by the sum does
    # not select by noise.
    level = (first + second) * ratio / (1 + ratio)
    for chosen in np.array_split(np.argsort(level, kind="stable"), max(1, min(BINS, first.size // MIN_IN_BIN))):
        if len(chosen) >= MIN_IN_BIN:
            yield (
                ratio,
                float(level[chosen].mean()),
                clipped_variance(difference[chosen].astype(np.float32)),
                len(chosen),
            )
