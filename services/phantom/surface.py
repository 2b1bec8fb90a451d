"""The surface of a virtual tooth or object."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from services.core.errors import InputError
from services.core.records import Boundary
from services.core.surface.rough import DEFAULT_ROUGHNESS, MIN_ROUGH_IOR, ROUGHNESS
from services.transport.optics.parameters import Medium, Tissue

IOR = 1.631
"""Refractive index of enamel."""
ENAMEL_ROUGHNESS = 0.12
"""GGX roughness of wet enamel at the scale of a pixel."""
INK = Tissue(Medium(1e4, 1e-6), Medium(1e4, 1e-6))
"""Media that give no light back, so that an image of them shows the surface's reflection alone."""


@dataclass(frozen=True)
class PhantomSurface:
    """How light crosses the outer surface; a matched one has neither index nor roughness, a thin one no roughness."""

    boundary: Boundary = "matched"
    ior: float = IOR
    roughness: float = DEFAULT_ROUGHNESS
    """GGX roughness."""
    multiple_scattering: bool = True
    """Whether light that meets several facets is given back."""

    def __post_init__(self) -> None:
        """Refuse what is no surface.

        Raises:
            InputError: names the value that is out of its range.
        """
        if self.boundary != "matched" and not MIN_ROUGH_IOR <= self.ior <= 3:
            raise InputError(
                f"ior = {self.ior:g} must lie in {MIN_ROUGH_IOR:g} to 3; correct it, or choose boundary matched."
            )
        low, high = ROUGHNESS
        if self.is_rough and not low <= self.roughness <= high:
            raise InputError(
                f"roughness = {self.roughness:g} must lie in {low:g} to {high:g}; give a GGX roughness such as 0.15."
            )

    @property
    def is_rough(self) -> bool:
        """Whether light is bent and spread."""
        return self.boundary == "rough"

    @property
    def shine(self) -> float:
        """GGX roughness of the highlights; those of a thin surface are a wet tooth's."""
        return self.roughness if self.is_rough else ENAMEL_ROUGHNESS

    def require_renderer(self, renderer: str) -> None:
        """Refuse a surface that a renderer does not have.

        Raises:
            InputError: names the surface and the remedy.
        """
        if renderer != "mitsuba" or self.boundary == "matched":
            return
        if not self.is_rough:
            raise InputError(
                f"Stock Mitsuba has no {self.boundary} boundary; choose renderer engine or boundary matched."
            )
        if self.multiple_scattering:
            raise InputError(
                "Stock Mitsuba loses light that meets several facets; add --multiple-scattering off, or choose renderer"
                " engine."
            )

    def truth(self) -> dict[str, Any]:
        """What ``truth.json`` says of the surface."""
        told: dict[str, Any] = {"boundary": self.boundary, "ior": 1.0 if self.boundary == "matched" else self.ior}
        if self.is_rough:
            told |= {"roughness": self.roughness, "multiple_scattering": self.multiple_scattering}
        return told
