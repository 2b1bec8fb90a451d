"""Records of finished work that the blocks of a preparation write, so that no work is done twice."""

from __future__ import annotations

import math

import numpy as np
from pydantic import Field

from services.core.files.object_store import StoredObject
from services.core.geometry import Record
from services.preprocess.quality.brightness import ImageLight
from services.preprocess.quality.images import CameraFlow, ImageQuality
from services.preprocess.views.colours import FrameColour
from services.preprocess.views.source import MatchedFrame
from services.preprocess.views.window import Window


class ViewDone(Record):
    """Record that one camera's window was found; its footprint lies beside this file."""

    window: tuple[int, int, int, int] = Field(description="top, bottom, left, right in pixels of the whole image")

    def of(self) -> Window:
        """Return the window."""
        return Window(*self.window)


class FrameMotion(Record):
    """Record of one frame's measured motion."""

    coefficients: tuple[tuple[tuple[float, float], ...], ...] = Field(
        description="(bodies, terms, 2) of the displacement in pixels"
    )
    error_px: tuple[float | None, ...] = Field(
        default=(), description="standard error of an outline's translation, by body; null where nothing is known"
    )
    arcs_px: tuple[tuple[tuple[float, float], tuple[float, float]], ...] = Field(
        default=(), description="an outline's translation by its odd and its even arcs, by body"
    )

    @classmethod
    def of(cls, matched: MatchedFrame) -> FrameMotion:
        """Record what was measured."""
        errors_px = tuple(error if math.isfinite(error) else None for error in matched.error_px)
        return cls(coefficients=matched.coefficients.tolist(), error_px=errors_px, arcs_px=matched.arcs_px)

    def matched(self) -> MatchedFrame:
        """Return what was measured."""
        errors_px = tuple(math.inf if error is None else error for error in self.error_px)
        return MatchedFrame(np.asarray(self.coefficients), errors_px, self.arcs_px)


class FlowDone(Record):
    """Record that a camera's optical flow before and after stabilisation was computed."""

    flow: CameraFlow | None = Field(description="null where no two frames share their light")


class StoredFile(Record):
    """Size in bytes and checksum of a file of an image, as written."""

    bytes: int
    sha256: str


class ImageDone(Record):
    """Record of one image that was prepared and stored."""

    quality: ImageQuality
    tooth_pixels: tuple[int, ...] = Field(description="valid pixels that show each tooth")
    light: ImageLight | None
    colour: FrameColour | None = None
    files: dict[str, StoredFile] = Field(description="by path in the stage's folder")
    objects: dict[str, StoredObject] = Field(default={}, description="on a server, by path below the arrays' URL")
    notes: tuple[str, ...] = Field(default=(), description="what the source said of the camera when it read the image")
    seconds: float = Field(description="how long it took")
    shaded: bool = Field(
        default=False, description="whether shadows were looked for, which needs all of the camera's images"
    )
