"""Paths through somebody else's scene: stock surfaces and lights around teeth, and the walk's own physics inside them.

Flights, phase functions, nested media and thin faces are those of the walk (``walk.py``); what differs is that any Mitsuba
surface and emitter may surround a tooth. Every vertex is joined to one sampled emitter along a straight line with analytic
transmittance, and weighed against the chance that the path finds that emitter by itself (Veach 1997, power heuristic).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from services.fit.optics import fresnel
from services.fit.optics.parameters import Medium
from services.fit.transport.geometry import ENAMEL
from services.fit.transport.gloss import Gloss
from services.fit.transport.media import Media, PhaseFunction
from services.fit.transport.scene_teeth import SceneTeeth
from services.fit.transport.walk import ROULETTE_WEIGHT, minus_log1m

CONNECTION_GAIN = 3.0
CONNECTION_FLOOR = 0.02
"""A scattering vertex is joined to its emitter with probability clip(gain x expected contribution, floor, 1), as in the walk."""
SCALE_SAMPLES = 4096
DARK_DEPTH = 40.0
"""Optical depth past which a straight line is dark in single precision."""


@dataclass(frozen=True)
class ToothOptics:
    """What teeth are made of: one medium per colour channel, lengths in scene units (mm where the fit's values are used)."""

    enamel: tuple[Medium, ...]
    dentin: tuple[Medium, ...]
    """Empty where no dentin surface is named."""
    ior: float | None = None
    """Of ``thin`` outer faces; None where they are index-matched."""
    roughness: float | None = None
    """GGX roughness of the outer face's mirror image; None leaves that image out, as a fit does."""


@dataclass
class Path:
    """State of every lane."""

    sampler: Any
    ray: mi.Ray3f
    place: mi.UInt32
    throughput: mi.Spectrum
    radiance: mi.Spectrum
    last: mi.Interaction3f
    """The vertex that chose the ray's direction ..."""
    density: mi.Float
    """... with this density, 1/sr ..."""
    certain: mi.Bool
    """... or without a choice that an emitter connection could have made (camera, mirror)."""
    channel: mi.UInt32
    """The one colour channel this path follows inside teeth."""
    divided: mi.Bool
    """Whether it has been inside one, and so carries that channel alone."""
    from_tooth: mi.Bool
    """Whether the last scattering was inside a tooth."""
    depth: mi.UInt32
    valid: mi.Bool
    active: mi.Bool


@dataclass
class Shadow:
    """A straight line on its way to an emitter."""

    ray: mi.Ray3f
    place: mi.UInt32
    depth: mi.Spectrum
    """Optical depth so far."""
    surface: mi.Float
    """Transmittance of the faces crossed, 0 behind an opaque surface."""
    alive: mi.Bool


def power(p: mi.Float, q: mi.Float) -> mi.Float:
    """Weight of a sample drawn with density p that could also have been drawn with q."""
    return dr.select(p > 0, dr.square(p) / (dr.square(p) + dr.square(q)), 0)


class ScenePaths:
    """Estimates the radiance along rays into one scene."""

    def __init__(self, scene: Any, teeth: SceneTeeth, optics: ToothOptics, max_depth: int) -> None:
        self.scene, self.teeth = scene, teeth
        self.channels = len(optics.enamel)
        self.parts = 2 if optics.dentin else 1
        # Every channel has media of its own, numbered one channel after the other.
        pairs = zip(optics.enamel, optics.dentin, strict=True) if optics.dentin else ((medium,) for medium in optics.enamel)
        self.media = Media([medium for channel in pairs for medium in channel])
        self.ior = None if optics.ior is None else dr.opaque(mi.Float, optics.ior)
        self.gloss = None if self.ior is None or optics.roughness is None else Gloss(optics.roughness, self.ior)
        self.max_depth = dr.opaque(mi.UInt32, max_depth)
        self.inverse_irradiance = self._inverse_irradiance()

    def _inverse_irradiance(self) -> mi.Float:
        # What the emitters would bring to the teeth's middle without obstacles.
        rng = mi.PCG32(SCALE_SAMPLES)
        middle = dr.zeros(mi.Interaction3f, SCALE_SAMPLES)
        middle.p = mi.Point3f(self.teeth.centre.tolist())
        _, weight = self.scene.sample_emitter_direction(middle, mi.Point2f(rng.next_float32(), rng.next_float32()), False)
        mean = float(dr.mean(dr.max(weight))[0])
        return dr.opaque(mi.Float, 1 / mean if mean > 0 else 0.0)

    def radiance(self, sampler: Any, ray: mi.Ray3f, active: mi.Bool) -> tuple[mi.Spectrum, mi.Bool]:
        """Radiance estimates along camera rays, and whether they met anything."""
        channel = mi.UInt32(0)
        if self.channels > 1:
            channel = dr.minimum(mi.UInt32(sampler.next_1d(active) * self.channels), self.channels - 1)
        path = Path(
            sampler=sampler,
            ray=mi.Ray3f(ray),
            place=mi.UInt32(0),
            throughput=mi.Spectrum(1),
            radiance=mi.Spectrum(0),
            last=dr.zeros(mi.Interaction3f),
            density=mi.Float(1),
            certain=mi.Bool(True),
            channel=channel,
            divided=mi.Bool(False),
            from_tooth=mi.Bool(False),
            depth=mi.UInt32(0),
            valid=mi.Bool(False),
            active=mi.Bool(active),
        )
        (path,) = dr.while_loop((path,), lambda path: path.active, lambda path: (self._step(path),), label="paths through teeth")
        return path.radiance, path.valid

    def _medium(self, path: Path) -> mi.UInt32:
        index = self.teeth.medium(path.place)
        return index if self.channels == 1 else dr.select(index == 0, 0, index + self.parts * path.channel)

    def _step(self, path: Path) -> Path:
        sampler = path.sampler

        # Free flight; one that ends within the known clearance meets no surface and traces no ray.
        medium = self._medium(path)
        sigma = self.media.extinction(medium)
        inside = path.active & (medium != 0)
        distance = dr.select(inside, minus_log1m(sampler.next_1d(inside)) / sigma, dr.largest(mi.Float))
        path.ray.maxt = distance
        traced = path.active & (distance >= self.teeth.clearance(path.ray.o, inside))
        found = self.scene.ray_intersect_preliminary(path.ray, coherent=False, active=traced)
        meets = traced & found.is_valid()
        scatters = inside & ~meets
        si = found.compute_surface_interaction(path.ray, +mi.RayFlags.All, meets)
        part = self.teeth.part(found, meets)
        ordinary, face = meets & (part == 0), meets & (part == ENAMEL)

        # Light that the path has found by itself.
        self._collect(path, si, ordinary | (path.active & ~meets & ~scatters))
        path.valid |= meets
        path.active &= meets | scatters

        # What a tooth's outer face reflects. Without gloss, what arrives from elsewhere shows no mirror image.
        cosine = dr.dot(path.ray.d, si.n)
        enters = face & (cosine < 0)
        mirrors, glossy, shines = mi.Bool(False), mi.Bool(False), mi.Bool(False)
        if self.ior is not None:
            reflected = fresnel.reflectance(dr.abs(cosine), self.ior)
            u = sampler.next_1d(face)
            if self.gloss is None:
                hidden = enters & ~path.from_tooth
                path.throughput *= dr.select(hidden, 1 - reflected, 1)
                mirrors = face & ~hidden & (u < reflected)
            else:
                shines = enters & (si.wi.z > 0)
                glossy = shines & (u < reflected)
                mirrors = face & ~enters & (u < reflected)
        crosses = meets & (part != 0) & ~mirrors & ~glossy

        # Vertices: a scattering, an ordinary surface, a glossy face.
        path.throughput *= dr.select(scatters, dr.exp(self.media.pick(self.media.log_alpha, medium)), 1)
        vertex = dr.zeros(mi.Interaction3f)
        vertex.p = dr.select(scatters, path.ray(distance), si.p)
        vertex.n = dr.select(scatters, 0, si.n)
        vertex.time, vertex.wavelengths = path.ray.time, path.ray.wavelengths
        ends = (scatters | ordinary | glossy) & (path.depth + 1 >= self.max_depth)
        joined = (scatters | ordinary | shines) & ~ends

        # Sample an emitter, and what each kind of vertex sends into its direction; sample onward directions.
        light, brought = self.scene.sample_emitter_direction(vertex, sampler.next_2d(joined), False, joined)
        phase = PhaseFunction(self.media, medium)
        u_lobe = sampler.next_1d(scatters) if self.media.two_lobes else None
        scattered = phase.density(path.ray.d, light.d)
        onward = phase.sample(path.ray.d, u_lobe, sampler.next_1d(scatters), sampler.next_1d(scatters))
        value, density, bounce, weight = si.bsdf().eval_pdf_sample(
            mi.BSDFContext(), si, si.to_local(light.d), sampler.next_1d(ordinary), sampler.next_2d(ordinary), ordinary
        )
        value = dr.select(scatters, mi.Spectrum(scattered), value)
        density = dr.select(scatters, scattered, density)
        direction = dr.select(scatters, onward, si.to_world(bounce.wo))
        chosen = dr.select(scatters, phase.density(path.ray.d, onward), bounce.pdf)
        weight = dr.select(scatters, mi.Spectrum(1), weight)
        if self.gloss is not None:
            shine, shine_density = self.gloss.evaluate(si, light.d)
            value = dr.select(shines, mi.Spectrum(shine), value)
            density = dr.select(shines, reflected * shine_density, density)
            image = self.gloss.sample(si, sampler.next_2d(glossy))
            shine, shine_density = self.gloss.evaluate(si, image)
            direction = dr.select(glossy, image, direction)
            chosen = dr.select(glossy, reflected * shine_density, chosen)
            weight = dr.select(glossy, mi.Spectrum(dr.select(shine_density > 0, shine / (reflected * shine_density), 0)), weight)

        # Join; inside a tooth only with a probability in proportion to what the emitter could bring.
        value = path.throughput * value * brought
        chance = dr.clip(CONNECTION_GAIN * dr.max(value) * self.inverse_irradiance, CONNECTION_FLOOR, 1)
        chance = dr.select(scatters, chance, 1)
        joined &= (light.pdf > 0) & (dr.max(value) > 0) & (sampler.next_1d(joined) < chance)
        start = si.spawn_ray(light.d)
        start.o = dr.select(scatters, vertex.p, start.o)
        start.maxt = light.dist * (1 - mi.math.ShadowEpsilon)
        share = dr.select(light.delta, 1, power(light.pdf, density)) / chance
        path.radiance += dr.select(joined, value * share * self._transmittance(start, path.place, joined), 0)

        # Go on.
        turns = scatters | ordinary | glossy
        direction = dr.select(turns, direction, dr.select(mirrors, path.ray.d - mi.Vector3f(si.n) * (2 * cosine), path.ray.d))
        place = self.teeth.beyond(path.place, part, cosine)
        path.place = dr.select(crosses, place, path.place)
        origin = vertex.p
        onward_ray = si.spawn_ray(direction)
        onward_ray.o = dr.select(scatters, origin, onward_ray.o)
        path.ray = onward_ray
        path.throughput *= dr.select(turns, weight, 1)
        path.last = dr.select(turns, vertex, path.last)
        path.density = dr.select(turns, chosen, path.density)
        delta = ordinary & mi.has_flag(bounce.sampled_type, mi.BSDFFlags.Delta)
        path.certain = dr.select(turns, delta, path.certain | mirrors)
        path.from_tooth = dr.select(turns, scatters, path.from_tooth)
        path.depth += dr.select(turns, mi.UInt32(1), 0)
        if self.channels > 1:
            self._divide(path, crosses)

        # Paths that faded survive in proportion to what they carry.
        left = dr.max(path.throughput) / ROULETTE_WEIGHT
        path.active &= ~ends & (left > 0) & (sampler.next_1d(path.active) < left)
        path.throughput *= dr.select(left < 1, dr.rcp(dr.maximum(left, 1e-20)), 1)
        return path

    def _divide(self, path: Path, crosses: mi.Bool) -> None:
        # Media differ per channel: from its first entry on, a path carries one channel for all.
        divides = crosses & ~path.divided & (path.place != 0)
        kept = mi.Spectrum([dr.select(path.channel == k, mi.Float(self.channels), 0) for k in range(self.channels)])
        path.throughput *= dr.select(divides, kept, 1)
        path.divided |= divides

    def _collect(self, path: Path, si: mi.SurfaceInteraction3f, active: mi.Bool) -> None:
        emitter = si.emitter(self.scene, active)
        there = mi.DirectionSample3f(self.scene, si, path.last)
        other = self.scene.pdf_emitter_direction(path.last, there, active & ~path.certain)
        share = dr.select(path.certain, 1, power(path.density, other))
        path.radiance += dr.select(active, path.throughput * emitter.eval(si, active) * share, 0)

    def _extinction(self, place: mi.UInt32) -> mi.Spectrum:
        index = self.teeth.medium(place)
        return mi.Spectrum([dr.select(index == 0, 0, self.media.pick(self.media.sigma, index + self.parts * k)) for k in range(self.channels)])

    def _transmittance(self, ray: mi.Ray3f, place: mi.UInt32, active: mi.Bool) -> mi.Spectrum:
        """Of the straight line along ``ray``, through teeth as far as its maxt."""

        def step(shadow: Shadow) -> Shadow:
            found = self.scene.ray_intersect_preliminary(shadow.ray, coherent=False, active=shadow.alive)
            meets = shadow.alive & found.is_valid()
            si = found.compute_surface_interaction(shadow.ray, +mi.RayFlags.Minimal, meets)
            part = self.teeth.part(found, meets)
            length = dr.select(meets, found.t, dr.select((shadow.place != 0) & shadow.alive, shadow.ray.maxt, 0))
            shadow.depth += self._extinction(shadow.place) * length
            cosine = dr.dot(shadow.ray.d, si.n)
            if self.ior is not None:
                shadow.surface *= dr.select(meets & (part == ENAMEL), 1 - fresnel.reflectance(dr.abs(cosine), self.ior), 1)
            shadow.surface *= dr.select(meets & (part == 0), 0, 1)
            shadow.alive = meets & (part != 0) & (dr.min(shadow.depth) < DARK_DEPTH)
            onward = si.spawn_ray(shadow.ray.d)
            onward.maxt = shadow.ray.maxt - found.t
            shadow.place = dr.select(shadow.alive, self.teeth.beyond(shadow.place, part, cosine), shadow.place)
            shadow.ray = dr.select(shadow.alive, onward, shadow.ray)
            return shadow

        shadow = Shadow(ray, mi.UInt32(place), mi.Spectrum(0), mi.Float(1), mi.Bool(active))
        (shadow,) = dr.while_loop((shadow,), lambda shadow: shadow.alive, lambda shadow: (step(shadow),), label="light through teeth")
        return shadow.surface * dr.exp(-shadow.depth)
