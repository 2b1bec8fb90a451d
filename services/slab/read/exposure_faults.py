"""Faults of exposures that their own frames show: exposures that contradict each other, and counts per electron that
the frames' scatter contradicts.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.errors import CaptureInputError
from services.core.raw.merge import Exposure
from services.core.raw.noise import NoiseModel
from services.core.slab.exposures import SlabExposure

MAX_RATIO = 1.5
"""Largest ratio of the counts per second of two frames of one image. Shutters and gains are known to a few per cent,
and times that were mixed up differ by more."""
MIN_SIGNAL_SIGMAS = 10.0
"""Number of standard deviations above black from which a pixel is compared: an error of the black level by the read
noise then changes it by a tenth at most."""
MAX_SHOT_RATIO = 2.0
"""Largest ratio of measured to stated counts per electron, either way. Few frames measure it to 20 %, and stating
electrons per count in its place is wrong by the square of the conversion."""


def require_consistent(
    root: Path, frames: Sequence[SlabExposure], exposures: Sequence[Exposure], noise: NoiseModel
) -> None:
    """Compare the exposures of one image, pair by pair in the order of their exposure.

    Raises:
        CaptureInputError: two frames differ in their counts per second and gain; names both.
    """
    ordered = sorted(zip(frames, exposures, strict=True), key=lambda one: one[1].factor)
    for (frame, exposure), (other, longer) in pairwise(ordered):
        bright = _is_bright(exposure, noise) & _is_bright(longer, noise)
        if not bright.any():
            continue
        first, second = (float(one.signal[bright].sum()) / one.factor for one in (exposure, longer))
        if max(first, second) > MAX_RATIO * min(first, second):
            raise CaptureInputError(
                f"Frames {root / frame.file} and {root / other.file} (camera {frame.camera}, light {frame.light})"
                f" differ {max(first / second, second / first):.3g}-fold in counts per second and gain; check their"
                " exposure_s and gain, and which file is which."
            )


def _is_bright(exposure: Exposure, noise: NoiseModel) -> NDArray[np.bool_]:
    sigma = np.sqrt(noise.variance(exposure.signal, exposure.gain) + exposure.extra_variance)
    return np.asarray((exposure.headroom > 0) & (exposure.signal > MIN_SIGNAL_SIGMAS * sigma))


def shot_noise_fault(camera: str, stated: float, measured: float) -> str:
    """A sentence where the counts per electron that a camera's frames show are not those stated; empty otherwise."""
    if 1 / MAX_SHOT_RATIO <= measured / stated <= MAX_SHOT_RATIO:
        return ""
    return (
        f"The frames of camera {camera} scatter like {measured:.2g} counts per electron, and its counts.per_electron"
        f" says {stated:g}; correct it, or leave it out with read_noise so that the frames tell both."
    )
