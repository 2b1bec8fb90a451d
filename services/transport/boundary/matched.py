"""An index-matched surface: light crosses it unaltered."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import mitsuba as mi

from services.transport.boundary.model import Meeting, bitmap
from services.transport.scene.geometry import Geometry, Hit


class Matched:
    """Outer faces that neither reflect nor bend light; see ``Boundary``."""

    name: ClassVar[str] = "matched"
    blender: ClassVar[str] = "ShaderNodeBsdfTransparent"
    plug_in: ClassVar[str | None] = None
    unaltered = True
    bends = False

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
        """Let all walks cross, without a random number."""
        return Meeting(mi.Float(1), mi.Bool(False), omega, mi.Float(0))

    def straight(
        self,
        geometry: Geometry,
        direction: mi.Vector3f,
        before: mi.UInt32,
        after: mi.UInt32,
        hit: Hit,
    ) -> mi.Float:
        """All light passes."""
        return mi.Float(1)

    def reflectance(self, cosine: mi.Float) -> mi.Float:
        """Nothing is reflected."""
        return mi.Float(0)

    def reflectance_inside(self, cosine: mi.Float) -> mi.Float:
        """Nothing is reflected."""
        return mi.Float(0)

    def enter(self, cosine: mi.Float) -> tuple[mi.Float, mi.Float]:
        """All light enters, in its own direction."""
        return mi.Float(1), cosine

    def leave(self, cosine: mi.Float) -> tuple[mi.Float, mi.Float, mi.Float]:
        """All light leaves, in its own direction."""
        return cosine, mi.Float(1), mi.Float(0)

    @staticmethod
    def mitsuba(ior: float, stain: Path | None = None) -> dict[str, Any]:
        """No surface; a stain becomes a mask before black, which absorbs what it covers."""
        if stain is None:
            return {"type": "null"}
        black = {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.0}}
        return {"type": "mask", "opacity": bitmap(stain), "nested": black}
