"""Linearity of a camera's counts, measured from exposures of the same scene."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from services.core.robust import robust_sigma

Image = NDArray[np.float32]
FloatArray = NDArray[np.float64]

CONFIDENCE = 0.95
"""Confidence at which a curve must better pairs of exposures that it was not fitted to."""
MIN_PAIR_BLOCKS = 4
"""Smallest number of blocks of a pair of exposures that is compared."""
MIN_SHARE = 0.04
"""Smallest mean of a block as a fraction of full scale, 10 of 8 bits. Below it the error of the black level
dominates."""
NEAR_FULL = 0.95
"""Fraction of full scale above which a pixel counts as saturated. In a file that was made smaller, such a pixel may be
the mean of saturated and unsaturated ones."""
BLOCK = 16
"""Side in pixels of a block whose means are compared."""
MAX_CONTRAST = 0.2
"""Largest ratio of a block's standard deviation to its mean. Above it the block contains an edge, where partly
saturated pixels are the brightest."""
MIN_BLOCKS = 8
"""Smallest number of blocks from which linearity is measured."""
PRIOR = 0.3
"""Standard deviation of a curve's coefficients before it is fitted, so that few dark blocks tell no bend at full
scale."""
SMALLEST_DEVIATION = 1e-5
"""Deviation below which two pairs are equally good."""


@dataclass(frozen=True)
class Series:
    """Two exposures of the same scene.

    Attributes:
        shorter, longer: counts above black, (H, W) or (H, W, C); saturated pixels are NaN.
        ratio: ratio of exposure time × gain × level, longer to shorter.
        step: names both exposures; pairs of one step share the errors of their times. If None, the pair has a step of
            its own.
    """

    shorter: Image
    longer: Image
    ratio: float
    step: Hashable = None


@dataclass(frozen=True)
class LeftOut:
    """Median deviations from the exposures' ratio of pairs that were left out of a fit, one step at a time.

    Attributes:
        plain: of the counts as they are, the geometric mean over the pairs.
        curved: of counts linearised by the curve of the other steps.
        is_better: whether the curve betters the pairs significantly.
    """

    plain: float
    curved: float
    is_better: bool


@dataclass(frozen=True)
class Linearity:
    """Linearity of a camera's counts.

    Attributes:
        ratios: (N,) (longer / shorter) / (ratio of the exposures) of every pair of blocks; 1 for a linear camera.
        curve: a, b of linear = s (1 + a x + b x²), x = s / full; zeros for a linear camera.
        full: counts at saturation.
        left_out: how well a curve predicts pairs that it was not fitted to; None where none was fitted.
    """

    ratios: FloatArray
    curve: tuple[float, float]
    full: float
    left_out: LeftOut | None = None

    @property
    def is_linear(self) -> bool:
        """Whether counts need no correction."""
        return self.curve == (0.0, 0.0)

    def verdict(self) -> str:
        """What is done to the counts, and why."""
        unseen = self.left_out
        if unseen is None:
            return (
                "its counts are taken as they are, as no curve can be tested on these frames; two steps of exposures of"
                " enough light would allow it"
            )
        change = f"from {unseen.plain:.2%} to {unseen.curved:.2%} off"
        if self.is_linear:
            return (
                f"its counts are taken as they are, as a curve brings exposures that it was not fitted to {change},"
                " which is no significant gain"
            )
        return f"its counts are linearised by a curve, which brings exposures that it was not fitted to {change}"

    def linearised(self, signal: Image) -> Image:
        """Convert counts above black to counts proportional to the light."""
        if self.is_linear:
            return signal
        x = signal / np.float32(self.full)
        a, b = (np.float32(value) for value in self.curve)
        return np.asarray(signal * (1 + x * (a + x * b)), dtype=np.float32)


def measure_linearity(series: Sequence[Series], full: float) -> Linearity:
    """Compare exposures block by block, and fit a curve if the counts contradict a linear camera.

    A curve is applied only where it betters pairs of exposures that it was not fitted to. The pairs of each step of
    exposures are left out in turn, because a shutter time that is off moves all pairs of a step alike. What the curve
    of the other steps says of a pair is compared with what is seen: the share of it that is true must be above one
    half, where the curve begins to better the pair, by Student's t over the pairs. With one step of exposures a curve
    cannot be told from a shutter time, and the counts stay.

    Args:
        series: pairs of exposures.
        full: counts at saturation, which scale the curve.
    """
    pairs = _pairs(series, full)
    if sum(len(pair.observed) for pair in pairs) < MIN_BLOCKS:
        return Linearity(np.empty(0), (0.0, 0.0), full)
    ratios = np.exp(np.concatenate([pair.observed for pair in pairs]))
    curve = _curve(pairs)
    unseen = _left_out(pairs) if curve else None
    if curve is None or unseen is None or not unseen.is_better:
        return Linearity(ratios, (0.0, 0.0), full, unseen)
    return Linearity(ratios, curve, full, unseen)


@dataclass(frozen=True)
class _Pair:
    """Blocks of two exposures: both means (N,) as fractions of full scale, and log(y / x) less that of the exposures'
    ratio.
    """

    x: FloatArray
    y: FloatArray
    observed: FloatArray
    step: Hashable


def _pairs(series: Sequence[Series], full: float) -> list[_Pair]:
    pairs = []
    for k, one in enumerate(series):
        found = list(_blocks(one, full))
        if found:
            first, second = np.concatenate(found, axis=1)
            observed = np.log(second / first / one.ratio)
            pairs.append(_Pair(first / full, second / full, observed, k if one.step is None else one.step))
    return pairs


def _left_out(pairs: Sequence[_Pair]) -> LeftOut | None:
    """Deviations of each pair by the curve of the other steps; None with fewer than two pairs or without a curve."""
    shares, weights, medians = [], [], []
    for pair in pairs:
        others = [one for one in pairs if one.step != pair.step]
        if len(pair.observed) < MIN_PAIR_BLOCKS or sum(len(one.observed) for one in others) < MIN_BLOCKS:
            continue
        curve = _curve(others)
        if curve is None:
            return None
        observed, predicted = pair.observed, _log_factor(pair.x, curve) - _log_factor(pair.y, curve)
        medians.append([float(np.median(np.abs(one))) for one in (observed, observed - predicted)])
        # Blocks that neither hypothesis explains, such as those with an edge, count little.
        rest = np.minimum(np.abs(observed), np.abs(observed - predicted))
        weight = 1 / (1 + (rest / (robust_sigma(rest) + SMALLEST_DEVIATION)) ** 2)
        power = float(np.sum(weight * predicted**2))
        shares.append(float(np.sum(weight * predicted * observed)) / max(power, SMALLEST_DEVIATION**2))
        weights.append(power)
    if len(shares) < 2 or not any(weights):
        return None
    share, weight = np.array(shares), np.array(weights) / np.sum(weights)
    mean = float(weight @ share)
    count = len(share)
    se = float(np.sqrt(np.square(weight * (share - mean)).sum() * count / (count - 1)))
    limit = float(student.ppf(CONFIDENCE, count - 1))
    plain, curved = np.exp(np.log(np.maximum(medians, SMALLEST_DEVIATION)).mean(axis=0))
    return LeftOut(float(plain), float(curved), bool(curved < plain and mean - 0.5 > limit * se))


def _log_factor(x: FloatArray, curve: tuple[float, float]) -> FloatArray:
    a, b = curve
    return np.asarray(np.log(np.maximum(1 + x * (a + x * b), 0.1)))


def _curve(pairs: Sequence[_Pair]) -> tuple[float, float] | None:
    """Fit the curve f(s) = s (1 + a s + b s²) by Gauss-Newton; None where none can be fitted.

    log(f(y) / f(x)) must equal the logarithm of the exposures' ratio. An error of the black level by a part of a count
    also bends the curve at its dark end, so an offset is fitted with it and discarded.

    Returns:
        a, b.
    """
    x, y, observed = (np.concatenate([getattr(pair, name) for pair in pairs]) for name in ("x", "y", "observed"))
    a, b, offset = 0.0, 0.0, 0.0
    for _ in range(12):
        at_x, at_y = (1 + v * (a + v * b) for v in (x, y))
        if min(at_x.min(), at_y.min()) <= 0.1 or min(x.min(), y.min()) + offset <= 0:
            return None
        design = np.stack([y / at_y - x / at_x, y**2 / at_y - x**2 / at_x, 1 / (y + offset) - 1 / (x + offset)], axis=1)
        residual = observed + np.log(at_y / at_x) + np.log1p(offset / y) - np.log1p(offset / x)
        # Weight the residuals robustly (Cauchy), so that blocks at edges that moved have little influence.
        scale = robust_sigma(residual - np.median(residual)) + 1e-6
        weight = 1 / (1 + (residual / scale) ** 2)
        prior = np.diag([(scale / PRIOR) ** 2, (scale / PRIOR) ** 2, 1e-9])
        normal = (design * weight[:, None]).T @ design + prior
        step = np.linalg.solve(normal, -(design * weight[:, None]).T @ residual - prior @ (a, b, offset))
        a, b, offset = a + step[0], b + step[1], offset + step[2]
        if np.abs(step).max() < 1e-6:
            break
    return float(a), float(b)


def _blocks(series: Series, full: float) -> Iterator[FloatArray]:
    """Yield for each channel (2, N): block means of the shorter and longer exposure.

    Blocks with a saturated pixel, an edge or too little light are left out.
    """
    shorter, longer = (np.atleast_3d(image) for image in (series.shorter, series.longer))
    edge = max(1, min(BLOCK, shorter.shape[0] // 2, shorter.shape[1] // 2))
    height, width = (length // edge * edge for length in shorter.shape[:2])
    for channel in range(shorter.shape[2]):
        pair = [
            image[:height, :width, channel].reshape(height // edge, edge, width // edge, edge).astype(np.float64)
            for image in (shorter, longer)
        ]
        first, second = (image.mean(axis=(1, 3)) for image in pair)
        even = pair[1].std(axis=(1, 3)) < MAX_CONTRAST * second
        usable = np.isfinite(first) & np.isfinite(second) & even & (np.minimum(first, second) > MIN_SHARE * full)
        if usable.any():
            yield np.stack([first[usable], second[usable]])
