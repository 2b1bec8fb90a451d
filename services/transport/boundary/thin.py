"""A thin dielectric layer (teeth 2018): Fresnel's reflectance from empty space on both sides, and light that is not
reflected goes straight on.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi

from services.transport.boundary.model import Meeting, bitmap
from services.transport.optics import fresnel
from services.transport.scene.geometry import Geometry, Hit


class Thin:
    """Outer faces that reflect light by chance and do not bend it; see ``Boundary``."""

    name: ClassVar[str] = "thin"
    blender: ClassVar[str] = "ShaderNodeBsdfTransparent under a Fresnel factor"
    plug_in: ClassVar[str | None] = "thin_boundary.py"
    unaltered = False
    bends = False

    def __init__(self, ior: float) -> None:
        self.ior = dr.opaque(mi.Float, ior)
        """Index of refraction of the inside, relative to the outside."""

    def meet(
        self,
        geometry: Geometry,
        omega: mi.Vector3f,
        enclosure: mi.UInt32,
        hit: Hit,
        meets: mi.Bool,
        omits: mi.Bool,
        rng: mi.PCG32,
    ) -> Meeting:
        """Reflect walks by chance, but weight those whose reflection is left out."""
        mirrored = self._mirrored(geometry, omega, enclosure, geometry.beyond(enclosure, omega, hit), hit)
        reflects = meets & hit.outer & ~hit.opaque
        weight = dr.select(reflects & omits, 1 - mirrored, 1)
        reflects &= ~omits & (rng.next_float32() < mirrored)
        image = omega - mi.Vector3f(hit.normal) * (2 * dr.dot(omega, hit.normal))
        return Meeting(weight, reflects, dr.select(reflects, image, omega), mi.Float(0))

    def straight(
        self, geometry: Geometry, direction: mi.Vector3f, before: mi.UInt32, after: mi.UInt32, hit: Hit
    ) -> mi.Float:
        """The share that is not reflected."""
        return 1 - self._mirrored(geometry, direction, before, after, hit)

    def _mirrored(
        self, geometry: Geometry, direction: mi.Vector3f, before: mi.UInt32, after: mi.UInt32, hit: Hit
    ) -> mi.Float:
        contrast = geometry.contrast(self.ior, before, after)
        return fresnel.reflectance(dr.abs(dr.dot(direction, hit.normal)), contrast)

    def reflectance(self, cosine: mi.Float) -> mi.Float:
        """Fresnel's reflectance."""
        return fresnel.reflectance(cosine, self.ior)

    def reflectance_inside(self, cosine: mi.Float) -> mi.Float:
        """The same as from outside, because light is not bent."""
        return fresnel.reflectance(cosine, self.ior)

    def enter(self, cosine: mi.Float) -> tuple[mi.Float, mi.Float]:
        """The share that is not reflected, in its own direction."""
        return 1 - fresnel.reflectance(cosine, self.ior), cosine

    def leave(self, cosine: mi.Float) -> tuple[mi.Float, mi.Float, mi.Float]:
        """Light leaves in its own direction, but for the share that is reflected back."""
        return cosine, mi.Float(1), fresnel.reflectance(cosine, self.ior)

    @staticmethod
    def mitsuba(ior: float, stain: Path | None = None) -> dict[str, Any]:
        """The plug-in that ships with an asset."""
        return {"type": "thin_boundary", "ior": ior} | ({} if stain is None else {"stain": bitmap(stain)})
