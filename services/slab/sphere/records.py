"""Records of a laboratory's readings: the sample, the instrument and what it read."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from services.core.geometry import Record
from services.core.slab.folder import Cell, Positive

Share = Annotated[float, Field(ge=0, le=1)]
Reading = Annotated[float, Field(ge=-0.05, le=1.2)]
"""A reading of no light may lie a little below zero, because the dark reading that was subtracted has noise."""
Standard = Annotated[float, Field(gt=0, le=1)]
Incidence = Annotated[float, Field(ge=0, lt=90)]
Wall = Annotated[float, Field(ge=0, lt=1)]


class Sphere(Record):
    """An integrating sphere used in the substitution method: one reading of the sample, one of the standard."""

    diameter_mm: Positive
    sample_port_mm: Positive = Field(description="diameter")
    third_port_mm: Annotated[float, Field(ge=0)] = Field(description="diameter of the port opposite the sample")
    detector_port_mm: Annotated[float, Field(ge=0)] = Field(description="diameter")
    wall_reflectance: Wall
    detector_reflectance: Share = 0.0
    baffle: bool = Field(
        default=True, description="between sample and detector, so that light must meet the wall first"
    )

    @model_validator(mode="after")
    def _ports_fit(self) -> Sphere:
        for name in ("sample_port_mm", "third_port_mm", "detector_port_mm"):
            if getattr(self, name) >= self.diameter_mm:
                raise ValueError(f"{name} must be below diameter_mm, {self.diameter_mm:g}")
        return self


class TotalsReading(Record):
    """Readings of one wavelength, as shares of the incident power. What is null below ``source`` is as in the file."""

    wavelength_nm: Positive | None = None
    R: Reading
    R_se: Positive | None = None
    T: Reading | None = Field(default=None, description="null where it was not measured")
    T_se: Positive | None = None
    T_unscattered: Annotated[float, Field(gt=0, le=1)] | None = Field(
        default=None, description="collimated transmittance"
    )
    T_unscattered_se: Positive | None = None
    source: Literal["normal", "diffuse"] = "normal"
    reflection_wall: Wall | None = Field(default=None, description="of the reflection sphere at this wavelength")
    transmission_wall: Wall | None = Field(default=None, description="of the transmission sphere at this wavelength")
    cell: Cell | None = Field(default=None, description="the sample of this reading")
    g: Annotated[float, Field(gt=-1, lt=1)] | None = Field(default=None, description="mean cosine")
    incidence_deg: Incidence | None = Field(default=None, description="angle of the beam from the normal")
    standard_reflectance: Standard | None = Field(default=None, description="of the standard R is told by")
    transmission_standard: Standard | None = Field(default=None, description="of the cap in the third port")
    specular_share: Share | None = Field(default=None, description="of the faces' mirror reflection that R holds")
    unscattered_share: Share | None = Field(default=None, description="of the unscattered light that T holds")
    without_sphere: bool = Field(default=False, description="whether this reading needs no correction of a sphere")


OWN = ("cell", "g", "incidence_deg", "standard_reflectance", "transmission_standard")
"""What a reading may have of its own in place of the file's."""


class SphereFile(Record):
    """A sample, the instrument, and its readings."""

    kind: Literal["sphere"]
    units: Literal["mm"]
    cell: Cell
    totals: Annotated[tuple[TotalsReading, ...], Field(min_length=1)]
    g: Annotated[float, Field(gt=-1, lt=1)] = Field(
        default=0.0, description="mean cosine where T_unscattered is not given"
    )
    reflection_sphere: Sphere | None = Field(default=None, description="null where R is corrected already")
    transmission_sphere: Sphere | None = Field(default=None, description="null where T is corrected already")
    standard_reflectance: Standard = Field(default=1.0, description="of the standard R is told by")
    transmission_standard: Standard = Field(default=1.0, description="of the cap in the third port")
    incidence_deg: Incidence = Field(default=0.0, description="angle of the beam from the normal")
    specular_included: bool = Field(default=True, description="whether R holds the mirror reflection of the faces")
    unscattered_included: bool = Field(default=True, description="whether T holds the unscattered light")

    @model_validator(mode="after")
    def _one_index(self) -> SphereFile:
        for cell in (self.cell, *(reading.cell for reading in self.totals if reading.cell)):
            if cell.boundary == "smooth" and cell.index is None:
                raise ValueError("cell.index is null, and totals do not tell it; give the sample's index")
            if cell.boundary == "smooth" and (cell.index or 0) < cell.index_outside:
                raise ValueError(
                    f"cell.index is below index_outside, {cell.index_outside:g}; only a sample that is denser is"
                    " understood"
                )
        return self

    def of(self, reading: TotalsReading) -> SphereFile:
        """The file with what this reading has of its own."""
        own: dict[str, object] = {name: value for name in OWN if (value := getattr(reading, name)) is not None}
        if reading.without_sphere:
            own |= {"reflection_sphere": None, "transmission_sphere": None}
        return self.model_copy(update=own) if own else self

    def named(self) -> list[tuple[str, TotalsReading]]:
        """Readings by wavelength in nm, or by their number where none is given. A wavelength that comes again, as for
        another sample, has a number behind it.
        """
        names: list[str] = []
        for number, reading in enumerate(self.totals, start=1):
            name = f"{number}" if reading.wavelength_nm is None else f"{reading.wavelength_nm:.10g}"
            again = sum(name == other.partition(" ")[0] for other in names) + 1
            names.append(name if again == 1 else f"{name} ({again})")
        return list(zip(names, self.totals, strict=True))

    def repeated_nm(self) -> float | None:
        """The smallest wavelength that is listed twice."""
        names = [reading.wavelength_nm for reading in self.totals]
        return min((nm for nm in names if nm is not None and names.count(nm) > 1), default=None)
