"""Merge several exposures under the same light into one image, each pixel weighted by its shot and read noise (Hasinoff
et al. 2010).
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
"""Distance to saturation, in standard deviations of the count, within which a pixel of a longer exposure is left out:
of such pixels, only those that noise has made darker stay below saturation."""


@dataclass(frozen=True)
class Exposure:
    """Counts of one frame, linear in light.

    Attributes:
        signal: counts above black, any shape.
        extra_variance: variance of the black frame and of everything else that was subtracted, counts².
        headroom: counts left to saturation; not positive where the pixel is saturated.
        factor: exposure in seconds times gain times level; the signal is proportional to it.
        gain: linear gain.
    """

    signal: Image
    extra_variance: Image | float
    headroom: Image
    factor: float
    gain: float


def merge(exposures: Sequence[Exposure], noise: NoiseModel) -> tuple[Image, Image, BoolArray]:
    """Merge exposures into one image.

    Weights are inverse variances at the *expected* signal. Inverse variances at the noisy count itself would favour
    counts that noise has made lower.

    Returns:
        Counts per second at gain 1 and level 1, their variance, and whether every exposure is saturated; each in the
        shape of the signals.
    """
    order = sorted(exposures, key=lambda one: one.factor)
    usable = [order[0].headroom > 0]
    for one in order[1:]:
        full = np.float32(FULL_SIGMAS) * np.sqrt(noise.variance(one.signal, one.gain))
        usable.append(one.headroom > full)

    # Estimate the expected signal: the sum of all usable signals over the sum of their factors, which is the best
    # estimate where shot noise dominates.
    light, time = (np.zeros_like(order[0].signal) for _ in range(2))
    for one, seen in zip(order, usable, strict=True):
        light += np.where(seen, one.signal, 0)
        time += np.where(seen, np.float32(one.factor), 0)
    expected = (np.maximum(light, 0) / np.maximum(time, np.float32(1e-30))).astype(np.float32)

    # Weight each exposure by its inverse variance at this expected signal.
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
