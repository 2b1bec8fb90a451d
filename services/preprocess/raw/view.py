"""One camera's photographs resampled to images of an ideal pinhole camera, aligned with the first frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.raw.frames import Counts
from services.core.raw.merge import Exposure, merge
from services.core.raw.records import RawFrame
from services.core.records import MaskBit
from services.preprocess.captures.rig import STILL_PX
from services.preprocess.raw.camera import CameraFrames
from services.preprocess.raw.checks import colour_of, require_like_exposures
from services.preprocess.raw.demosaic import channel_means, demosaic, demosaic_variance, spoiled
from services.preprocess.raw.lens import MOSAIC_PERIOD, Sampler
from services.preprocess.raw.memory_budget import MemoryBudget, strips
from services.preprocess.stabilisation.motion import Displacement, ViewMotion, is_uncertain, largest_error_px
from services.preprocess.views.source import Image, LightImage, View
from services.preprocess.views.window import Window, bands_of

BoolArray = NDArray[np.bool_]
Values = tuple[Image, Image, BoolArray, BoolArray]
"""Radiance and variance (H, W, C), lost pixels (H, W), and pixels that lie beyond the photograph (H, W)."""

COMPARED_PIXELS = 1_000_000
"""Approximate number of a photograph's pixels with which exposures are compared. They determine a mean to a thousandth
of the pixels' contrast."""


@dataclass(frozen=True)
class Shot:
    """One photograph that was read.

    Attributes:
        frame: description of the frame.
        counts: raw counts of the sampler's region, (H, W) or (H, W, C).
        move: displacement of the subject since the first frame.
    """

    frame: RawFrame
    counts: Counts
    move: Displacement


class RawView:
    """Photographs of one camera, resampled to a view, a strip of rows at a time.

    Attributes:
        motion: motion of the subject in the view.
    """

    def __init__(
        self,
        root: Path,
        frames: CameraFrames,
        view: View,
        motion: ViewMotion,
        channels: tuple[str, ...],
        memory_bytes: float,
    ) -> None:
        """Prepare the sampling; no frame is read yet.

        Args:
            root: the raw folder.
            frames: measured properties of the camera.
            view: window and footprint.
            motion: motion of the subject.
            channels: names of the channels.
            memory_bytes: largest memory of this process; strips are as high as it allows.
        """
        self._root, self._frames, self._view, self.motion, self._channels = root, frames, view, motion, channels
        self._mosaic, camera = frames.raw.mosaic, frames.calibrated
        self._sampler = Sampler(frames.lens, motion.window)
        self._budget = MemoryBudget(memory_bytes, frames.raw, len(channels), view.window, self._sampler.region)
        assert camera.radiance_per_count is not None
        self._scale = np.array(camera.radiance_per_count, dtype=np.float32)
        self._unmixed = (
            None if camera.crosstalk is None else np.linalg.inv(np.array(camera.crosstalk)).astype(np.float32)
        )

    def brightness(self, frames: Sequence[RawFrame]) -> Image:
        """Undistorted mean over channels (H, W) of one frame, or of one light's exposures, in ``motion.window``.

        Its unit is arbitrary.
        """
        taken = [self._frames.counts(frame, self._sampler.region) for frame in frames]
        means = self._means([self._sparse(frame, counts) for frame, counts in zip(frames, taken, strict=True)])
        height, width = self.motion.window.shape
        image = np.empty((height, width), dtype=np.float32)
        for strip in strips(height, self._budget.rows(len(frames))):
            parts = list(bands_of(strip, width))
            positions = [self._sampler.positions(_indices(rows, slice(0, width))) for rows in parts]
            loaded = self._sampler.source_window(positions)
            signal = self._merged_signal([self._exposure(*one, loaded) for one in zip(frames, taken, strict=True)])
            colour = signal if self._mosaic == "none" else demosaic(signal, self._mosaic, means)
            grey = colour.mean(axis=-1, keepdims=True)
            for rows, at in zip(parts, positions, strict=True):
                image[rows] = self._sampler.sampled(grey, at, loaded)[..., 0]
        return image

    def _merged_signal(self, exposures: Sequence[Exposure]) -> Image:
        """Merge exposures above black; a pixel that is saturated in all of them keeps the shortest one's value.

        A single exposure is returned in counts, merged ones in counts per unit of the exposure factor.
        """
        if len(exposures) == 1:
            return exposures[0].signal
        rate, _, lost = merge(exposures, self._frames.noise)
        shortest = min(exposures, key=lambda one: one.factor)
        return np.where(lost, shortest.signal / np.float32(shortest.factor), rate)

    def image(self, frames: Sequence[RawFrame], moves: Sequence[Displacement]) -> LightImage:
        """Merge the exposures of one light into an image.

        They are merged before interpolation if the subject did not move between them, and afterwards otherwise.

        Raises:
            CaptureInputError: the exposures contradict each other; the message names the frame. SettingsError: there is
                too little memory.
        """
        strip_rows = self._budget.rows(len(frames))
        shots = [
            Shot(frame, self._frames.counts(frame, self._sampler.region), move)
            for frame, move in zip(frames, moves, strict=True)
        ]
        sparse = [self._sparse(shot.frame, shot.counts) for shot in shots]
        require_like_exposures(self._root, frames, sparse, self._channels)
        means = self._means(sparse)
        height, width = self._view.window.shape
        radiance, variance = (np.empty((height, width, len(self._channels)), dtype=np.float32) for _ in range(2))
        bits = np.zeros((height, width), dtype=np.uint16)
        groups = self._groups(shots)
        is_warped = [own[0].move.median_px > STILL_PX or not self._sampler.is_exact_at_rest for own in groups]
        for rows in strips(height, strip_rows):
            parts = [
                self._strip(own, rows, means, warped=warped) for own, warped in zip(groups, is_warped, strict=True)
            ]
            radiance[rows], variance[rows], lost, beyond = _joined(parts)
            bits[rows][lost & ~beyond] = np.uint16(MaskBit.SATURATED)
            bits[rows][beyond] |= np.uint16(MaskBit.MOTION)
        if is_uncertain(moves):
            bits |= np.uint16(MaskBit.MOTION)
        usable = (bits == 0) & self._view.footprint.covered
        colour = colour_of(frames[0], self._channels, radiance[usable])
        farthest = max(moves, key=lambda move: move.median_px)
        moved = self.motion.stored_field(farthest), farthest.median_px, any(is_warped)
        return LightImage(radiance, variance, bits, *moved, colour, largest_error_px(moves), self.motion.source)

    def _groups(self, shots: Sequence[Shot]) -> list[list[Shot]]:
        """Group exposures that show the subject at the same place: all of them, or each on its own."""
        height, width = self._view.window.shape
        middle = slice(height // 2, height // 2 + 1)
        covered = self._view.footprint.covered[middle]
        visible = covered if covered.any() else np.ones((1, width), dtype=bool)
        first = self.motion.positions(shots[0].move, middle)
        distance_px = max(
            float(np.linalg.norm(self.motion.positions(shot.move, middle) - first, axis=0)[visible].mean())
            for shot in shots
        )
        return [list(shots)] if distance_px < STILL_PX else [[shot] for shot in shots]

    def _sparse(self, frame: RawFrame, counts: Counts) -> Exposure:
        """Exposure of evenly spaced cells of the region, for statistics of the whole region."""
        region, cell = self._sampler.region, 1 if self._mosaic == "none" else MOSAIC_PERIOD
        step = cell * max(1, int(np.sqrt(counts.shape[0] * counts.shape[1] / COMPARED_PIXELS)))
        rows, columns = (
            (np.arange(0, length - cell + 1, step)[:, None] + np.arange(cell)).ravel() for length in counts.shape[:2]
        )
        cells = np.ix_(rows, columns)
        return self._frames.exposure_of(frame, counts[cells], np.ix_(rows + region.top, columns + region.left))

    def _means(self, sparse: Sequence[Exposure]) -> NDArray[np.float32] | None:
        """Mean brightness (3,) of a mosaic's channels; None for a camera without a mosaic."""
        rate, _, _ = merge(sparse, self._frames.noise)
        return None if self._mosaic == "none" else channel_means(rate, self._mosaic)

    def _exposure(self, frame: RawFrame, counts: Counts, loaded: Window) -> Exposure:
        """Exposure of the part ``loaded`` of the region."""
        return self._frames.exposure_of(
            frame, counts[loaded.within(self._sampler.region)], (loaded.rows, loaded.columns)
        )

    def _colours(self, shots: Sequence[Shot], loaded: Window, means: NDArray[np.float32] | None) -> Image:
        """Merge exposures in a part of the region; (H, W, 2 C + 1): C rates in counts per second, C variances, and 1
        where the pixel is lost.
        """
        exposures = [self._exposure(shot.frame, shot.counts, loaded) for shot in shots]
        rate, variance, lost = merge(exposures, self._frames.noise)
        del exposures
        if self._mosaic != "none":
            spoilt = spoiled(lost)
            rate, variance = demosaic(rate, self._mosaic, means), demosaic_variance(variance, self._mosaic)
        else:
            spoilt = np.asarray(lost.any(axis=-1))
        if self._unmixed is not None:
            rate, variance = rate @ self._unmixed.T, variance @ (self._unmixed.T**2)
        return np.concatenate([rate, variance, spoilt[..., None]], axis=-1, dtype=np.float32)

    def _strip(self, shots: Sequence[Shot], strip: slice, means: NDArray[np.float32] | None, *, warped: bool) -> Values:
        """Make some rows of the view from exposures that show the subject at the same place.

        Interpolation correlates the noise of neighbouring pixels. The variance is not reduced for it, so that sums over
        pixels have the right variance.
        """
        height, width, count = strip.stop - strip.start, self._view.window.shape[1], len(self._channels)
        parts = list(bands_of(strip, width))
        positions = [self._positions(shots[0].move, rows, warped=warped) for rows in parts]
        loaded = self._sampler.source_window(positions)
        colours = self._colours(shots, loaded, means)
        radiance, variance = (np.empty((height, width, count), dtype=np.float32) for _ in range(2))
        lost, beyond = (np.zeros((height, width), dtype=bool) for _ in range(2))
        for rows, at in zip(parts, positions, strict=True):
            own = slice(rows.start - strip.start, rows.stop - strip.start)
            if warped:
                found = self._sampler.sampled(colours, at, loaded)
                beyond[own] = self._sampler.beyond(at)
            else:
                top, left = self._view.window.top - loaded.top, self._view.window.left - loaded.left
                found = colours[top + rows.start : top + rows.stop, left : left + width]
            relative_brightness = self._frames.lens.relative_brightness(at[0], at[1])
            scale = self._scale if relative_brightness is None else self._scale / relative_brightness[..., None]
            np.multiply(found[..., :count], scale, out=radiance[own])
            np.multiply(found[..., count:-1], scale**2, out=variance[own])
            lost[own] = found[..., -1] > 0
        return radiance, variance, lost, beyond

    def _positions(self, move: Displacement, rows: slice, *, warped: bool) -> Image:
        """Positions in the photograph of some rows of the view: x, y (2, rows, W) as indices."""
        window = self._view.window
        if not warped:
            return _indices(slice(window.top + rows.start, window.top + rows.stop), window.columns)
        if move.median_px > STILL_PX:
            return self._sampler.positions(self.motion.positions(move, rows))
        inner = window.within(self.motion.window)
        return self._sampler.positions(
            _indices(slice(inner[0].start + rows.start, inner[0].start + rows.stop), inner[1])
        )


def _indices(rows: slice, columns: slice) -> Image:
    """Indices x and y (2, H, W) of all pixels in some rows and columns."""
    y, x = np.mgrid[rows, columns]
    return np.stack([x, y]).astype(np.float32)


def _joined(parts: Sequence[Values]) -> Values:
    """Merge aligned exposures by inverse variance; a pixel is lost if it is lost in all of them."""
    if len(parts) == 1:
        radiance, variance, lost, beyond = parts[0]
        return np.where(lost[..., None], 0, radiance), np.where(lost[..., None], 0, variance), lost, beyond
    weighted, weights = (np.zeros_like(parts[0][0]) for _ in range(2))
    beyond = np.zeros_like(parts[0][3])
    for radiance, variance, lost, outside in parts:
        unusable = (lost | outside)[..., None] | (variance <= 0)
        weight = np.where(unusable, 0, 1 / np.maximum(variance, 1e-30)).astype(np.float32)
        weighted += weight * radiance
        weights += weight
        beyond |= outside
    safe = np.maximum(weights, np.float32(1e-30))
    lost = (weights == 0).any(axis=-1)
    joined, spread = (weighted / safe).astype(np.float32), (1 / safe).astype(np.float32)
    return np.where(lost[..., None], 0, joined), np.where(lost[..., None], 0, spread), lost, beyond
