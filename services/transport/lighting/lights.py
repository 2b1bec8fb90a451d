"""Connections from scattering vertices to the lights: the choice of a light, and the shadow ray to it with its
derivatives.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from services.transport.boundary.model import Boundary
from services.transport.lighting.light_groups import LightGroups
from services.transport.lighting.light_maps import DARK_DEPTH, LightMaps
from services.transport.lighting.lit_faces import LitFaces
from services.transport.scene.border import inverse_cosine
from services.transport.scene.geometry import Geometry
from services.transport.scene.media import Media
from services.transport.scene.stain_textures import FaceCrossing

CANDIDATES = 8
"""Number of stratified candidate lights per connection; 18 or 54 cost more than they gained."""
STEPS_PER_ROOT = 0.4
"""Steps of the walk per connection, over the square root of the number of lights. A connection looks up about as many
lights as that root, so the look-ups per step do not grow with the lights. This value measured best at 54 and at 155
lights, and within 3 % of the best at 6."""
ROULETTE_GAIN = 3.0
DARKEST_CHANCE = 0.02
"""A shadow ray is cast with probability clip(``ROULETTE_GAIN`` x expected contribution, ``DARKEST_CHANCE``, 1)."""


class PointLights:
    """All lights of a rig for one channel."""

    def __init__(
        self, positions_mm: NDArray[np.float64], intensities: NDArray[np.float64], maps: LightMaps | LitFaces
    ) -> None:
        self.count = len(positions_mm)
        self.connection_period = math.ceil(STEPS_PER_ROOT * math.sqrt(self.count))
        self.maps = maps
        self.groups = LightGroups(positions_mm, intensities)
        self.positions = mi.Float(np.ascontiguousarray(positions_mm.reshape(-1), dtype=np.float32))
        self.intensities = mi.Float(np.ascontiguousarray(intensities, dtype=np.float32))
        dr.eval(self.positions, self.intensities)
        self.inverse_irradiance = dr.opaque(mi.Float, float(1 / np.mean(intensities / np.sum(positions_mm**2, axis=1))))
        edges = np.linspace(0, self.count, min(self.count, CANDIDATES) + 1).astype(int)
        self.strata = tuple(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True))

    def choose(
        self, point: mi.Point3f, importance: Callable[[mi.Vector3f], mi.Float], rng: mi.PCG32, active: mi.Bool
    ) -> ChosenLight:
        """Pick one light of stratified candidates in proportion to importance(direction) x intensity / distance^2
        (resampled importance sampling).
        """
        total, chosen = mi.Float(0), ChosenLight(mi.UInt32(0), mi.Vector3f(0, 0, 1), mi.Float(0), mi.Float(0))
        for first, last in self.strata:
            size = last - first
            index = mi.UInt32(first)
            if size > 1:
                index = first + dr.minimum(mi.UInt32(rng.next_float32() * size), size - 1)
            towards = dr.gather(mi.Point3f, self.positions, index, active) - point
            inverse = dr.rcp(dr.squared_norm(towards))
            direction = towards * dr.sqrt(inverse)
            strength = importance(direction) * dr.gather(mi.Float, self.intensities, index, active) * inverse
            total += size * strength
            take = rng.next_float32() * total < size * strength if len(self.strata) > 1 else mi.Bool(True)
            chosen.index = dr.select(take, index, chosen.index)
            chosen.direction = dr.select(take, direction, chosen.direction)
            chosen.strength = dr.select(take, strength, chosen.strength)
        chosen.total = total
        return chosen

    def seen_from(self, light: mi.UInt32, point: mi.Point3f, active: mi.Bool) -> tuple[mi.Vector3f, mi.Float]:
        """Unit direction to a light, and its intensity over the squared distance."""
        towards = dr.gather(mi.Point3f, self.positions, light, active) - point
        inverse = dr.rsqrt(dr.squared_norm(towards))
        return mi.Vector3f(towards * inverse), dr.gather(mi.Float, self.intensities, light, active) * dr.square(inverse)


@dataclass
class ChosenLight:
    """A light, the unit direction to it, its strength, and the total strength of all candidates."""

    index: mi.UInt32
    direction: mi.Vector3f
    strength: mi.Float
    total: mi.Float


@dataclass
class ShadowRay:
    """A straight line on its way to a light."""

    point: mi.Point3f
    enclosure: mi.UInt32
    depth: mi.Float
    """Optical depth so far."""
    surface: list[mi.Float]
    """Transmittance of the faces crossed; empty where no face of the scene reflects or absorbs."""
    lengths: list[mi.Float]
    """Path length in mm inside each of the ``measured`` media."""
    border: list[mi.Float]
    """d ln T / dc per shape mode: (sigma_B - sigma_A) dt/dc per crossing (teeth 2018 Eq. 30-32)."""
    stains: list[FaceCrossing]
    """One of the stained faces crossed; empty unless stain derivatives are computed."""
    alive: mi.Bool

    def transmittance(self) -> mi.Float:
        """Transmittance; 0 where the optical depth is too large to matter."""
        return dr.select(self.depth < DARK_DEPTH, dr.prod([*self.surface, dr.exp(-self.depth)]), 0)


def shadow(
    geometry: Geometry,
    media: Media,
    point: mi.Point3f,
    direction: mi.Vector3f,
    enclosure: mi.UInt32,
    active: mi.Bool,
    *,
    boundary: Boundary,
    measured: tuple[int, ...] = (),
    shape: int | None = None,
    stains: list[FaceCrossing] | None = None,
) -> ShadowRay:
    """Follow straight lines to distant lights through all media.

    Args:
        boundary: model of the outer faces.
        measured: media whose path lengths are summed.
        shape: index of the tooth to whose dentin shape derivatives are computed.
        stains: an empty reservoir for one of the stained faces crossed; None where stain derivatives are not computed.
    """

    def step(ray: ShadowRay, direction: mi.Vector3f) -> tuple[ShadowRay, mi.Vector3f]:
        medium = geometry.medium(ray.enclosure)
        sigma = media.extinction(medium)
        hit = geometry.intersect(ray.point, direction, ray.enclosure, ray.alive)
        length = dr.select(hit.valid, hit.distance, 0)
        ray.depth = dr.fma(sigma, length, ray.depth)
        ray.lengths = [
            total + dr.select(medium == k, length, 0) for k, total in zip(measured, ray.lengths, strict=True)
        ]
        behind = geometry.beyond(ray.enclosure, direction, hit)
        cosine = dr.dot(direction, hit.normal)
        if shape is not None:
            jump = (media.extinction(geometry.medium(behind)) - sigma) * inverse_cosine(cosine)
            ray.border = [
                dr.fma(speed, jump, total)
                for total, speed in zip(ray.border, geometry.velocity(hit, shape, ray.alive), strict=True)
            ]
        if not boundary.unaltered:
            through = boundary.straight(geometry, direction, ray.enclosure, behind, hit)
            ray.surface[0] *= dr.select(hit.valid & hit.outer, through, 1)
        if geometry.stained:
            crosses = ray.alive & geometry.on_stain(hit, ray.enclosure, behind)
            ray.surface[0] *= geometry.stain(hit, crosses)
            ray.stains = [reservoir.offer(hit, crosses) for reservoir in ray.stains]
        if geometry.opaque:
            ray.surface[0] = dr.select(hit.opaque, 0, ray.surface[0])
        ray.point = dr.select(hit.valid, geometry.advance(ray.point, direction, hit, hit.valid), ray.point)
        ray.enclosure = dr.select(hit.valid, behind, ray.enclosure)
        ray.alive &= hit.valid & ~hit.opaque & (ray.depth < DARK_DEPTH)
        return ray, direction

    modes = 0 if shape is None else geometry.modes_of[shape]
    lengths, border = [mi.Float(0) for _ in measured], [mi.Float(0) for _ in range(modes)]
    surface = [mi.Float(1)] * (not boundary.unaltered or geometry.stained or geometry.opaque)
    ray = ShadowRay(point, enclosure, mi.Float(0), surface, lengths, border, stains or [], mi.Bool(active))
    ended: ShadowRay
    ended, _ = dr.while_loop((ray, direction), lambda ray, _: ray.alive, step, label="shadow ray")
    return ended
