"""A polished flat face of a slab, by Fresnel's and Snell's laws; meshes do not have it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi

from services.transport.boundary.thin import Thin
from services.transport.optics import fresnel


class Smooth(Thin):
    """Flat faces that bend light: what only slabs ask differs from ``Thin``."""

    name: ClassVar[str] = "smooth"
    blender: ClassVar[str] = "ShaderNodeBsdfGlass"
    plug_in: ClassVar[str | None] = None

    def reflectance_inside(self, cosine: mi.Float) -> mi.Float:
        """Fresnel's reflectance towards the thinner medium; 1 beyond the critical angle."""
        return fresnel.reflectance(cosine, dr.rcp(self.ior))

    def enter(self, cosine: mi.Float) -> tuple[mi.Float, mi.Float]:
        """The share that is not reflected, and Snell's law."""
        return 1 - fresnel.reflectance(cosine, self.ior), self._inside(cosine)

    def leave(self, cosine: mi.Float) -> tuple[mi.Float, mi.Float, mi.Float]:
        """Snell's law, and the square of the index, by which radiance is larger inside."""
        return self._inside(cosine), dr.square(self.ior), fresnel.reflectance(cosine, self.ior)

    def _inside(self, cosine: mi.Float) -> mi.Float:
        return dr.sqrt(1 - (1 - dr.square(cosine)) / dr.square(self.ior))

    @staticmethod
    def mitsuba(ior: float, stain: Path | None = None) -> dict[str, Any]:  # noqa: ARG004 - slabs have no stains
        """Mitsuba's smooth dielectric."""
        return {"type": "dielectric", "int_ior": ior, "ext_ior": 1.0}
