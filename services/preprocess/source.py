"""What the preparation reads: one image per camera and light, from a folder or from a captured rig."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Camera
from services.core.records import FolderCapture
from services.preprocess.colours import FrameColour
from services.preprocess.projection import Footprint
from services.preprocess.stabilisation.seen import SeenFlow
from services.preprocess.window import Window

Image = NDArray[np.float32]
Bits = NDArray[np.uint16]
Motions = Mapping[int, NDArray[np.float64]]
"""Frame number -> coefficients (bodies, TERMS, 2) of its displacement, as ``stabilise`` defines them."""


@dataclass(frozen=True)
class View:
    """What is prepared of one camera's images: the window that shows the subject, (H, W) in all that follows.

    Attributes:
        number: place of the camera in the capture.
        whole: the camera as it is.
        window: rows and columns of the whole image.
        camera: the camera whose whole image is the window.
        footprint: what it sees of the subject.
        scratch: folder in which what the camera's images share may be kept; None where nothing is kept.
    """

    number: int
    whole: Camera
    window: Window
    camera: Camera
    footprint: Footprint
    scratch: Path | None = None

    def kept(self, name: str) -> Path | None:
        """The file of an array that the camera's images share; None where nothing is kept."""
        return None if self.scratch is None else self.scratch / f"{name}.npy"


@dataclass(frozen=True)
class LightImage:
    """One camera's view under one light; arrays hold the view's window.

    Attributes:
        radiance, variance: (H, W, C); where a value is not finite it is 0 and flagged.
        bits: (H, W), what the source knows: saturated, moved, not finite.
        displacement: (h, w, 2), pixels, at every ``stored_step``-th pixel of the whole image; None where motion is not
            measured.
        motion_px: median over the teeth; None where motion is not measured.
        motion_error_px: by how much the motion may be wrong where the teeth are, as its interpolation in time tells;
            None where nothing tells.
        warped: whether the pixels were resampled.
        colour: of a frame whose order of channels may be wrong; None where nothing tells.
    """

    radiance: Image
    variance: Image
    bits: Bits
    displacement: Image | None = None
    motion_px: float | None = None
    warped: bool = False
    colour: FrameColour | None = None
    motion_error_px: float | None = None


class Source(Protocol):
    """A capture to prepare."""

    @property
    def root(self) -> Path:
        """Folder that holds ``teeth/``."""

    @property
    def description(self) -> FolderCapture:
        """Cameras, lights, channels."""

    @property
    def held_out(self) -> tuple[tuple[str, str], ...]:
        """(camera, light) pairs that the source itself keeps from the fit."""

    @property
    def measures_motion(self) -> bool:
        """Whether images carry a displacement."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences the operator should read before trusting the result."""

    def lights_of(self, camera: int) -> tuple[int, ...]:
        """Indices of the lights this camera has an image of."""

    def identity(self) -> str:
        """A text that changes whenever a file does that the images are made of."""

    def matched(self, camera: int) -> tuple[int, ...]:
        """Numbers of the frames whose motion is to be measured; none where motion is not measured."""

    def match(self, view: View, frames: Sequence[int]) -> Iterator[tuple[int, NDArray[np.float64]]]:
        """Frame number and coefficients (bodies, TERMS, 2) of its motion since the first frame, one at a time.

        Raises:
            CaptureInputError: moved too far to be aligned; names the frame and the camera.
        """

    def seen_flow(self, view: View, motions: Motions) -> SeenFlow | None:
        """What flow sees before and after the motion is taken out; None where no two frames share their light."""

    def images(self, view: View, lights: Sequence[int], motions: Motions) -> Iterator[tuple[int, LightImage]]:
        """Light index and image, one at a time.

        Args:
            motions: of all that ``matched`` names.

        Raises:
            CaptureInputError: names the file or frame, camera and light.
        """
