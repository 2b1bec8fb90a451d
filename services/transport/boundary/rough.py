"""A rough dielectric surface of one roughness: facets of a GGX distribution, each by Fresnel's and Snell's laws (Walter
et al. 2007), with compensation for light that meets several facets (``optics.ggx_albedo``).

The squares of the index by which radiance changes at the surface are left out on both sides: a walk from a camera that
ends at a light outside has crossed the surface as often inwards as outwards, or has left out both. In a mouth the gums
have an index of their own and the teeth's roughness, and the surface of a root lies between the two.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from services.transport.boundary.model import Meeting
from services.transport.optics import fresnel, ggx
from services.transport.optics.ggx_albedo import ANGLES, albedo_tables
from services.transport.scene.geometry import Geometry, Hit

MIN_COSINE = 1e-6
"""Smallest cosine to the normal at which light arrives: below it a direction in the surface has no side."""

MAX_AIMED = 1.9
"""Largest roughness, times the cube root of the number of lights, at which connections that are aimed from inside make
up for their cost, 0.5 under 54 lights: they are 1.2 times as efficient at 0.45 and 0.9 times at 0.6, and under 8 lights
1.1 times at 0.8 and 0.9 times at 1."""


class Rough:
    """Outer faces that bend and spread light; see ``Boundary``. Lights are reached from the face itself."""

    name: ClassVar[str] = "rough"
    blender: ClassVar[str] = "ShaderNodeBsdfGlass"
    plug_in: ClassVar[str | None] = None
    unaltered = False
    bends = True

    def __init__(
        self, ior: float, roughness: float, *, gums_ior: float | None = None, compensated: bool = True
    ) -> None:
        self.ior, self.roughness = dr.opaque(mi.Float, ior), dr.opaque(mi.Float, roughness)
        self.compensated = compensated
        self._aims_up_to = (MAX_AIMED / roughness) ** 3
        self._has_gums = gums_ior is not None
        if compensated:
            contrasts = (ior,) if gums_ior is None else (ior, gums_ior, max(ior / gums_ior, gums_ior / ior))
            tables = np.array([albedo_tables(roughness, contrast) for contrast in contrasts], dtype=np.float32)
            self._albedos, self._scores = (mi.Float(tables[:, which].reshape(-1)) for which in range(2))
            dr.eval(self._albedos, self._scores)

    def meet(
        self,
        geometry: Geometry,
        omega: mi.Vector3f,
        enclosure: mi.UInt32,
        hit: Hit,
        meets: mi.Bool,
        omits: mi.Bool,  # noqa: ARG002 - a mirror image of the tooth itself is wanted
        rng: mi.PCG32,
    ) -> Meeting:
        """Sample a visible facet, and reflect or refract by chance."""
        faces = meets & hit.outer & ~hit.opaque
        leaving = dr.dot(omega, hit.normal) > 0
        frame = mi.Frame3f(dr.select(leaving, -mi.Vector3f(hit.normal), mi.Vector3f(hit.normal)))
        towards = frame.to_local(-omega)
        towards.z = dr.maximum(towards.z, MIN_COSINE)
        if geometry.single:
            eta, dense, kind = dr.select(leaving, dr.rcp(self.ior), self.ior), leaving, mi.UInt32(0)
        else:
            before, after = (
                geometry.index(self.ior, place) for place in (enclosure, geometry.beyond(enclosure, omega, hit))
            )
            # Faces that lie hidden in another solid of the same index do nothing.
            faces &= before != after
            eta, dense = after / before, before > after
            kind = dr.select(dr.minimum(before, after) > 1, mi.UInt32(2), self._kind(dr.maximum(before, after)))
        facet = ggx.visible_normal(towards, self.roughness, rng.next_float32(), rng.next_float32())
        cosine = dr.clip(dr.dot(towards, facet), 0, 1)
        reflects = rng.next_float32() < fresnel.reflectance(cosine, eta)

        # Mirror the direction at the facet, or bend it by Snell's law.
        beyond = dr.sqrt(dr.maximum(1 - (1 - dr.square(cosine)) / dr.square(eta), 0))
        onward = dr.select(reflects, facet * (2 * cosine) - towards, facet * (cosine / eta - beyond) - towards / eta)
        away = dr.select(reflects, onward.z, -onward.z)
        albedo, score = self._compensation(dense, towards.z, kind)
        weight = dr.select(away > 0, ggx.visible_share(away, self.roughness), 0) / albedo
        score = (
            ggx.score_of_distribution(facet.z, self.roughness)
            + ggx.score_of_visible_share(towards.z, self.roughness)
            + ggx.score_of_visible_share(dr.maximum(away, 0), self.roughness)
            - score
        )
        return Meeting(
            dr.select(faces, weight, 1),
            faces & reflects,
            dr.select(faces, dr.normalize(frame.to_world(onward)), omega),
            dr.select(faces, score / self.roughness, 0),
        )

    def aims(self, lights: int) -> bool:
        """Whether the lobe is so narrow that walks seldom arrive in it by chance."""
        return lights <= self._aims_up_to

    def towards(
        self, omega: mi.Vector3f, normal: mi.Vector3f, direction: mi.Vector3f, ior: mi.Float | None = None
    ) -> tuple[mi.Float, mi.Float]:
        """Light that a walk along ``omega`` receives over a light's irradiance, 1/sr, by reflection where it comes
        from outside and else by refraction; and the derivative of its logarithm to the roughness.
        """
        kind = mi.UInt32(0) if ior is None else self._kind(ior)
        ior = self.ior if ior is None else ior
        out, arriving = dr.dot(direction, normal), dr.dot(omega, normal)
        leaving = arriving > 0
        raw = dr.select(leaving, direction / ior, direction) - omega
        facet = raw * dr.rsqrt(dr.maximum(dr.squared_norm(raw), 1e-20))
        facet = dr.mulsign(facet, dr.dot(facet, normal))
        at_light, at_walk = dr.dot(direction, facet), dr.dot(omega, facet)
        upright, near = dr.dot(facet, normal), dr.clip(dr.abs(arriving), MIN_COSINE, 1)

        passed = dr.select(leaving, at_walk, -at_walk)
        mirrored = fresnel.reflectance(dr.clip(at_light, 0, 1), ior)
        # The width of a cone of refracted light over that of its facets' normals.
        spread = at_light * at_walk / dr.maximum(dr.square(ior * at_walk - at_light), 1e-20)
        share = dr.select(leaving, (1 - mirrored) * spread, 0.25 * mirrored)
        albedo, score = self._compensation(leaving, near, kind)
        far = dr.clip(out, 0, 1)
        value = (
            share
            * ggx.distribution(upright, self.roughness)
            * ggx.visible_share_over_cosine(near, self.roughness)
            * ggx.visible_share(far, self.roughness)
            / albedo
        )
        score = (
            ggx.score_of_distribution(upright, self.roughness)
            + ggx.score_of_visible_share(near, self.roughness)
            + ggx.score_of_visible_share(far, self.roughness)
            - score
        )
        return dr.select((out > 0) & (at_light > 0) & (passed > 0), value, 0), score / self.roughness

    def _kind(self, ior: mi.Float) -> mi.UInt32:
        """Number of the table of a solid's face to air."""
        return dr.select(ior == self.ior, mi.UInt32(0), mi.UInt32(1)) if self._has_gums else mi.UInt32(0)

    def _compensation(self, dense: mi.Bool, cosine: mi.Float, kind: mi.UInt32) -> tuple[mi.Float, mi.Float]:
        """Albedo by which both lobes are divided, and the derivative of its logarithm to that of the roughness.

        Args:
            dense: whether light arrives from the dense side.
            kind: number of the pair of media: 0 teeth and air, 1 gums and air, 2 teeth and gums.
        """
        if not self.compensated:
            return mi.Float(1), mi.Float(0)
        place = dr.sqrt(dr.clip(cosine, 0, 1)) * (ANGLES - 1)
        cell = dr.minimum(mi.UInt32(place), ANGLES - 2)
        fraction = place - mi.Float(cell)
        first = cell + 2 * ANGLES * kind + dr.select(dense, mi.UInt32(ANGLES), mi.UInt32(0))
        albedo, score = (
            dr.lerp(dr.gather(mi.Float, table, first), dr.gather(mi.Float, table, first + 1), fraction)
            for table in (self._albedos, self._scores)
        )
        return albedo, score

    def straight(
        self,
        geometry: Geometry,  # noqa: ARG002
        direction: mi.Vector3f,  # noqa: ARG002
        before: mi.UInt32,  # noqa: ARG002
        after: mi.UInt32,  # noqa: ARG002
        hit: Hit,  # noqa: ARG002
    ) -> mi.Float:
        """No light goes straight on."""
        return mi.Float(0)

    @staticmethod
    def mitsuba(ior: float, stain: Path | None = None, roughness: float = 0.15) -> dict[str, Any]:  # noqa: ARG004
        """Mitsuba's rough dielectric, which has no compensation."""
        return {"type": "roughdielectric", "distribution": "ggx", "alpha": roughness, "int_ior": ior, "ext_ior": 1.0}
