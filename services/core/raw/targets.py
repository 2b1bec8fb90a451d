"""Things that the photographs of a raw folder show besides teeth (boards, spheres, charts), and the scan from which the
teeth come.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, model_validator

from services.core.geometry import Name, Record, Vector3
from services.core.records import FileName
from services.core.values import Number, Positive, Unit, Whole

Pixel = tuple[Number, Number]
"""Position in an image, x then y, pixels; the first pixel's centre is (0.5, 0.5)."""
Fdi = Annotated[Whole, Field(ge=11, le=85)]
"""Number of a tooth in the notation of the FDI."""


def _written_out(given: object) -> object:
    """A name that is given as a number, such as place = 1, as text; everything else unchanged."""
    return str(given) if isinstance(given, int | float) and not isinstance(given, bool) else given


Label = Annotated[str, Field(min_length=1, max_length=64), BeforeValidator(_written_out)]
"""Word of a description, such as a place; a number is one too."""
RawName = Annotated[Name, BeforeValidator(_written_out)]
"""Name of a thing in ``raw.toml``; a number is one too."""


class Board(Record):
    """A flat board of squares, whose points lie where OpenCV places them."""

    name: RawName
    type: Literal["charuco", "chessboard", "aruco"]
    squares: tuple[Annotated[Whole, Field(ge=1, le=200)], Annotated[Whole, Field(ge=1, le=200)]] = Field(
        description="columns, rows of squares, not of inner corners; of an aruco board, of markers"
    )
    square_mm: Positive = Field(description="edge of a square")
    marker_mm: Positive | None = Field(default=None, description="edge of a marker; null for a chessboard")
    dictionary: str | None = Field(
        default=None,
        pattern=r"^DICT_[A-Z0-9_]+$",
        description="of the markers, as OpenCV calls it, such as DICT_5X5_100",
    )
    legacy_pattern: bool = Field(
        default=False, description="whether a ChArUco board begins with a white square, as before OpenCV 4.6"
    )

    @model_validator(mode="after")
    def _markers_of_its_type(self) -> Board:
        has_markers = self.type != "chessboard"
        for key in ("marker_mm", "dictionary"):
            if has_markers and getattr(self, key) is None:
                raise ValueError(f"a board of type {self.type} needs {key}")
            if not has_markers and getattr(self, key) is not None:
                raise ValueError(f"a chessboard has no {key}; leave it out")
        if self.marker_mm is not None and self.marker_mm >= self.square_mm:
            raise ValueError(f"marker_mm = {self.marker_mm:g} must be smaller than square_mm = {self.square_mm:g}")
        return self


class Sphere(Record):
    """A sphere by which lights are measured: a mirror sphere for their positions, a white one for their intensities."""

    name: RawName
    kind: Literal["mirror", "white"]
    radius_mm: Positive
    reflectance: tuple[Unit, ...] | None = Field(
        default=None, description="of a white sphere: diffuse reflectance, one number a channel"
    )
    reflectance_se: Positive | None = Field(
        default=None,
        description="relative standard error of that, the same in all channels; 0.01 where it is not given",
    )

    @model_validator(mode="after")
    def _reflectance_of_white(self) -> Sphere:
        if (self.kind == "white") != (self.reflectance is not None):
            fault = "needs its reflectance, one number a channel" if self.kind == "white" else "has no reflectance here"
            raise ValueError(f"a {self.kind} sphere {fault}")
        return self


class Chart(Record):
    """A colour chart of 24 patches."""

    name: RawName
    type: Literal["colorchecker-24"]
    reference: FileName = Field(
        description=(
            ".csv of patches 1 to 24, row by row from the dark skin: X, Y, Z under D50 with Y = 100 for a perfect "
            "diffuser, or one column a wavelength"
        )
    )


class CalibrationFile(Record):
    """Where the calibration of the cameras and lights lies."""

    file: str = Field(
        min_length=1, description="calibration.json, relative to raw.toml; it may lie outside of the folder"
    )


class ScanFile(Record):
    """An intra-oral scan to take the teeth from; without labels, landmarks say where each tooth is."""

    file: FileName
    units: Literal["mm", "cm", "m", "um", "inch"]
    labels: str | None = Field(
        default=None,
        description=(
            "property of the scan's faces or vertices that holds the labels, or a file beside it; default: Label "
            "where the scan has it, else landmarks part the teeth, one at least on each"
        ),
    )
    jaw: Literal["upper", "lower", "both"]


class SeenPoint(Record):
    """Where one camera sees a landmark."""

    camera: RawName
    xy_px: Pixel


class Landmark(Record):
    """A point of a tooth that a person has marked in the scan and in photographs.

    A landmark without photographs serves to part the teeth of a scan without labels.
    """

    tooth: Fdi
    point: Label = Field(description="what it is, such as 'mesial edge'")
    xyz_mm: Vector3 = Field(description="in the scan")
    pixels: tuple[SeenPoint, ...] = ()
