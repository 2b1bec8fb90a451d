"""Interface through which the preparation reads any capture: one image per camera and light."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Camera
from services.core.records import FolderCapture
from services.preprocess.views.colours import FrameColour
from services.preprocess.views.flow_comparison import FlowComparison
from services.preprocess.views.projection import Footprint
from services.preprocess.views.window import Window

Image = NDArray[np.float32]
Bits = NDArray[np.uint16]
MotionSource = Literal["tracking", "outline", "stated still"]
"""What an image's motion is known from: tracking frames, the outline of the teeth, or the statement that the subject
did not move."""


@dataclass(frozen=True)
class MatchedFrame:
    """What was measured of the motion of one frame.

    Attributes:
        coefficients: (bodies, TERMS, 2) of the frame's displacement, as ``stabilise`` defines them. By an outline, a
            translation from where the scan is.
        error_px: (bodies,) standard error of an outline's translation; empty for tracking frames.
        arcs_px: (bodies, 2, 2) the same translation by odd and by even arcs of the outline; empty for tracking frames.
    """

    coefficients: NDArray[np.float64]
    error_px: tuple[float, ...] = ()
    arcs_px: tuple[tuple[tuple[float, float], tuple[float, float]], ...] = ()


Motions = Mapping[int, MatchedFrame]
"""Frame number -> what was measured of its motion."""
FootprintIn = Callable[[Camera], Footprint]
"""Gives the surfaces of the subject that a camera sees."""


@dataclass(frozen=True)
class View:
    """The part of one camera's images that is prepared: the window (H, W) that shows the subject.

    Attributes:
        number: index of the camera in the capture.
        whole: the camera with its whole image.
        window: rows and columns of the whole image.
        camera: the same camera cropped to the window.
        footprint: surfaces of the subject that the cropped camera sees.
        scratch: folder for arrays that the camera's images share; None to store none.
    """

    number: int
    whole: Camera
    window: Window
    camera: Camera
    footprint: Footprint
    scratch: Path | None = None

    def scratch_file(self, name: str) -> Path | None:
        """Path of an array that the camera's images share; None if the view has no scratch folder."""
        return None if self.scratch is None else self.scratch / f"{name}.npy"


@dataclass(frozen=True)
class LightImage:
    """One camera's image under one light; arrays hold the view's window.

    Attributes:
        radiance, variance: (H, W, C); a value that is not finite is replaced by 0 and flagged.
        bits: (H, W), mask bits that the source sets: saturated, moved, not finite.
        displacement: (h, w, 2), pixels, at every ``stored_step``-th pixel of the whole image; None where motion is not
            measured.
        motion_px: median displacement over the teeth; None where motion is not measured.
        motion_error_px: standard error of either component of the motion at the teeth; 0 where the subject is stated
            not to move.
        motion_source: what the motion is known from.
        warped: whether the pixels were resampled.
        colour: ratio of red to blue, to check the order of channels; None where the source does not measure it.
    """

    radiance: Image
    variance: Image
    bits: Bits
    displacement: Image | None = None
    motion_px: float | None = None
    warped: bool = False
    colour: FrameColour | None = None
    motion_error_px: float = 0.0
    motion_source: MotionSource = "stated still"


class Source(Protocol):
    """A capture that can be prepared."""

    @property
    def root(self) -> Path:
        """Folder that holds ``teeth/``."""

    @property
    def description(self) -> FolderCapture:
        """Cameras, lights and channels of the capture."""

    @property
    def held_out(self) -> tuple[tuple[str, str], ...]:
        """(camera, light) pairs that the capture itself marks as held out from the fit."""

    @property
    def measures_motion(self) -> bool:
        """Whether images carry a displacement."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences the operator should read before trusting the result."""

    def lights_of(self, camera: int) -> tuple[int, ...]:
        """Indices of the lights under which this camera has an image."""

    def identity(self) -> str:
        """A text that changes whenever a file from which the images are made changes."""

    def matched_frames(self, camera: int) -> tuple[int, ...]:
        """Numbers of the camera's frames whose motion must be measured; empty where nothing is to be measured."""

    def match(self, view: View, frames: Sequence[int], footprint_in: FootprintIn) -> Iterator[tuple[int, MatchedFrame]]:
        """Yield each frame's number and what was measured of its motion.

        Args:
            frames: some of ``matched_frames``.
            footprint_in: gives the surfaces that a camera sees, for outlines.

        Raises:
            CaptureInputError: the subject moved too far to be aligned; the message names the frame and the camera.
        """

    def flow_comparison(self, view: View, motions: Motions) -> FlowComparison | None:
        """Optical flow before and after stabilisation; None where no two frames share their light."""

    def images(self, view: View, lights: Sequence[int], motions: Motions) -> Iterator[tuple[int, LightImage]]:
        """Yield each light's index and image.

        Args:
            motions: what was measured of all frames that ``matched_frames`` returns.

        Raises:
            CaptureInputError: an image cannot be read; the message names the file or frame, camera and light.
        """
