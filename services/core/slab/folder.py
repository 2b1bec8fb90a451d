"""A slab folder: ``slab.json`` beside linear images of a cell under narrow beams. Lengths mm, angles degrees in air."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from services.core.errors import CaptureInputError
from services.core.geometry import Name, Record
from services.core.slab.exposures import CameraCounts, SlabExposure, exposures_fault
from services.core.store import read_record

Positive = Annotated[float, Field(gt=0)]
Index = Annotated[float, Field(ge=1, le=4)]
Angle = Annotated[float, Field(gt=-90, lt=90)]
Side = Literal["front", "back"]
MAX_WIDTH = 20.0
"""Largest width of a cell in units of the grid's. Light that scatters spreads over about the cell's width, so a
narrower grid sees little of it; a width in micrometres is a thousand times too large."""


class Glass(Record):
    """Walls of the cell, the same at both faces."""

    index: Index
    thickness_mm: Positive


class Cell(Record):
    """The cell and what surrounds it."""

    width_mm: Positive = Field(description="way through the sample along the normal")
    index: Index | None = Field(description="of the sample; null where the through-beam's shift tells it")
    index_outside: Index = 1.0
    boundary: Literal["smooth", "matched"] = "smooth"
    glass: Glass | None = None

    @model_validator(mode="after")
    def _matched_has_no_glass(self) -> Cell:
        if self.boundary == "matched" and self.glass is not None:
            raise ValueError(
                "a matched boundary neither bends nor reflects, so it has no glass; leave glass out or choose smooth"
            )
        return self


class Beam(Record):
    """Cross-section of the beam, perpendicular to its axis."""

    profile: Literal["gaussian", "disc"]
    sigma_mm: Positive | None = None
    radius_mm: Positive | None = None
    power: Positive = Field(
        default=1.0,
        description=(
            "before any Fresnel loss; images are given per unit of it. Exposures need it and are divided by it, so"
            " there it is what the camera would count of the whole beam: counts per s at gain 1, mm2 and sr"
        ),
    )

    @model_validator(mode="after")
    def _size_of_its_profile(self) -> Beam:
        required, other = ("sigma_mm", "radius_mm") if self.profile == "gaussian" else ("radius_mm", "sigma_mm")
        if getattr(self, required) is None or getattr(self, other) is not None:
            raise ValueError(f"a {self.profile} beam is given by {required} alone")
        return self

    @property
    def size_mm(self) -> float:
        """Standard deviation of a Gaussian beam, or radius of a disc, mm."""
        return self.sigma_mm or self.radius_mm or 0.0


class PixelGrid(Record):
    """Pixels on a face, in the world's x and y; element [0, 0] of a file lies at the lower ends of x_mm and y_mm."""

    x_mm: tuple[float, float]
    y_mm: tuple[float, float]
    columns: Annotated[int, Field(gt=0, le=4096)]
    rows: Annotated[int, Field(gt=0, le=4096)]

    @model_validator(mode="after")
    def _increasing(self) -> PixelGrid:
        for name, (low, high) in (("x_mm", self.x_mm), ("y_mm", self.y_mm)):
            if not low < high:
                raise ValueError(f"{name} must go from a smaller to a larger value")
        return self


class Light(Record):
    """A collimated beam; its axis meets its face at x = y = 0."""

    name: Name
    side: Side
    angle_deg: Angle


class SlabCamera(Record):
    """A camera that sees light leave a face at an angle, everywhere the same or, in perspective, at x = y = 0."""

    name: Name
    side: Side
    angle_deg: Angle
    kind: Literal["orthographic", "perspective"] = "orthographic"
    distance_mm: Positive | None = Field(
        default=None, description="of a perspective camera's centre of projection from x = y = 0 on the outer face"
    )
    counts: CameraCounts | None = Field(default=None, description="what is known of its counts; of exposures alone")

    @model_validator(mode="after")
    def _distance_of_its_kind(self) -> SlabCamera:
        if (self.kind == "perspective") != (self.distance_mm is not None):
            raise ValueError("a perspective camera has a distance_mm, and no other camera has; add it or leave it out")
        return self


class SlabImage(Record):
    """One image: exit radiance per power of the beam, per mm2 and sr, averaged over each pixel."""

    camera: Name
    light: Name
    wavelength_nm: Positive | None = None
    file: str
    variance_file: str | None = None
    held_out: bool = False


class ThroughBeam(Record):
    """The position at which a slanted beam leaves the other face unscattered, which determines the sample's index."""

    light: Name
    wavelength_nm: Positive | None = Field(default=None, description="null where it holds for all")
    peak_x_mm: float = Field(description="of its peak, from where the beam's axis meets its own face")
    se_mm: Positive = Field(description="standard error of the peak")


class SlabFolder(Record):
    """The content of ``slab.json``."""

    kind: Literal["slab"]
    units: Literal["mm"]
    wavelengths_nm: Annotated[tuple[Positive, ...], Field(min_length=1)]
    cell: Cell
    beam: Beam
    pixels: PixelGrid
    lights: Annotated[tuple[Light, ...], Field(min_length=1)]
    cameras: Annotated[tuple[SlabCamera, ...], Field(min_length=1)]
    images: tuple[SlabImage, ...] = ()
    exposures: tuple[SlabExposure, ...] = Field(default=(), description="counts in place of images")
    through_beam: tuple[ThroughBeam, ...] = ()

    @model_validator(mode="after")
    def _names_agree(self) -> SlabFolder:
        for what, entries in (("light", self.lights), ("camera", self.cameras)):
            names = [entry.name for entry in entries]
            if twice := {name for name in names if names.count(name) > 1}:
                raise ValueError(f"{what} {min(twice)} is listed twice; give each {what} a name of its own")
        self._require_index()
        self._require_width()
        if bool(self.images) == bool(self.exposures):
            raise ValueError("a slab folder lists either images or exposures, not both; keep one of these lists")
        if self.images and (counted := [camera.name for camera in self.cameras if camera.counts is not None]):
            raise ValueError(f"camera {counted[0]} has counts, but images hold no counts; leave them out")
        if self.exposures and "power" not in self.beam.model_fields_set:
            raise ValueError(
                "beam has no power, by which exposures are divided; give it in counts per s at gain 1, mm2 and sr"
            )
        if fault := exposures_fault(self.exposures, self.wavelengths_nm, self._known_black()):
            raise ValueError(fault)
        seen: set[tuple[str, str, float]] = set()
        for image in self._entries():
            self._require_known(image)
            key = image.camera, image.light, self.wavelength_of(image)
            if key in seen:
                raise ValueError(
                    f"image {image.file}: camera {key[0]} under light {key[1]} at {key[2]:g} nm is listed twice;"
                    " keep one"
                )
            seen.add(key)
        files = Counter(image.file for image in self.images)
        if shared := [file for file, count in files.items() if count > 1]:
            raise ValueError(f"file {shared[0]} is listed for two images; give each image a file of its own")
        return self

    def _known_black(self) -> frozenset[str]:
        return frozenset(one.name for one in self.cameras if one.counts is not None and one.counts.black is not None)

    def _require_index(self) -> None:
        angles = {light.name: light.angle_deg for light in self.lights}
        for beam in self.through_beam:
            if beam.light not in angles:
                raise ValueError(
                    f"a through_beam names light {beam.light}, which is not among the lights; correct the name"
                )
            if angles[beam.light] == 0:
                what = f"the through_beam of light {beam.light} meets the cell at 0 degrees and is not bent"
                raise ValueError(f"{what}; measure one at an angle, or leave it out")
        if self.cell.boundary == "matched" or self.cell.index is not None:
            return
        stated_nm = {beam.wavelength_nm for beam in self.through_beam}
        if missing_nm := [nm for nm in self.wavelengths_nm if not stated_nm & {nm, None}]:
            what = f"cell.index is null, and no through_beam at {missing_nm[0]:g} nm tells it"
            raise ValueError(f"{what}; add one, or give the sample's index")

    def _require_width(self) -> None:
        low_mm, high_mm = self.pixels.x_mm
        if self.cell.width_mm > MAX_WIDTH * (high_mm - low_mm):
            raise ValueError(
                f"cell.width_mm is {self.cell.width_mm:g}, more than {MAX_WIDTH:g} times the {high_mm - low_mm:g} mm"
                " that pixels.x_mm spans, where little of its light is seen; give both in mm"
            )

    def _require_known(self, image: SlabImage) -> None:
        for what, name, entries in (("camera", image.camera, self.cameras), ("light", image.light, self.lights)):
            if name not in {entry.name for entry in entries}:
                raise ValueError(
                    f"image {image.file} names {what} {name}, which is not among the {what}s; correct the name"
                )
        if image.wavelength_nm is None and len(self.wavelengths_nm) > 1:
            raise ValueError(
                f"image {image.file} has no wavelength_nm, and there are {len(self.wavelengths_nm)}; name one"
            )
        if image.wavelength_nm is not None and image.wavelength_nm not in self.wavelengths_nm:
            raise ValueError(
                f"image {image.file} has wavelength_nm {image.wavelength_nm:g}, which is not listed; add it or"
                " correct it"
            )

    def _entries(self) -> tuple[SlabImage, ...]:
        """The images; or one entry for all exposures of a camera, light and wavelength, with the file of the first."""
        first: dict[tuple[Name, Name | None, float | None], SlabImage] = {}
        for one in self.exposures:
            if one.light is not None:
                entry = SlabImage(
                    camera=one.camera, light=one.light, wavelength_nm=one.wavelength_nm, file=one.file,
                    held_out=one.held_out,
                )  # fmt: skip
                first.setdefault((one.camera, one.light, one.wavelength_nm), entry)
        return self.images or tuple(first.values())

    def images_at(self, wavelength_nm: float) -> tuple[SlabImage, ...]:
        """The images of one wavelength in the folder's order; for exposures, one entry for each camera and light."""
        return tuple(image for image in self._entries() if self.wavelength_of(image) == wavelength_nm)

    def exposures_at(self, wavelength_nm: float) -> tuple[SlabExposure, ...]:
        """The exposures of one wavelength, and the black exposures that hold for all wavelengths."""
        return tuple(one for one in self.exposures if one.holds_at(wavelength_nm, self.wavelengths_nm))

    def files(self, wavelength_nm: float | None = None) -> tuple[str, ...]:
        """Every file that the folder names, for one wavelength or for all."""
        chosen = self.wavelengths_nm if wavelength_nm is None else (wavelength_nm,)
        images = [image for image in self.images if self.wavelength_of(image) in chosen]
        named = [file for image in images for file in (image.file, image.variance_file) if file is not None]
        return (*named, *dict.fromkeys(one.file for nm in chosen for one in self.exposures_at(nm)))

    def wavelength_of(self, image: SlabImage) -> float:
        """The image's wavelength, nm."""
        return self.wavelengths_nm[0] if image.wavelength_nm is None else image.wavelength_nm


def read_folder(root: Path) -> SlabFolder:
    """Read ``root/slab.json`` and check that its files exist.

    Raises:
        CaptureInputError: something is missing or contradictory; the message names it.
    """
    origin = root / "slab.json"
    folder = read_record(origin, SlabFolder)
    for file in folder.files():
        if not (root / file).resolve().is_relative_to(root.resolve()):
            raise CaptureInputError(f"Image file {file} lies outside the slab folder {root}; put it inside.")
        if not (root / file).is_file():
            raise CaptureInputError(f"Image file {root / file} does not exist; put it there or remove its entry.")
    return folder
