"""A captured rig: counts become radiance, and every frame is brought to where the teeth were at first."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.calibration import require_consistent
from services.core.errors import CaptureInputError
from services.core.records import CaptureManifest, FrameRecord, MaskBit
from services.core.store import StoredArray
from services.preprocess.motion import ViewMotion, jaws
from services.preprocess.projection import Footprint
from services.preprocess.radiometry import Merge, Radiometry
from services.preprocess.source import Image, LightImage
from services.preprocess.stabilise import warp

# Below this, resampling would blur more than it aligns
STILL_PX = 0.1
# A frame whose interpolated motion is less certain than this is not used
UNCERTAIN_PX = 0.5
# A sample that takes less than this share from inside the image is dimmed by the black around it
WHOLLY_SEEN = 1 - 1e-3
BLACK_FRAMES = 8
# A cubic in time has four coefficients
MIN_TRACKING = 4

Counts = Callable[[FrameRecord], NDArray[np.uint16]]


class RigSource:
    """Reads a published capture."""

    held_out: tuple[tuple[str, str], ...] = ()
    measures_motion = True

    def __init__(self, root: Path, manifest: CaptureManifest) -> None:
        """Check the frame table.

        Raises:
            CaptureInputError: no black frame, or a light without a frame.
        """
        self.root, self._manifest, self.description = root, manifest, manifest.description
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
        if tracking < MIN_TRACKING:
            note = f"Capture has {tracking} tracking frames, and {MIN_TRACKING} are needed to follow a smooth motion to 0.2 px; lower rig.tracking_every."
            self.notes = (note,)

    def lights_of(self, camera: int) -> tuple[int, ...]:  # noqa: ARG002
        """See ``Source``; every camera sees every light."""
        return tuple(range(len(self._frames)))

    def images(self, camera: int, footprint: Footprint) -> Iterator[tuple[int, LightImage]]:
        """See ``Source``: one frame at a time, its radiance and its variance."""
        width, height = self.description.cameras[camera].size
        array = StoredArray(self.root / "capture.zarr")

        def counts(frame: FrameRecord) -> NDArray[np.uint16]:
            return array[camera, frame.index, :height, :width]

        black = np.zeros((height, width, len(self.description.channels)), dtype=np.float32)
        for frame in self._black:
            black += counts(frame) / np.float32(len(self._black))
        radiometry = Radiometry(black, len(self._black), self._manifest)
        # Without the black image, whose noise would be the same in every frame and speak for no motion at all
        level = np.float32(np.median(black))

        def brightness(frame: FrameRecord) -> Image:
            return np.asarray(counts(frame).mean(axis=-1, dtype=np.float32) - level, dtype=np.float32)

        view = self.description.cameras[camera].name
        motion = ViewMotion(footprint, jaws(sorted(self._manifest.fdi)), self._manifest.frames, brightness, view)
        for light, frames in enumerate(self._frames):
            yield light, _image(frames, radiometry, motion, counts)


def _image(frames: list[FrameRecord], radiometry: Radiometry, motion: ViewMotion, counts: Counts) -> LightImage:
    merged = Merge(radiometry.black.shape)
    moves = [motion.at(frame) for frame in frames]
    warped, beyond = False, np.zeros(radiometry.black.shape[:2], dtype=bool)
    for frame, move in zip(frames, moves, strict=True):
        radiance, variance, saturated = radiometry.radiance(counts(frame), frame)
        if move.median_px > STILL_PX:
            # Neighbours share noise after interpolation; the variance kept unreduced makes sums over pixels right
            field = motion.field(move)
            of_saturated, of_image = np.moveaxis(
                warp(np.stack([saturated, np.ones_like(saturated)], axis=-1), field), -1, 0
            )
            radiance, variance, saturated = warp(radiance, field), warp(variance, field), of_saturated > 0
            beyond |= of_image < WHOLLY_SEEN
            warped = True
        merged.add(radiance, variance, saturated)
    radiance, variance, lost = merged.result()
    bits = (np.where(lost & ~beyond, MaskBit.SATURATED, 0) | np.where(beyond, MaskBit.MOTION, 0)).astype(np.uint16)
    if max(move.error_px for move in moves) > UNCERTAIN_PX:
        bits |= np.uint16(MaskBit.MOTION)
    farthest = max(moves, key=lambda move: move.median_px)
    return LightImage(radiance, variance, bits, motion.stored(farthest), farthest.median_px, warped)
