"""Black level, noise, linearity and vignetting of one camera, measured from its own frames; exposures above black."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.calibration.cameras_and_lights import CalibratedCamera
from services.core.errors import CaptureInputError
from services.core.geometry import Record
from services.core.raw.frames import Counts, Frame, read_counts, read_frame
from services.core.raw.fullness import Fullness, Part
from services.core.raw.merge import Exposure, merge
from services.core.raw.mosaic import sites
from services.core.raw.noise import LitPair, NoiseModel, read_noise, shot_noise
from services.core.raw.records import DARK, RawFolder, RawFrame
from services.core.store import write_atomic
from services.preprocess.raw.checks import require_like_exposures
from services.preprocess.raw.demosaic import demosaic
from services.preprocess.raw.ends import end_notes, ends_of
from services.preprocess.raw.lens import Lens, fitted_vignetting
from services.preprocess.raw.response import NEAR_FULL, Linearity, Series, measure_linearity
from services.preprocess.views.scratch import cached_array
from services.preprocess.views.window import Window

Image = NDArray[np.float32]
MEASURES = "measures.json"
"""Name of the file in a camera's scratch folder that holds its ``Measures``."""
FRAMES_MEASURED = 8
"""Largest number of black frames, and of pairs of lit frames, that are measured: more would add little."""
BRIGHT_BLACK = 0.25
"""Largest median of a black frame, as a fraction of full scale."""
PIXELS_MEASURED = 1_000_000
"""Largest number of a frame's pixels from which noise is measured; this number determines a variance to 0.14 %."""


class Measures(Record):
    """Measurements from a camera's frames, stored so that no other block of the same preparation repeats them.

    Attributes:
        read_counts, counts_per_electron, relative: parameters of the ``NoiseModel``.
        curve: a, b of the ``Linearity``.
        vignetting: a, b, c of the ``Lens``.
        full: gain, and the counts at which the pixels of its frames end, for each gain at which they do.
        notes: sentences about what was measured or assumed.
    """

    read_counts: float
    counts_per_electron: float
    relative: float
    curve: tuple[float, float]
    vignetting: tuple[float, float, float]
    full: tuple[tuple[float, tuple[float, ...]], ...] = ()
    notes: tuple[str, ...]


class CameraFrames:
    """One camera of a raw folder.

    Attributes:
        noise: noise model. lens: distortion and vignetting. linearity: linearity of the counts.
        notes: one sentence for each measured or assumed quantity.
    """

    def __init__(
        self,
        root: Path,
        folder: RawFolder,
        camera: CalibratedCamera,
        assumed_noise: tuple[float, float],
        scratch: Path | None = None,
    ) -> None:
        """Measure noise, linearity and vignetting from the frames, or read earlier measurements.

        Args:
            root: the raw folder.
            folder: its description.
            camera: the camera as calibrated.
            assumed_noise: standard deviations as fractions of the value and of full scale, used where neither frames
                nor calibration determine the noise.
            scratch: folder in which measurements are stored and looked for; None to measure each time.

        Raises:
            CaptureInputError: a frame cannot be read, no black level is known, or frames contradict each other; the
                message names the frame.
        """
        self._root, self._folder, self.calibrated, self._scratch = root, folder, camera, scratch
        self.raw = folder.camera_named(camera.name)
        self.notes: list[str] = []
        self._blacks: dict[tuple[float, float], Image] = {}
        self._fullness: dict[str, Fullness] = {}
        self._ends: dict[float, tuple[float, ...]] = {}
        self._ambient: Image | None = None
        self._full = np.float32(np.inf if self.raw.full_counts is None else self.raw.full_counts)
        self._black_frames = folder.frames_of(camera.name, "black")
        self.linearity = Linearity(np.empty(0), (0.0, 0.0), float(self._full))
        stored = None if scratch is None else scratch / MEASURES
        if stored is not None and stored.is_file():
            self._restore(Measures.model_validate_json(stored.read_bytes()))
        else:
            self._measure(assumed_noise)
            if stored is not None:
                write_atomic(stored, self._measures().model_dump_json().encode())
        self._ambient = self._measured_ambient()

    def _measure(self, assumed_noise: tuple[float, float]) -> None:
        if not self._black_frames:
            self._require_black_of_calibration()
        self._ends = ends_of(self._root, self._folder, self.raw)
        self.notes += end_notes(self._folder, self.raw, self._ends)
        self.noise = self._measured_noise(*assumed_noise)
        self.linearity = self._measured_linearity()
        self.lens = self._measured_lens()

    def _measures(self) -> Measures:
        noise = self.noise
        return Measures(
            read_counts=noise.read_counts,
            counts_per_electron=noise.counts_per_electron,
            relative=noise.relative,
            curve=self.linearity.curve,
            vignetting=self.lens.vignetting,
            full=tuple(self._ends.items()),
            notes=tuple(self.notes),
        )

    def _restore(self, measures: Measures) -> None:
        self._ends = dict(measures.full)
        self.noise = NoiseModel(measures.read_counts, measures.counts_per_electron, measures.relative)
        # Leave the deviations of single blocks empty, because only the notes report them.
        self.linearity = Linearity(np.empty(0), measures.curve, float(self._full))
        self.lens = Lens(self.calibrated, measures.vignetting)
        self.notes += measures.notes

    def exposure(self, frame: RawFrame) -> Exposure:
        """Linear counts of a whole frame above black and ambient light; (H, W) of a mosaic, else (H, W, C).

        Raises:
            CaptureInputError: the frame cannot be read; the message names it.
        """
        return self.exposure_of(frame, self._read(frame).counts, (slice(None), slice(None)))

    def counts(self, frame: RawFrame, region: Window) -> Counts:
        """Raw counts of a part of a frame, copied so that the whole frame is not kept in memory.

        Raises:
            CaptureInputError: the frame cannot be read; the message names it.
        """
        return self._read(frame).counts[region.rows, region.columns].copy()

    def _read(self, frame: RawFrame) -> Frame:
        found = read_frame(self._root, self._folder, frame)
        own = found.fullness
        ends = self._ends.get(frame.gain) if frame.kind not in DARK else None
        self._fullness[frame.file] = own if ends is None else own.limited(ends)
        return found

    def exposure_of(self, frame: RawFrame, counts: Counts, part: Part) -> Exposure:
        """Convert a part of a frame's counts to an exposure.

        Args:
            frame: description of the frame, whose counts this object has read.
            counts: raw counts of the part.
            part: rows and columns of the part in the frame.
        """
        black, variance = self._black(frame)
        above = np.subtract(counts, black[part] if black.ndim > 1 else black, dtype=np.float32)
        signal = self.linearity.linearised(above)
        seconds = frame.exposure_s * frame.gain
        if self._ambient is not None and frame.kind not in DARK:
            signal = signal - self._ambient[part] * np.float32(seconds)
        headroom = np.subtract(self._fullness[frame.file].at(part), counts, dtype=np.float32)
        return Exposure(signal, variance, headroom, seconds * frame.level, frame.gain)

    def _black(self, frame: RawFrame) -> tuple[Image, float]:
        """Mean of the black frames nearest in gain and exposure, or the calibration's black level; and its variance.

        Both are in counts. The calibration's level is one number for all pixels, with variance 0.
        """
        if not self._black_frames:
            assert self.calibrated.black_counts is not None
            return np.array(self.calibrated.black_counts, dtype=np.float32), 0.0

        def distance(black: RawFrame) -> tuple[float, float]:
            return abs(np.log(black.gain / frame.gain)), abs(np.log(black.exposure_s / frame.exposure_s))

        nearest = min(self._black_frames, key=distance)
        key = nearest.gain, nearest.exposure_s
        own = [one for one in self._black_frames if (one.gain, one.exposure_s) == key]
        if key not in self._blacks:
            self._blacks[key] = self._mean_of_black(own)
        zero = np.zeros((), dtype=np.float32)
        return self._blacks[key], float(self.noise.variance(zero, nearest.gain)) / len(own)

    def _mean_of_black(self, frames: Sequence[RawFrame]) -> Image:
        """Mean counts of black frames of one gain and exposure; computed once for all blocks that share a folder."""
        name = f"black-{frames[0].gain!r}-{frames[0].exposure_s!r}.npy"

        def mean() -> Image:
            counts = np.zeros_like(self._black_counts(frames[0]))
            for frame in frames:
                counts += self._black_counts(frame) / np.float32(len(frames))
            return counts

        return cached_array(None if self._scratch is None else self._scratch / name, mean)

    def _black_counts(self, frame: RawFrame) -> Image:
        counts = read_counts(self._root, self._folder, frame).astype(np.float32)
        if (median := float(np.median(counts))) > BRIGHT_BLACK * self._full:
            raise CaptureInputError(
                f"Frame {self._root / frame.file} ({frame.label}) has a median of {median:g} counts, so it is no black"
                " frame; take it with the lens covered, or correct its kind."
            )
        return counts

    def _require_black_of_calibration(self) -> None:
        name = self.raw.name
        if self.calibrated.black_counts is None:
            lit = next((one for one in self._folder.frame if one.camera == name), self._folder.frame[0])
            raise CaptureInputError(
                f"Camera {name} has no black frame, so the zero of {lit.file} and its other frames is unknown; add one"
                ' with the lens covered (kind = "black"), or give black_counts in the calibration.'
            )
        black = f"{self.calibrated.black_counts:g}"
        self.notes.append(
            f"Camera {name} has no black frame; black is taken as the calibration's {black} counts everywhere."
        )

    def _measured_noise(self, relative: float, floor: float) -> NoiseModel:
        """Noise model measured from the camera's own frames, else taken from the calibration, else assumed and
        noted.
        """
        name, calibrated = self.raw.name, self.calibrated
        # Set a noise model of zero, because exposures ask for the black level's noise while noise is being measured.
        self.noise = NoiseModel(0.0, 0.0)
        read = self._read_noise()
        measured = shot_noise(self._lit_pairs(), read)
        if measured is not None:
            slope, read = measured
            self.notes.append(
                f"Camera {name}: measured of its own frames are a read noise of {read:.3g} counts and {slope:.3g}"
                " counts per electron."
            )
            return NoiseModel(read, slope)
        read = calibrated.read_noise_counts if read is None else read
        if read is not None and calibrated.counts_per_electron is not None:
            return NoiseModel(read, calibrated.counts_per_electron)
        scale = float(self._full) if np.isfinite(self._full) else 1.0
        self.notes.append(
            f"Camera {name}: no two frames of one thing and no calibration tell its noise; {relative:.1%} of the signal"
            f" and {floor:.2%} of full scale are assumed. Two flat frames of one exposure, and two black ones, would"
            " tell it."
        )
        return NoiseModel(floor * scale if read is None else read, 0.0, relative)

    def _read_noise(self) -> float | None:
        found = []
        for own in _repeated_exposures(self._black_frames):
            if len(own) > 1:
                counts = [self._black_counts(one) for one in own[:FRAMES_MEASURED]]
                found.append((len(counts) - 1, read_noise(counts, own[0].gain)))
        known = [(weight, value) for weight, value in found if value is not None]
        return float(np.sqrt(np.average([v**2 for _, v in known], weights=[w for w, _ in known]))) if known else None

    def _lit_pairs(self) -> Iterator[LitPair]:
        """Yield pairs of frames of one scene with the same exposure: of flat frames if possible, else of light frames.

        The pixels are thinned out to about ``PIXELS_MEASURED``.
        """
        flats = self._folder.frames_of(self.raw.name, "flat")
        groups = [own for own in _repeated_exposures(flats) if len(own) > 1]
        if not groups:
            lit = self._folder.frames_of(self.raw.name, "light")
            groups = [own for own in _repeated_exposures(lit) if len(own) > 1]
        for first, second in [pair for own in groups for pair in pairwise(own)][:FRAMES_MEASURED]:
            step = -(-int(np.prod(self.raw.size)) // PIXELS_MEASURED)
            a, b = (_unsaturated(self.exposure(one)).reshape(-1)[::step] for one in (first, second))
            yield LitPair(a, b, first.gain)

    def _measured_linearity(self) -> Linearity:
        """Linearity measured from flat frames in several exposures, else from light frames in several exposures."""
        name = self.raw.name
        is_known = np.isfinite(self._full)
        found = measure_linearity(list(self._series()), float(self._full)) if is_known else self.linearity
        if found.ratios.size:
            low, middle, high = np.percentile(found.ratios, (5, 50, 95))
            self.notes.append(
                f"Camera {name}: longer exposures are {middle:.3f} times as bright as their times say (5 to 95 %:"
                f" {low:.3f} to {high:.3f}); {found.verdict()}."
            )
        return found

    def _series(self) -> Iterator[Series]:
        flats = self._folder.frames_of(self.raw.name, "flat")
        brackets = [own for own in _exposure_brackets(flats) if len(own) > 1]
        if not brackets:
            brackets = [
                own for own in _exposure_brackets(self._folder.frames_of(self.raw.name, "light")) if len(own) > 1
            ]
        empty: list[RawFrame] = []
        for pair in _even_choice([pair for own in brackets for pair in pairwise(own)], FRAMES_MEASURED):
            shorter, longer = (self.exposure(frame) for frame in pair)
            empty += require_like_exposures(self._root, pair, (shorter, longer), self._folder.channels)
            step = shorter.factor, longer.factor
            yield Series(self._by_colour(shorter), self._by_colour(longer), longer.factor / shorter.factor, step)
        if empty:
            names = ", ".join(dict.fromkeys(one.file for one in empty))
            self.notes.append(
                f"Camera {self.raw.name}: {names} are empty: they count nothing above their black, because their"
                " exposure is too short for this light."
            )

    def _by_colour(self, exposure: Exposure) -> Image:
        """Counts above black with the four pixels of a mosaic's pattern as channels; NaN where nearly saturated."""
        near_full = exposure.headroom < (1 - NEAR_FULL) * self._full
        signal = np.where(near_full, np.nan, exposure.signal).astype(np.float32)
        if self.raw.mosaic == "none":
            return signal
        height, width = (length // 2 * 2 for length in signal.shape)
        return np.stack([view for _, view in sites(signal[:height, :width], self.raw.mosaic)], axis=-1)

    def _measured_lens(self) -> Lens:
        flats = self._folder.frames_of(self.raw.name, "flat")
        vignetting = self.calibrated.vignetting
        if vignetting is None and flats:
            rate, _, lost = merge([self.exposure(frame) for frame in flats], self.noise)
            if lost.any():
                raise CaptureInputError(
                    f"Frame {self._root / flats[0].file} ({flats[0].label}) and all other flat ones are full at"
                    f" {int(lost.sum())} pixels; take one with a shorter exposure."
                )
            colours = np.atleast_3d(rate) if self.raw.mosaic == "none" else demosaic(rate, self.raw.mosaic)
            vignetting = fitted_vignetting(self.calibrated, colours)
            coefficients = ", ".join(f"{value:.3g}" for value in vignetting)
            self.notes.append(
                f"Camera {self.raw.name}: the fall of light is fitted to its flat frames ({coefficients})."
            )
        return Lens(self.calibrated, vignetting or (0.0, 0.0, 0.0))

    def _measured_ambient(self) -> Image | None:
        """Ambient light of the room, counts per second at gain 1; None without dark-room frames."""
        frames = self._folder.frames_of(self.raw.name, "dark-room")
        if not frames:
            return None
        total = np.zeros_like(self.exposure(frames[0]).signal)
        for frame in frames:
            total += self.exposure(frame).signal / np.float32(frame.exposure_s * frame.gain * len(frames))
        return total


def _unsaturated(exposure: Exposure) -> Image:
    """Counts above black, NaN where saturated."""
    return np.where(exposure.headroom > 0, exposure.signal, np.nan).astype(np.float32)


def _repeated_exposures(frames: Iterable[RawFrame]) -> list[list[RawFrame]]:
    """Group frames of one scene under one light with the same exposure, gain and level."""
    groups: dict[object, list[RawFrame]] = defaultdict(list)
    for frame in frames:
        groups[_scene(frame), frame.exposure_s, frame.gain, frame.level].append(frame)
    return list(groups.values())


def _exposure_brackets(frames: Iterable[RawFrame]) -> list[list[RawFrame]]:
    """Group frames of one scene under one light, one frame for each exposure, from the shortest to the longest."""
    groups: dict[object, dict[float, RawFrame]] = defaultdict(dict)
    for frame in frames:
        groups[_scene(frame)].setdefault(frame.exposure_s * frame.gain * frame.level, frame)
    return [[own[key] for key in sorted(own)] for own in groups.values()]


def _even_choice(pairs: Sequence[tuple[RawFrame, RawFrame]], count: int) -> list[tuple[RawFrame, RawFrame]]:
    """About ``count`` pairs of exposures, evenly of all steps of exposures, and within a step of all lights, because
    some lights are brighter than others.
    """
    steps: dict[tuple[float, ...], list[tuple[RawFrame, RawFrame]]] = defaultdict(list)
    for pair in pairs:
        steps[tuple(frame.exposure_s * frame.gain * frame.level for frame in pair)].append(pair)
    each = max(1, -(-count // len(steps))) if steps else 1
    return [own[k * len(own) // min(each, len(own))] for own in steps.values() for k in range(min(each, len(own)))]


def _scene(frame: RawFrame) -> tuple[str | None, ...]:
    return frame.light, frame.place, frame.session
