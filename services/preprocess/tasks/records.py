"""Records of finished work that the blocks of a preparation write, so that no work is done twice."""

from __future__ import annotations

from pydantic import Field

from services.core.files.object_store import StoredObject
from services.core.geometry import Record
from services.preprocess.brightness import ImageLight
from services.preprocess.colours import FrameColour
from services.preprocess.quality import CameraFlow, ImageQuality
from services.preprocess.window import Window


class ViewDone(Record):
    """Record that one camera's window was found; its footprint lies beside this file."""

    window: tuple[int, int, int, int] = Field(description="top, bottom, left, right in pixels of the whole image")

    def of(self) -> Window:
        """Return the window."""
        return Window(*self.window)


class FrameMotion(Record):
    """Record of one frame's measured motion."""

    coefficients: tuple[tuple[tuple[float, float], ...], ...] = Field(
        description="(bodies, terms, 2) of the displacement in pixels since the first frame"
    )


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
