"""Merge the exposures of one wavelength into linear images with variances, as those of all raw cameras are.

A camera's noise is known beforehand or measured from its own frames: read noise from black frames of one exposure,
counts per electron from pairs of frames of one light. Light and camera stand still, so two frames of different exposure
make a pair as well as two of the same.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby, pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.errors import CaptureInputError
from services.core.raw.frames import Frame, read_frame
from services.core.raw.merge import Exposure, merge
from services.core.raw.noise import ROUNDING, LitPair, NoiseModel, read_noise, shot_noise
from services.core.raw.records import RawCamera, RawFolder, RawFrame, RawLight
from services.core.robust import robust_sigma
from services.core.slab.exposures import CameraCounts, SlabExposure
from services.core.slab.folder import SlabFolder, SlabImage
from services.slab.read.exposure_faults import require_consistent, shot_noise_fault

Array = NDArray[np.float64]
Counts = NDArray[np.float32]

ASSUMED_NOISE = NoiseModel(read_counts=2.0, counts_per_electron=1.0)
"""Noise by which exposures are weighted where no frames measure it; variances are then assumed as for images that come
without."""
MIN_ABOVE_BLACK_SE = 5.0
"""Number of standard errors of its mean by which a frame must be brighter than black; otherwise the beam was off."""


@dataclass(frozen=True)
class Merged:
    """Images by camera and light (rows, columns), per unit of the beam's power; NaN where every exposure is
    saturated.
    """

    values: dict[tuple[str, str], Array]
    variances: dict[tuple[str, str], Array] | None
    """Variances of these images; None where the frames do not determine the noise."""
    faults: tuple[str, ...]
    """Sentences on stated noise that the frames contradict."""


def merged_images(root: Path, folder: SlabFolder, wavelength_nm: float) -> Merged:
    """Merge all exposures of one wavelength.

    Raises:
        CaptureInputError: a frame cannot be read, contradicts its description or another frame, or holds no light;
            names the frame.
    """
    frames = folder.exposures_at(wavelength_nm)
    values: dict[tuple[str, str], Array] = {}
    variances: dict[tuple[str, str], Array] = {}
    faults, is_known = list[str](), True
    for camera in dict.fromkeys(one.camera for one in frames):
        stack = _Stack(root, folder, tuple(one for one in frames if one.camera == camera))
        noise = stack.noise()
        is_known &= noise is not None
        faults += stack.noise_faults()
        for image in folder.images_at(wavelength_nm):
            if image.camera == camera:
                rate, variance, lost = merge(stack.exposures_of(image, noise or ASSUMED_NOISE), noise or ASSUMED_NOISE)
                key = camera, image.light
                values[key] = np.where(lost, np.nan, rate.astype(np.float64)) / folder.beam.power
                variances[key] = np.where(lost, np.nan, variance.astype(np.float64)) / folder.beam.power**2
    return Merged(values, variances if is_known else None, tuple(faults))


@dataclass(frozen=True)
class _Stack:
    """All frames of one camera at one wavelength."""

    root: Path
    folder: SlabFolder
    frames: tuple[SlabExposure, ...]

    def counts(self, frame: SlabExposure) -> Counts:
        """Counts of a frame (rows, columns)."""
        return self.read(frame).counts[..., 0].astype(np.float32)

    def read(self, frame: SlabExposure) -> Frame:
        """A frame's counts (rows, columns, 1), and from which count on they are full."""
        pixels = self.folder.pixels
        camera = RawCamera(
            name=frame.camera,
            size=(pixels.columns, pixels.rows),
            bits=frame.bits,
            shift=frame.shift,
            saturation_counts=frame.saturation_counts,
            channels=("light",),
        )
        lights = () if frame.light is None else (RawLight(name=frame.light),)
        raw = RawFrame(
            camera=frame.camera, file=frame.file, kind=frame.kind, light=frame.light, exposure_s=frame.exposure_s,
            gain=frame.gain,
        )  # fmt: skip
        described = RawFolder(units="mm", camera=(camera,), light=lights, frame=(raw,))
        return read_frame(self.root, described, raw)

    @property
    def known(self) -> CameraCounts:
        """What is known of the camera's counts beforehand."""
        (camera,) = (one for one in self.folder.cameras if one.name == self.frames[0].camera)
        return camera.counts or CameraCounts()

    def black(self, frame: SlabExposure) -> tuple[Counts, float]:
        """Mean of the black frames nearest in gain, then in exposure, and their number; infinitely many where the
        counts without light are known.
        """
        if self.known.black is not None:
            pixels = self.folder.pixels
            return np.full((pixels.rows, pixels.columns), self.known.black, np.float32), math.inf
        black = [one for one in self.frames if one.kind == "black"]
        nearest = min(black, key=lambda one: (abs(np.log(one.gain / frame.gain)), _times_apart(one, frame)))
        own = [one for one in black if (one.gain, one.exposure_s) == (nearest.gain, nearest.exposure_s)]
        return np.mean([self.counts(one) for one in own], axis=0, dtype=np.float32), len(own)

    def exposure(self, frame: SlabExposure, noise: NoiseModel) -> Exposure:
        """A frame's counts above black."""
        read, (black, averaged) = self.read(frame), self.black(frame)
        counts = read.counts[..., 0].astype(np.float32)
        full = np.broadcast_to(read.fullness.at(), read.counts.shape)[..., 0]
        black_variance = float(noise.variance(np.zeros((), np.float32), frame.gain)) / averaged
        return Exposure(
            counts - black, black_variance, full - counts, frame.exposure_s * frame.gain, frame.gain
        )  # fmt: skip

    def exposures_of(self, image: SlabImage, noise: NoiseModel) -> list[Exposure]:
        """All exposures of an image's light.

        Raises:
            CaptureInputError: a frame is no brighter than black, and the others do not say that it may be; or two
                frames contradict each other.
        """
        frames = [one for one in self.frames if one.light == image.light]
        found = [self.exposure(one, noise) for one in frames]
        means = [float(np.mean(one.signal)) for one in found]
        seen = [MIN_ABOVE_BLACK_SE * _error_of_mean(one.signal) for one in found]
        # A full pixel counts for less than its light, so these are the least counts per factor of exposure.
        rates = [mean / one.factor for mean, one, least in zip(means, found, seen, strict=True) if mean > least]
        for frame, one, mean, least in zip(frames, found, means, seen, strict=True):
            if mean <= least and (not rates or max(rates) * one.factor > 2 * least):
                raise CaptureInputError(
                    f"Frame {self.root / frame.file} (camera {frame.camera}, light {frame.light}) is no brighter than"
                    " black; expose it for longer, or leave it out."
                )
        require_consistent(self.root, frames, found, noise)
        return found

    def noise(self) -> NoiseModel | None:
        """Noise of the camera, known or from its frames; None where they do not determine it."""
        if self.known.read_noise is not None and self.known.per_electron is not None:
            return NoiseModel(self.known.read_noise, self.known.per_electron)
        read = self._read_counts()
        measured = shot_noise(self._pairs(), read)
        return None if measured is None else NoiseModel(measured[1], measured[0])

    def noise_faults(self) -> list[str]:
        """Sentences on stated counts per electron that the frames contradict."""
        known = self.known
        if known.per_electron is None or (measured := shot_noise(self._pairs(), known.read_noise)) is None:
            return []
        fault = shot_noise_fault(self.frames[0].camera, known.per_electron, measured[0])
        return [fault] if fault else []

    def _read_counts(self) -> float | None:
        black = sorted((one for one in self.frames if one.kind == "black"), key=_setting)
        squares, weights = [], []
        for (_, gain), own in groupby(black, key=_setting):
            counts = [self.counts(one) for one in own]
            if (read := read_noise(counts, gain)) is not None:
                squares.append(read**2)
                weights.append(len(counts) - 1)
        return float(np.sqrt(np.average(squares, weights=weights))) if squares else None

    def _pairs(self) -> Iterator[LitPair]:
        lit = sorted((one for one in self.frames if one.light is not None), key=lambda one: (one.light or "", one.gain))
        for _, own in groupby(lit, key=lambda one: (one.light, one.gain)):
            for first, second in pairwise(sorted(own, key=_setting)):
                a, b = (self._above_black(one) for one in (first, second))
                yield LitPair(a, b, first.gain)

    def _above_black(self, frame: SlabExposure) -> Counts:
        """Counts above black (rows, columns); NaN where saturated."""
        exposure = self.exposure(frame, NoiseModel(0.0, 0.0))
        return np.where(exposure.headroom > 0, exposure.signal, np.float32(np.nan)).astype(np.float32)


def _error_of_mean(signal: Counts) -> float:
    """Standard error of a frame's mean by its noise; by medians, because a narrow beam on a few pixels is no noise."""
    spread = robust_sigma(signal - np.median(signal))
    return float(np.sqrt((spread**2 + ROUNDING) / signal.size))


def _setting(frame: SlabExposure) -> tuple[float, float]:
    return frame.exposure_s, frame.gain


def _times_apart(first: SlabExposure, second: SlabExposure) -> float:
    return float(abs(np.log(first.exposure_s / second.exposure_s)))
