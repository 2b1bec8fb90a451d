"""Several exposures of the same light as one image, each pixel weighted by its shot and read noise (Hasinoff et al.
2010).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.raw.noise import NoiseModel

Image = NDArray[np.float32]
BoolArray = NDArray[np.bool_]

FULL_SIGMAS = 4.0
"""Longer exposures are left out where they come this near to full: of those, noise lets only the dark ones through."""


@dataclass(frozen=True)
class Exposure:
    """Counts of one frame, linear in light.

    Attributes:
        signal: above black.
        extra_variance: of the black that was subtracted, and of what else was.
        headroom: counts left to full; not positive where the pixel is full.
        factor: exposure in seconds times gain times level; the signal is in proportion to it.
        gain: linear.
    """

    signal: Image
    extra_variance: Image | float
    headroom: Image
    factor: float
    gain: float


def merge(exposures: Sequence[Exposure], noise: NoiseModel) -> tuple[Image, Image, BoolArray]:
    """Counts per second at gain 1 and level 1, their variance, and where every exposure is full; shapes as the
    signals'.

    Weights are inverse variances at the *expected* signal. Those of the noisy count itself would prefer counts that
    came out low.
    """
    order = sorted(exposures, key=lambda one: one.factor)
    usable = [order[0].headroom > 0]
    for one in order[1:]:
        full = np.float32(FULL_SIGMAS) * np.sqrt(noise.variance(one.signal, one.gain))
        usable.append(one.headroom > full)

    # All light that was seen, over all the time it was seen for: the best estimate where shot noise prevails.
    light, time = (np.zeros_like(order[0].signal) for _ in range(2))
    for one, seen in zip(order, usable, strict=True):
        light += np.where(seen, one.signal, 0)
        time += np.where(seen, np.float32(one.factor), 0)
    expected = (np.maximum(light, 0) / np.maximum(time, np.float32(1e-30))).astype(np.float32)

    # Then each exposure at the inverse variance that this expectation gives it.
    weighted, weights = (np.zeros_like(light) for _ in range(2))
    for one, seen in zip(order, usable, strict=True):
        variance = noise.variance(expected * np.float32(one.factor), one.gain) + one.extra_variance
        weight = np.where(seen, np.float32(one.factor) ** 2 / variance, 0).astype(np.float32)
        weighted += weight * (one.signal / np.float32(one.factor))
        weights += weight
    lost: BoolArray = weights == 0
    safe = np.maximum(weights, np.float32(1e-30))
    return (
        np.where(lost, 0, weighted / safe).astype(np.float32),
        np.where(lost, 0, 1 / safe).astype(np.float32),
        lost,
    )
