"""Linearity of a camera's counts, measured from exposures of the same scene."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.robust import robust_sigma

Image = NDArray[np.float32]
FloatArray = NDArray[np.float64]

MIN_DEVIATION = 0.03
"""Smallest relative deviation from linearity that is corrected. On real 8-bit frames of a linear sensor, edges and
shutter times gave a spurious deviation of 2.9 %."""
MIN_SIGMAS = 4.0
"""Smallest deviation in standard errors; a less certain one is taken for noise."""
MIN_SHARE = 0.04
"""Smallest mean of a block as a fraction of full scale, 10 of 8 bits. Below it the error of the black level
dominates."""
NEAR_FULL = 0.95
"""Fraction of full scale above which a pixel counts as saturated. In a file that was made smaller, such a pixel may be
the mean of saturated and unsaturated ones."""
MUST_EXPLAIN = 0.3
"""Smallest fraction by which a curve must reduce the median deviation; a curve that reduces it less follows flicker and
edges."""
BLOCK = 16
"""Side in pixels of a block whose means are compared."""
MAX_CONTRAST = 0.2
"""Largest ratio of a block's standard deviation to its mean. Above it the block contains an edge, where partly
saturated pixels are the brightest."""
MIN_BLOCKS = 8
"""Smallest number of blocks from which linearity is measured."""


@dataclass(frozen=True)
class Series:
    """Two exposures of the same scene.

    Attributes:
        shorter, longer: counts above black, (H, W) or (H, W, C); saturated pixels are NaN.
        ratio: ratio of exposure time × gain × level, longer to shorter.
    """

    shorter: Image
    longer: Image
    ratio: float


@dataclass(frozen=True)
class Linearity:
    """Linearity of a camera's counts.

    Attributes:
        ratios: (N,) (longer / shorter) / (ratio of the exposures) of every pair of blocks; 1 for a linear camera.
        curve: a, b of linear = s (1 + a x + b x²), x = s / full; zeros for a linear camera.
        full: counts at saturation.
    """

    ratios: FloatArray
    curve: tuple[float, float]
    full: float

    @property
    def is_linear(self) -> bool:
        """Whether counts need no correction."""
        return self.curve == (0.0, 0.0)

    def linearised(self, signal: Image) -> Image:
        """Convert counts above black to counts proportional to the light."""
        if self.is_linear:
            return signal
        x = signal / np.float32(self.full)
        a, b = (np.float32(value) for value in self.curve)
        return np.asarray(signal * (1 + x * (a + x * b)), dtype=np.float32)


def measure_linearity(series: Sequence[Series], full: float) -> Linearity:
    """Compare exposures block by block, and fit a curve if they contradict a linear camera.

    Args:
        series: pairs of exposures.
        full: counts at saturation, which scale the curve.
    """
    pairs = [np.concatenate(found, axis=1) for found in [list(_blocks(one, full)) for one in series] if found]
    if not pairs or sum(pair.shape[1] for pair in pairs) < MIN_BLOCKS:
        return Linearity(np.empty(0), (0.0, 0.0), full)
    shorter, longer, log_ratio = np.concatenate(pairs, axis=1)
    observed = np.log(longer / shorter) - log_ratio
    return Linearity(np.exp(observed), _curve(shorter / full, longer / full, observed), full)


def _curve(x: FloatArray, y: FloatArray, observed: FloatArray) -> tuple[float, float]:
    """Fit the curve f(s) = s (1 + a s + b s²) by Gauss-Newton; zeros unless the deviation from linearity is clear.

    log(f(y) / f(x)) must equal the logarithm of the exposures' ratio. An error of the black level by a part of a count
    also bends the curve at its dark end, so an offset is fitted with it and discarded.

    Args:
        x, y: (N,) block means of the shorter and the longer exposure as fractions of full scale.
        observed: (N,) log(y / x) minus the logarithm of the exposures' ratio.

    Returns:
        a, b.
    """
    a, b, offset = 0.0, 0.0, 0.0
    for _ in range(12):
        at_x, at_y = (1 + v * (a + v * b) for v in (x, y))
        if min(at_x.min(), at_y.min()) <= 0.1 or min(x.min(), y.min()) + offset <= 0:
            return 0.0, 0.0
        design = np.stack([y / at_y - x / at_x, y**2 / at_y - x**2 / at_x, 1 / (y + offset) - 1 / (x + offset)], axis=1)
        residual = observed + np.log(at_y / at_x) + np.log1p(offset / y) - np.log1p(offset / x)
        # Weight the residuals robustly (Cauchy), so that blocks at edges that moved have little influence.
        scale = robust_sigma(residual - np.median(residual)) + 1e-6
        weight = 1 / (1 + (residual / scale) ** 2)
        normal = (design * weight[:, None]).T @ design + 1e-9 * np.eye(3)
        step = np.linalg.solve(normal, -(design * weight[:, None]).T @ residual)
        a, b, offset = a + step[0], b + step[1], offset + step[2]
        if np.abs(step).max() < 1e-6:
            break
    # Reject a curve that explains too little of the deviations, or whose own largest deviation is small or uncertain
    if np.median(np.abs(residual)) > (1 - MUST_EXPLAIN) * np.median(np.abs(observed)):
        return 0.0, 0.0
    covariance = scale**2 * np.linalg.inv(normal)[:2, :2]
    levels = np.linspace(0, max(y.max(), x.max()), 16)[1:]
    terms = np.stack([levels, levels**2], axis=1)
    deviation, error = terms @ (a, b), np.sqrt(np.einsum("ij,jk,ik->i", terms, covariance, terms))
    worst = int(np.argmax(np.abs(deviation)))
    if abs(deviation[worst]) < MIN_DEVIATION or abs(deviation[worst]) < MIN_SIGMAS * error[worst]:
        return 0.0, 0.0
    return float(a), float(b)


def _blocks(series: Series, full: float) -> Iterator[FloatArray]:
    """Yield for each channel (3, N): block means of the shorter and longer exposure, and log of the exposures' ratio.

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
            a, b = first[usable], second[usable]
            yield np.stack([a, b, np.full(len(a), np.log(series.ratio))])
