"""Exposures of a slab: counts as a camera wrote them, in several times of exposure, in place of linear images."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import Field, model_validator

from services.core.geometry import Name, Record

Positive = Annotated[float, Field(gt=0)]


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
    bits: Annotated[int, Field(ge=1, le=16)] | None = Field(
        default=None, description="significant bits of a count; needed wherever files hold whole numbers"
    )
    saturation_counts: Positive | None = Field(
        default=None, description="counts from which on a pixel is taken for full; default: the largest of its bits"
    )

    @model_validator(mode="after")
    def _require_fields_of_its_kind(self) -> SlabExposure:
        if (self.kind == "light") != (self.light is not None):
            what = "must name its light" if self.kind == "light" else "has no light on; leave light out"
            raise ValueError(f"exposure {self.file} of kind {self.kind} {what}")
        if self.bits is None and self.saturation_counts is None:
            raise ValueError(f"exposure {self.file} does not say when a pixel is full; give bits or saturation_counts")
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


def exposures_fault(exposures: Sequence[SlabExposure], wavelengths_nm: Sequence[float]) -> str | None:
    """The first contradiction between the exposures of a folder, as a clause; None if there is none."""
    if twice := [file for file, count in Counter(one.file for one in exposures).items() if count > 1]:
        return f"file {min(twice)} is listed in two exposures; keep one of them"
    for one in exposures:
        if one.wavelength_nm is not None and one.wavelength_nm not in wavelengths_nm:
            return (
                f"exposure {one.file} has wavelength_nm {one.wavelength_nm:g}, which is not listed; add it or"
                " correct it"
            )
    black = [one for one in exposures if one.kind == "black"]
    for one in exposures:
        if one.kind == "black":
            continue
        wavelength_nm = wavelengths_nm[0] if one.wavelength_nm is None else one.wavelength_nm
        if not any(dark.camera == one.camera and dark.holds_at(wavelength_nm, wavelengths_nm) for dark in black):
            return (
                f"camera {one.camera} has no black exposure, so the zero of {one.file} is unknown; take one with the"
                " beam off and list it with kind black"
            )
    return None
