"""What the rest of transport asks a boundary model. Borders between media inside an outer face are matched always."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, runtime_checkable

import mitsuba as mi

if TYPE_CHECKING:
    from services.transport.scene.geometry import Geometry, Hit


@dataclass
class Meeting:
    """What an outer face does to walks that meet it."""

    weight: mi.Float
    """Factor of the walk's weight."""
    reflects: mi.Bool
    """Lanes that stay on their side; the others cross the face."""
    onward: mi.Vector3f
    """Unit direction after the face."""
    roughness_score: mi.Float
    """Derivative of the logarithm of the walk's contribution to the roughness; 0 where the model has none."""


class Boundary(Protocol):
    """A boundary model with its index of refraction, as kernels take it."""

    name: ClassVar[str]
    """Name among the options of a job or of a slab."""
    blender: ClassVar[str]
    """Cycles' node for the surface."""
    plug_in: ClassVar[str | None]
    """File of the Python plug-in that stock Mitsuba needs for ``mitsuba``; None where it has the surface itself."""
    unaltered: bool
    """Whether light crosses the face as if it was not there. Kernels then hold no code for it."""
    bends: bool
    """Whether light changes its direction where it crosses the face. No vertex inside then sees a light, and walks
    connect to lights where they meet the face, by ``BendingBoundary.towards``."""

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
        """Let walks along ``omega`` from the place ``enclosure`` cross the surface ahead, or reflect them.

        Args:
            meets: lanes that reach the surface.
            omits: lanes whose reflection is left out, so that the reflected light is a factor of the weight.
            rng: generator of the decisions; it is advanced.
        """

    def straight(
        self, geometry: Geometry, direction: mi.Vector3f, before: mi.UInt32, after: mi.UInt32, hit: Hit
    ) -> mi.Float:
        """Transmittance of an outer face on a straight line to a light. It depends on no parameter that is
        differentiated, so a connection's scores have no term for it.
        """

    @staticmethod
    def mitsuba(ior: float, stain: Path | None = None) -> dict[str, Any]:
        """The surface in a scene of stock Mitsuba.

        Args:
            ior: index of refraction of the inside relative to the outside.
            stain: picture of the absorbed share of transmitted light.
        """


@runtime_checkable
class BendingBoundary(Boundary, Protocol):
    """A model whose faces change the direction of light that crosses them."""

    ior: mi.Float
    roughness: mi.Float

    def aims(self, lights: int) -> bool:
        """Whether images under so many lights cost less with connections that are aimed from scattering vertices."""

    def towards(
        self, omega: mi.Vector3f, normal: mi.Vector3f, direction: mi.Vector3f, ior: mi.Float | None = None
    ) -> tuple[mi.Float, mi.Float]:
        """What a walk along ``omega`` that meets a face receives from a light in ``direction`` outside, over the
        light's irradiance, 1/sr; and the derivative of its logarithm to the roughness.

        Args:
            ior: index of refraction of the solid behind the face; None for that of the teeth.
        """


@runtime_checkable
class FlatBoundary(Boundary, Protocol):
    """A model that a slab's flat faces can have; every direction has one answer."""

    def reflectance(self, cosine: mi.Float) -> mi.Float:
        """Share of light from empty space that the face reflects at ``cosine`` to the normal."""

    def reflectance_inside(self, cosine: mi.Float) -> mi.Float:
        """Share of light that a flat face reflects back into the slab at ``cosine`` to the normal inside."""

    def enter(self, cosine: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Share of light that a flat face lets in from ``cosine`` outside, and its cosine inside."""

    def leave(self, cosine: mi.Float) -> tuple[mi.Float, mi.Float, mi.Float]:
        """For light that leaves a flat face at ``cosine`` outside: the cosine inside, the ratio of solid angle times
        cosine outside to the same inside, and the share that is reflected back.
        """


def bitmap(picture: Path) -> dict[str, Any]:
    """A stain's picture as a texture of stock Mitsuba, with linear values."""
    return {
        "type": "bitmap",
        "filename": picture.as_posix(),
        "raw": True,
        "filter_type": "bilinear",
        "wrap_mode": "clamp",
    }
