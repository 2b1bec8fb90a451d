"""Exposures of a slab: counts as a camera wrote them, in several times of exposure, in place of linear images."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Sequence
from typing import Annotated, Literal

from pydantic import Field, model_validator

from services.core.geometry import Name, Record

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
MAX_BITS = 16


class CameraCounts(Record):
    """What is known of a camera's counts beforehand, in place of what its frames tell."""

    black: NotNegative | None = Field(default=None, description="counts without light, in place of black frames")
    read_noise: NotNegative | None = Field(
        default=None, description="standard deviation without light, counts at gain 1"
    )
    per_electron: Positive | None = Field(default=None, description="counts per electron at gain 1")

    @model_validator(mode="after")
    def _noise_has_both_parts(self) -> CameraCounts:
        if (self.read_noise is None) != (self.per_electron is None):
            raise ValueError("a camera's noise is read_noise and per_electron; give both or neither")
        return self


class SlabExposure(Record):
    """One frame of one camera, on the folder's grid of pixels."""

    camera: Name
    light: Name | None = Field(default=None, description="null where the kind is black")
    wavelength_nm: Positive | None = Field(
        default=None, description="null where there is one, and for black frames that hold for all"
    )
    kind: Literal["light", "black"] = Field(default="light", description="black: taken with the beam off")
    file: str
    exposure_s: Positive
    gain: Positive = Field(default=1.0, description="linear factor from light to counts, beside the exposure")
    bits: Annotated[int, Field(ge=1, le=MAX_BITS)] | None = Field(
        default=None, description="significant bits of a count; needed wherever files hold whole numbers"
    )
    shift: Annotated[int, Field(ge=0, lt=MAX_BITS)] = Field(
        default=0, description="how many bits the file moves counts up: 4 for 12 bits in the high bits of 16"
    )
    saturation_counts: Positive | None = Field(
        default=None, description="counts from which on a pixel is taken for full; default: the largest of its bits"
    )
    held_out: bool = Field(default=False, description="as an image's; alike in all exposures that make one image")

    @model_validator(mode="after")
    def _require_fields_of_its_kind(self) -> SlabExposure:
        if (self.kind == "light") != (self.light is not None):
            what = "must name its light" if self.kind == "light" else "has no light on; leave light out"
            raise ValueError(f"exposure {self.file} of kind {self.kind} {what}")
        if self.kind == "black" and self.held_out:
            raise ValueError(
                f"exposure {self.file} is black, and only exposures of light are held out; remove held_out"
            )
        if self.bits is None and self.saturation_counts is None:
            raise ValueError(f"exposure {self.file} does not say when a pixel is full; give bits or saturation_counts")
        if self.bits is not None and self.bits + self.shift > MAX_BITS:
            raise ValueError(
                f"exposure {self.file} has bits {self.bits} and shift {self.shift}, together more than the {MAX_BITS}"
                " bits of a file"
            )
        if self.bits is not None and self.saturation_counts is not None and self.saturation_counts > 2**self.bits - 1:
            most = 2**self.bits - 1
            raise ValueError(
                f"exposure {self.file} has saturation_counts {self.saturation_counts:g}, more than {self.bits} bits"
                f" hold ({most})"
            )
        return self

    def holds_at(self, wavelength_nm: float, wavelengths_nm: Sequence[float]) -> bool:
        """Whether the exposure belongs to a wavelength; ``wavelengths_nm`` are all wavelengths of the folder."""
        if self.wavelength_nm is None:
            return self.kind == "black" or wavelength_nm == wavelengths_nm[0]
        return self.wavelength_nm == wavelength_nm


def exposures_fault(
    exposures: Sequence[SlabExposure], wavelengths_nm: Sequence[float], known_black: Collection[str] = ()
) -> str | None:
    """The first contradiction between the exposures of a folder, as a clause; None if there is none.

    Args:
        exposures: all of the folder.
        wavelengths_nm: those of the folder.
        known_black: names of the cameras whose counts without light are known beforehand.
    """
    uses = defaultdict[str, list[SlabExposure]](list)
    for one in exposures:
        uses[one.file].append(one)
    if twice := [file for file, own in uses.items() if len(own) > 1 and not _is_shared_black(own)]:
        return f"file {min(twice)} is listed in two exposures; keep one of them"
    for one in exposures:
        if one.wavelength_nm is not None and one.wavelength_nm not in wavelengths_nm:
            return (
                f"exposure {one.file} has wavelength_nm {one.wavelength_nm:g}, which is not listed; add it or"
                " correct it"
            )
    held_out = {(one.camera, one.light, one.wavelength_nm) for one in exposures if one.held_out}
    for one in exposures:
        if (one.camera, one.light, one.wavelength_nm) in held_out and not one.held_out:
            return (
                f"exposure {one.file} of camera {one.camera} under light {one.light} is fitted and another of the same"
                " image is held out; hold out all of them or none"
            )
    black = [one for one in exposures if one.kind == "black"]
    if both := [one.camera for one in black if one.camera in known_black]:
        return f"camera {both[0]} has black frames and a known black of its counts; keep one of both"
    for one in exposures:
        if one.kind == "black" or one.camera in known_black:
            continue
        wavelength_nm = wavelengths_nm[0] if one.wavelength_nm is None else one.wavelength_nm
        if not any(dark.camera == one.camera and dark.holds_at(wavelength_nm, wavelengths_nm) for dark in black):
            return (
                f"camera {one.camera} has no black exposure, so the zero of {one.file} is unknown; take one with the"
                " beam off and list it with kind black, or give the camera counts with black"
            )
    return None


def _is_shared_black(entries: Sequence[SlabExposure]) -> bool:
    """Whether entries of one file are the black frame of different cameras, as where one camera is moved to several
    places.
    """
    cameras = {(one.camera, one.wavelength_nm) for one in entries}
    return len(cameras) == len(entries) and all(one.kind == "black" for one in entries)
