"""A published rig capture as a source: counts become radiance, and every frame is aligned with the first one."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.calibration.record import require_consistent
from services.core.errors import CaptureInputError
from services.core.records import MaskBit, Motion
from services.core.results import CaptureManifest, FrameRecord
from services.core.store import MANIFEST, StoredArray
from services.preprocess.captures.radiometry import Merge, Radiometry
from services.preprocess.stabilisation.motion import (
    Displacement,
    Scene,
    ViewMotion,
    frames_to_match,
    is_uncertain,
    jaws,
    largest_error_px,
)
from services.preprocess.views.flow_comparison import FlowComparison
from services.preprocess.views.scratch import cached_array
from services.preprocess.views.source import FootprintIn, Image, LightImage, MatchedFrame, Motions, View
from services.preprocess.views.window import BORDER_TOLERANCE_PX, Window, bands

# Largest median displacement, pixels, that is left in a frame, because resampling would blur more than it aligns
STILL_PX = 0.1
# Largest number of black frames that are averaged
BLACK_FRAMES = 8
# Smallest number of tracking frames: a cubic in time has four coefficients
MIN_TRACKING = 4

Counts = Callable[[FrameRecord], NDArray[np.uint16]]


class RigSource:
    """Reader of a published rig capture."""

    held_out: tuple[tuple[str, str], ...] = ()
    measures_motion = True

    def __init__(self, root: Path, manifest: CaptureManifest, motion: Motion = "auto") -> None:
        """Check the frame table.

        Raises:
            CaptureInputError: there is no black frame, or a light has no frame.
        """
        self.root, self._manifest, self.description = root, manifest, manifest.description
        self._how: Motion = motion
        require_consistent(self.description, f"Capture {root}")
        self._black = [frame for frame in manifest.frames if frame.kind == "black"][:BLACK_FRAMES]
        if not self._black:
            raise CaptureInputError(
                f"Capture {root} has no black frame, so its zero is unknown; capture it again with at least one."
            )
        self._frames: list[list[FrameRecord]] = []
        for light in self.description.lights:
            own = [
                frame
                for frame in manifest.frames
                if frame.kind == "light" and frame.light == light.name and frame.level > 0
            ]
            if not own:
                raise CaptureInputError(
                    f"Capture {root} has no lit frame of light {light.name}; capture that light again."
                )
            self._frames.append(own)
        tracking = sum(frame.kind == "tracking" for frame in manifest.frames)
        self.notes: tuple[str, ...] = ()
        if tracking < MIN_TRACKING and motion != "off":
            note = (
                f"Capture has {tracking} tracking frames, and {MIN_TRACKING} are needed to follow a smooth motion to"
                " 0.2 px; lower rig.tracking_every."
            )
            self.notes = (note,)

    def lights_of(self, camera: int) -> tuple[int, ...]:  # noqa: ARG002
        """See ``Source``; every camera sees every light."""
        return tuple(range(len(self._frames)))

    def identity(self) -> str:
        """See ``Source``. It includes the capture's manifest, which holds a checksum of every file."""
        return self.description.model_dump_json() + (self.root / MANIFEST).read_text()

    def matched_frames(self, camera: int) -> tuple[int, ...]:  # noqa: ARG002
        """See ``Source``."""
        return tuple(frame.index for frame in frames_to_match(self._manifest.frames, self._how))

    def match(self, view: View, frames: Sequence[int], footprint_in: FootprintIn) -> Iterator[tuple[int, MatchedFrame]]:
        """See ``Source``."""
        motion = self._motion(view)
        array = StoredArray(self.root / "capture.zarr")
        # Subtract the median of the black image instead of the image itself, whose noise would be the same in every
        # frame and bias the match towards no motion
        level = cached_array(
            view.scratch_file("level"), lambda: np.asarray(np.median(self._black_image(view, array, motion.window)))
        )

        def picture(frame: FrameRecord) -> NDArray[np.uint16]:
            return array[view.number, frame.index, motion.window.rows, motion.window.columns]

        return motion.measure(frames, picture, Scene(self.description.lights, footprint_in), float(level))

    def flow_comparison(self, view: View, motions: Motions) -> FlowComparison | None:
        """See ``Source``."""
        motion = self._motion(view)
        array = StoredArray(self.root / "capture.zarr")

        def picture(frame: FrameRecord) -> NDArray[np.uint16]:
            return array[view.number, frame.index, motion.window.rows, motion.window.columns]

        return motion.flow_comparison(picture, motions)

    def images(self, view: View, lights: Sequence[int], motions: Motions) -> Iterator[tuple[int, LightImage]]:
        """See ``Source``. The frames of each light are read, aligned and merged, one light after the other."""
        motion = self._motion(view)
        array = StoredArray(self.root / "capture.zarr")
        black = self._black_image(view, array, motion.window)
        radiometry = Radiometry(black, len(self._black), self._manifest)

        def counts(frame: FrameRecord) -> NDArray[np.uint16]:
            return array[view.number, frame.index, motion.window.rows, motion.window.columns]

        for light in lights:
            frames = self._frames[light]
            moves = [motion.at(frame, motions) for frame in frames]
            yield light, _image(frames, moves, radiometry, motion, counts, view.window)

    def _motion(self, view: View) -> ViewMotion:
        return ViewMotion(view, jaws(sorted(self._manifest.fdi)), self._manifest.frames, self._how)

    def _black_image(self, view: View, array: StoredArray, window: Window) -> Image:
        """Mean (H, W, C) of the black frames, counts; computed once if the view has a scratch folder."""

        def mean() -> Image:
            black = np.zeros((*window.shape, len(self.description.channels)), dtype=np.float32)
            for frame in self._black:
                counts = array[view.number, frame.index, window.rows, window.columns]
                for rows in bands(window.shape):
                    black[rows] += counts[rows] / np.float32(len(self._black))
            return black

        return cached_array(view.scratch_file("black"), mean)


def _image(
    frames: Sequence[FrameRecord],
    moves: Sequence[Displacement],
    radiometry: Radiometry,
    motion: ViewMotion,
    counts: Counts,
    window: Window,
) -> LightImage:
    """Align one light's frames with the first frame of the capture and merge them, a few rows at a time."""
    read = [counts(frame) for frame in frames]
    height, width = window.shape
    channels = read[0].shape[-1]
    radiance, variance = (np.empty((height, width, channels), dtype=np.float32) for _ in range(2))
    bits = np.zeros((height, width), dtype=np.uint16)
    is_warped = [move.median_px > STILL_PX for move in moves]
    inner = window.within(motion.window)
    for rows in bands((height, width)):
        merged, beyond = Merge(), None
        for frame, move, counts_of_frame, warped in zip(frames, moves, read, is_warped, strict=True):
            if warped:
                one, outside = _resampled(counts_of_frame, motion.positions(move, rows), radiometry, frame)
                beyond = outside if beyond is None else beyond | outside
            else:
                own = slice(inner[0].start + rows.start, inner[0].start + rows.stop), inner[1]
                one = radiometry.at(*own).radiance(counts_of_frame[own], frame)
            merged.add(*one)
        radiance[rows], variance[rows], lost = merged.result()
        if beyond is not None:
            lost &= ~beyond
            bits[rows][beyond] = MaskBit.MOTION
        bits[rows][lost] |= np.uint16(MaskBit.SATURATED)
    if is_uncertain(moves):
        bits |= np.uint16(MaskBit.MOTION)
    farthest = max(moves, key=lambda move: move.median_px)
    return LightImage(
        radiance,
        variance,
        bits,
        motion.stored_field(farthest),
        farthest.median_px,
        any(is_warped),
        motion_error_px=largest_error_px(moves),
        motion_source=motion.source,
    )


def _resampled(
    counts: NDArray[np.uint16], positions: Image, radiometry: Radiometry, frame: FrameRecord
) -> tuple[tuple[Image, Image, NDArray[np.bool_]], NDArray[np.bool_]]:
    """Sample radiance, variance and saturation at the displaced pixels.

    Interpolation correlates the noise of neighbouring pixels. The variance is not reduced for it, so that sums over
    pixels have the right variance.

    Args:
        positions: x and y (2, H, W) of the displaced pixels as indices into ``counts``; overwritten.

    Returns:
        Radiance and variance (H, W, C), saturated pixels (H, W); and the samples (H, W) that lie beyond the frame.
    """
    import cv2

    height, width = counts.shape[:2]
    x, y = positions
    beyond = (
        (x < -BORDER_TOLERANCE_PX)
        | (x > width - 1 + BORDER_TOLERANCE_PX)
        | (y < -BORDER_TOLERANCE_PX)
        | (y > height - 1 + BORDER_TOLERANCE_PX)
    )
    # Convert only the part of the frame that is sampled
    rows, columns = _sampled_range(y, height), _sampled_range(x, width)
    y -= np.float32(rows.start)
    x -= np.float32(columns.start)
    radiance, variance, saturated = radiometry.at(rows, columns).radiance(counts[rows, columns], frame)

    def sampled(image: NDArray[Any]) -> Image:
        shape = (*x.shape, *image.shape[2:])
        return np.asarray(
            cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT), dtype=np.float32
        ).reshape(shape)

    lost = sampled(saturated.astype(np.float32)) > 0 if saturated.any() else np.zeros(x.shape, dtype=bool)
    return (sampled(radiance), sampled(variance), lost), beyond


def _sampled_range(positions: Image, size: int) -> slice:
    """Range of rows or columns of an image that holds all samples, and one more on each side."""
    first = int(np.clip(np.floor(positions.min()), 1, size) - 1)
    return slice(first, max(int(np.clip(np.ceil(positions.max()), 0, size - 2) + 2), first + 1))
