"""One camera's photographs as images of a pinhole in which the subject stays where it was at first."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.raw.merge import Exposure, merge
from services.core.raw.records import RawFrame
from services.core.records import MaskBit
from services.preprocess.raw.camera import CameraFrames
from services.preprocess.raw.checks import colour_of, require_like_exposures
from services.preprocess.raw.demosaic import demosaic, demosaic_variance, spoiled
from services.preprocess.raw.lens import Sampler
from services.preprocess.rig import STILL_PX, UNCERTAIN_PX
from services.preprocess.source import Image, LightImage, View
from services.preprocess.stabilisation.motion import Displacement, ViewMotion
from services.preprocess.window import bands

BoolArray = NDArray[np.bool_]


class RawView:
    """The photographs of one camera, brought to a view.

    Attributes:
        motion: of the subject in it.
    """

    def __init__(
        self, root: Path, frames: CameraFrames, view: View, motion: ViewMotion, channels: tuple[str, ...]
    ) -> None:
        self._root, self._frames, self._view, self.motion, self._channels = root, frames, view, motion, channels
        self._mosaic, camera = frames.raw.mosaic, frames.calibrated
        self._sampler = Sampler(frames.lens, motion.window)
        assert camera.radiance_per_count is not None
        self._scale = np.array(camera.radiance_per_count, dtype=np.float32)
        self._unmixed = (
            None if camera.crosstalk is None else np.linalg.inv(np.array(camera.crosstalk)).astype(np.float32)
        )

    def brightness(self, frame: RawFrame) -> Image:
        """Mean of the channels of one frame in ``motion.window`` (H, W), undistorted; its unit does not matter."""
        signal = self._frames.exposure(frame, self._sampler.region).signal
        colour = signal if self._mosaic == "none" else demosaic(signal, self._mosaic)
        grey = colour.mean(axis=-1, keepdims=True)
        height, width = self.motion.window.shape
        image = np.empty((height, width), dtype=np.float32)
        for rows in bands((height, width)):
            y, x = np.mgrid[rows, 0:width].astype(np.float32)
            image[rows] = self._sampler.sampled(grey, self._sampler.places(np.stack([x, y])))[..., 0]
        return image

    def image(self, frames: Sequence[RawFrame], moves: Sequence[Displacement]) -> LightImage:
        """The exposures of one light, merged before they are interpolated where the subject was still between them, and after otherwise.

        Raises:
            CaptureInputError: they contradict each other; names the frame.
        """
        exposures = [self._frames.exposure(frame, self._sampler.region) for frame in frames]
        require_like_exposures(self._root, frames, exposures, self._channels)
        height, width = self._view.window.shape
        radiance, variance = (np.empty((height, width, len(self._channels)), dtype=np.float32) for _ in range(2))
        bits = np.zeros((height, width), dtype=np.uint16)
        groups = self._groups(exposures, moves)
        merged = [(self._colours_of(group), move) for group, move in groups]
        is_warped = [move.median_px > STILL_PX or not self._sampler.is_still_exact for _, move in groups]
        for rows in bands((height, width * len(self._channels))):
            parts = [
                self._band(colours, move, rows, warped=warped)
                for (colours, move), warped in zip(merged, is_warped, strict=True)
            ]
            radiance[rows], variance[rows], lost, beyond = _joined(parts)
            bits[rows][lost & ~beyond] = np.uint16(MaskBit.SATURATED)
            bits[rows][beyond] |= np.uint16(MaskBit.MOTION)
        if max(move.error_px for move in moves) > UNCERTAIN_PX:
            bits |= np.uint16(MaskBit.MOTION)
        usable = (bits == 0) & self._view.footprint.covered
        colour = colour_of(frames[0], self._channels, radiance[usable])
        farthest = max(moves, key=lambda move: move.median_px)
        moved = self.motion.stored(farthest), farthest.median_px, any(is_warped)
        told = [error for move in moves if (error := move.told_error_px) is not None]
        return LightImage(radiance, variance, bits, *moved, colour, max(told, default=None))

    def _groups(
        self, exposures: Sequence[Exposure], moves: Sequence[Displacement]
    ) -> list[tuple[list[Exposure], Displacement]]:
        """Exposures that show the subject at one place, and its motion there."""
        height, width = self._view.window.shape
        middle = slice(height // 2, height // 2 + 1)
        covered = self._view.footprint.covered[middle]
        seen = covered if covered.any() else np.ones((1, width), dtype=bool)
        first = self.motion.places(moves[0], middle)
        apart = max(
            float(np.linalg.norm(self.motion.places(move, middle) - first, axis=0)[seen].mean()) for move in moves
        )
        if apart < STILL_PX:
            return [(list(exposures), moves[0])]
        return [([one], move) for one, move in zip(exposures, moves, strict=True)]

    def _colours_of(self, exposures: Sequence[Exposure]) -> Image:
        """Counts a second, their variances (C of each) and 1 where they are lost, of the region; all (H, W, 2 C + 1)."""
        rate, variance, lost = merge(exposures, self._frames.noise)
        if self._mosaic != "none":
            spoilt = spoiled(lost)
            rate, variance = demosaic(rate, self._mosaic), demosaic_variance(variance, self._mosaic)
        else:
            spoilt = np.asarray(lost.any(axis=-1))
        if self._unmixed is not None:
            rate, variance = rate @ self._unmixed.T, variance @ (self._unmixed.T**2)
        return np.concatenate([rate, variance, spoilt[..., None]], axis=-1, dtype=np.float32)

    def _band(
        self, colours: Image, move: Displacement, rows: slice, *, warped: bool
    ) -> tuple[Image, Image, BoolArray, BoolArray]:
        """Radiance, variance (H, W, C), and where it is lost or lies beyond the photograph (H, W), of some rows of the view.

        Neighbours share noise after interpolation; the variance kept unreduced makes sums over pixels right.
        """
        window, region, count = self._view.window, self._sampler.region, len(self._channels)
        if warped:
            within = self.motion.places(move, rows) if move.median_px > STILL_PX else self._unmoved(rows)
            places = self._sampler.places(within)
            found, beyond = self._sampler.sampled(colours, places), self._sampler.beyond(places)
        else:
            top, left = window.top - region.top, window.left - region.left
            found = colours[top + rows.start : top + rows.stop, left : left + window.shape[1]]
            y, x = np.mgrid[window.top + rows.start : window.top + rows.stop, window.left : window.right]
            places = np.stack([x, y]).astype(np.float32)
            beyond = np.zeros(found.shape[:2], dtype=bool)
        fall = self._frames.lens.fall(places[0], places[1])
        scale = self._scale if fall is None else self._scale / fall[..., None]
        return found[..., :count] * scale, found[..., count:-1] * scale**2, found[..., -1] > 0, beyond

    def _unmoved(self, rows: slice) -> Image:
        """Indices x, y (2, rows, W) of ``motion.window`` of some rows of the view."""
        inner = self._view.window.within(self.motion.window)
        y, x = np.mgrid[inner[0].start + rows.start : inner[0].start + rows.stop, inner[1]]
        return np.stack([x, y]).astype(np.float32)


def _joined(parts: Sequence[tuple[Image, Image, BoolArray, BoolArray]]) -> tuple[Image, Image, BoolArray, BoolArray]:
    """Aligned exposures joined by inverse variance; a pixel is lost where it is in all of them."""
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
