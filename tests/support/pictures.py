"""Comparison of two renderers' images of one scene, pixel by pixel.

z-scores come from 16 batches of each renderer, mapped through Student's t with Welch's degrees of freedom. The number
of |z| > 3 must stay below its 99.9 % binomial quantile, |mean z| below 4 standard errors, and the rms between 0.9 and
1.1 (with few pixels: within the chi-square bounds that noise leaves with probability 1e-3). The lights of a pixel share
its random walks, so the number of independent values is the number of pixels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from tests.support.z_scores import rms_bounds, student_to_normal

BATCHES = 16


def pixel_scores(
    means: list[NDArray[np.float64]], variances: list[NDArray[np.float64]], block: int = 1
) -> NDArray[np.float64]:
    """z-scores of the difference between two renderers' images (lights, H, W), summed over blocks of pixels.

    Args:
        means: one image stack per renderer.
        variances: variances of ``means``, each estimated from BATCHES batches.
        block: edge length of a block in pixels.

    Returns:
        (lights, H // block, W // block), NaN where both variances are zero.
    """
    means = [sum_blocks(mean, block) for mean in means]
    squares = [sum_blocks(variance**2, block) for variance in variances]
    total = sum_blocks(variances[0] + variances[1], block)
    lit = total > 0
    freedom = (BATCHES - 1) * total[lit] ** 2 / (squares[0] + squares[1])[lit]
    z = np.full(total.shape, np.nan)
    z[lit] = student_to_normal((means[0] - means[1])[lit] / np.sqrt(total[lit]), freedom)
    return z


def sum_blocks(images: NDArray[np.float64], block: int) -> NDArray[np.float64]:
    *others, height, width = images.shape
    cut = images[..., : height // block * block, : width // block * block]
    return cut.reshape(*others, height // block, block, width // block, block).sum(axis=(-3, -1))


def require_same_pictures(scores: NDArray[np.float64], least: int) -> None:
    """Assert that scores (lights, H, W) or (H, W) are compatible with noise alone, and that at least ``least`` are
    finite.
    """
    z = scores[np.isfinite(scores)]
    by_pixel = scores.reshape(-1, scores.shape[-2] * scores.shape[-1]).T
    of_pixels = np.array([row[np.isfinite(row)].mean() for row in by_pixel if np.isfinite(row).any()])
    assert len(z) >= least
    assert abs(of_pixels.mean()) < 4 * of_pixels.std(ddof=1) / np.sqrt(len(of_pixels))
    assert np.count_nonzero(np.abs(z) > 3) <= stats.binom.ppf(0.999, len(z), 2 * stats.norm.sf(3))
    low, high = rms_bounds(len(of_pixels), rule=(0.9, 1.1))
    assert low <= np.sqrt(np.mean(z**2)) <= high
