"""Paths through somebody else's scene: stock surfaces and lights around teeth, and the walk's own physics inside them.

Flights, phase functions, nested media and thin faces are those of the walk (``walk.py``); the difference is that any
Mitsuba surface and emitter may surround a tooth. Every vertex is joined to one sampled emitter along a straight line
with analytic transmittance, and weighted against the chance that the path finds that emitter by itself (multiple
importance sampling, Veach 1997, power heuristic).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from services.transport.boundary.models import slab_boundary
from services.transport.lighting.light_maps import DARK_DEPTH
from services.transport.optics.free_flight import minus_log1m
from services.transport.paths.walk import ROULETTE_WEIGHT
from services.transport.plugin.channel_media import ChannelMedia, ToothOptics
from services.transport.plugin.gloss import Gloss
from services.transport.plugin.scene_teeth import SceneTeeth
from services.transport.scene.geometry import ENAMEL

CONNECTION_GAIN = 3.0
CONNECTION_FLOOR = 0.02
"""A scattering vertex is joined to its emitter with probability clip(``CONNECTION_GAIN`` x expected contribution,
``CONNECTION_FLOOR``, 1), as in the walk."""
SCALE_SAMPLES = 4096
"""Number of samples for the mean light that the emitters bring to the teeth."""


@dataclass
class Path:
    """State of every lane's path."""

    sampler: Any
    ray: mi.Ray3f
    enclosure: mi.UInt32
    throughput: mi.Spectrum
    radiance: mi.Spectrum
    last: mi.Interaction3f
    """The last vertex at which the ray's direction was chosen."""
    density: mi.Float
    """Density of that choice, 1/sr."""
    certain: mi.Bool
    """Whether no emitter connection could have made that choice (camera, mirror)."""
    leader: mi.UInt32
    """Colour channel by which the path samples its flights and directions."""
    leader_densities: mi.Spectrum
    """Density of the same path with each channel as leader, relative to the largest; ``throughput`` does not contain
    this factor."""
    from_tooth: mi.Bool
    """Whether the last scattering was inside a tooth."""
    depth: mi.UInt32
    valid: mi.Bool
    active: mi.Bool


@dataclass
class Flight:
    """Result of one flight."""

    si: mi.SurfaceInteraction3f
    part: mi.UInt32
    """Part of the tooth that the surface bounds: ENAMEL, DENTIN, or 0 for any other surface."""
    cosine: mi.Float
    """Cosine between flight and outward normal."""
    distance: mi.Float
    meets: mi.Bool
    """Whether the flight meets a surface."""
    scatters: mi.Bool
    """Whether the flight scatters in a tooth before it meets a surface."""
    ordinary: mi.Bool
    """Whether the flight meets a surface that is no tooth's."""
    mirrors: mi.Bool
    """Whether a face reflects the path like a smooth mirror."""
    glossy: mi.Bool
    """Whether a rough face reflects the path; never where ``shines`` is false."""
    shines: mi.Bool
    """Whether the flight meets a rough face from outside, which could reflect it."""
    reflected: mi.Float
    """Reflectance of the outer face that the flight meets."""

    @property
    def samples_direction(self) -> mi.Bool:
        """Whether the flight ends at a vertex with a choice of directions."""
        return self.scatters | self.ordinary | self.glossy


@dataclass
class OnwardChoice:
    """Choice of the onward direction at a vertex."""

    direction: mi.Vector3f
    density: mi.Float
    weight: mi.Spectrum
    certain: mi.Bool
    """Whether no emitter connection could have made this choice."""


@dataclass
class Shadow:
    """A straight line on its way to an emitter."""

    ray: mi.Ray3f
    enclosure: mi.UInt32
    depth: mi.Spectrum
    """Optical depth so far."""
    surface: mi.Float
    """Transmittance of the faces crossed, 0 behind an opaque surface."""
    alive: mi.Bool


def power(p: mi.Float, q: mi.Float) -> mi.Float:
    """Weight (power heuristic) of a sample drawn with density p that could also have been drawn with density q."""
    return dr.select(p > 0, dr.square(p) / (dr.square(p) + dr.square(q)), 0)


class ScenePaths:
    """Estimates the radiance along rays into one scene."""

    def __init__(self, scene: Any, teeth: SceneTeeth, optics: ToothOptics, max_depth: int) -> None:
        self.scene, self.teeth, self.media = scene, teeth, ChannelMedia(optics)
        self.boundary = slab_boundary(optics.boundary, optics.ior)
        self.gloss = None
        if not self.boundary.unaltered and optics.roughness is not None:
            self.gloss = Gloss(optics.roughness, self.boundary)
        self.max_depth = dr.opaque(mi.UInt32, max_depth)
        self.inverse_irradiance = self._inverse_irradiance()

    def _inverse_irradiance(self) -> mi.Float:
        # Estimate the light that the emitters would bring to the teeth's middle without obstacles.
        rng = mi.PCG32(SCALE_SAMPLES)
        middle = dr.zeros(mi.Interaction3f, SCALE_SAMPLES)
        middle.p = mi.Point3f(self.teeth.centre.tolist())
        _, weight = self.scene.sample_emitter_direction(
            middle, mi.Point2f(rng.next_float32(), rng.next_float32()), False
        )
        mean = float(dr.mean(dr.max(weight))[0])
        return dr.opaque(mi.Float, 1 / mean if mean > 0 else 0.0)

    def radiance(self, sampler: Any, ray: mi.Ray3f, active: mi.Bool) -> tuple[mi.Spectrum, mi.Bool]:
        """Radiance estimates along camera rays, and whether they met anything."""
        path = Path(
            sampler=sampler,
            ray=mi.Ray3f(ray),
            enclosure=mi.UInt32(0),
            throughput=mi.Spectrum(1),
            leader=self.media.pick_leader(sampler.next_1d(active)),
            leader_densities=mi.Spectrum(1),
            radiance=mi.Spectrum(0),
            last=dr.zeros(mi.Interaction3f),
            density=mi.Float(1),
            certain=mi.Bool(True),
            from_tooth=mi.Bool(False),
            depth=mi.UInt32(0),
            valid=mi.Bool(False),
            active=mi.Bool(active),
        )
        (path,) = dr.while_loop(
            (path,), lambda path: path.active, lambda path: (self._step(path),), label="paths through teeth"
        )
        return path.radiance, path.valid

    def _step(self, path: Path) -> Path:
        flight = self._fly(path)
        self._collect(path, flight)
        path.valid |= flight.meets
        path.active &= flight.meets | flight.scatters
        if not self.boundary.unaltered:
            self._reflect(path, flight)

        vertex = self._vertex(path, flight)
        ends = flight.samples_direction & (path.depth + 1 >= self.max_depth)
        choice = self._connect_and_sample(path, flight, vertex, (flight.samples_direction | flight.shines) & ~ends)
        self._continue_path(path, flight, vertex, choice)

        # Let faded paths survive in proportion to their throughput.
        survival = dr.max(path.throughput * self.media.channel_weights(path.leader_densities)) / ROULETTE_WEIGHT
        path.active &= ~ends & (path.sampler.next_1d(path.active) < survival)
        path.throughput *= dr.select(survival < 1, dr.rcp(dr.maximum(survival, 1e-20)), 1)
        return path

    def _fly(self, path: Path) -> Flight:
        # A flight that ends within the known clearance meets no surface and traces no ray.
        part = self.teeth.medium(path.enclosure)
        sigmas = self.media.extinction(part)
        sigma = self.media.of_leader(path.leader, sigmas)
        inside = path.active & (part != 0)
        distance = dr.select(inside, minus_log1m(path.sampler.next_1d(inside)) / sigma, dr.largest(mi.Float))
        path.ray.maxt = distance
        traced = path.active & (distance >= self.teeth.clearance(path.ray.o, inside))
        found = self.scene.ray_intersect_preliminary(path.ray, coherent=False, active=traced)
        meets = traced & found.is_valid()
        scatters = inside & ~meets
        si = found.compute_surface_interaction(path.ray, +mi.RayFlags.All, meets)

        # Multiply by the density of this flight under each channel, relative to the leader's.
        length = dr.select(meets, found.t, distance)
        path.leader_densities = self.media.multiply_densities(
            path.leader_densities, dr.exp((sigma - sigmas) * length) * dr.select(scatters, sigmas / sigma, 1), inside
        )
        hit_part = self.teeth.part(found, meets)
        never = mi.Bool(False)
        return Flight(
            si,
            hit_part,
            dr.dot(path.ray.d, si.n),
            distance,
            meets,
            scatters,
            meets & (hit_part == 0),
            never,
            never,
            never,
            mi.Float(0),
        )

    def _collect(self, path: Path, flight: Flight) -> None:
        """Add light that the path has found by itself, on a surface or in the environment."""
        active = flight.ordinary | (path.active & ~flight.meets & ~flight.scatters)
        emitter = flight.si.emitter(self.scene, active)
        there = mi.DirectionSample3f(self.scene, flight.si, path.last)
        emitter_density = self.scene.pdf_emitter_direction(path.last, there, active & ~path.certain)
        share = dr.select(path.certain, 1, power(path.density, emitter_density))
        carried = path.throughput * self.media.channel_weights(path.leader_densities)
        path.radiance += dr.select(active, carried * emitter.eval(flight.si, active) * share, 0)

    def _reflect(self, path: Path, flight: Flight) -> None:
        """Decide which paths a thin outer face reflects.

        Without gloss, a path that arrives from outside the teeth shows no mirror image: it is transmitted, and the loss
        is a weight.
        """
        face, enters = flight.meets & (flight.part == ENAMEL), flight.cosine < 0
        flight.reflected = self.boundary.reflectance(dr.abs(flight.cosine))
        is_reflected = face & (path.sampler.next_1d(face) < flight.reflected)
        if self.gloss is None:
            hidden = enters & ~path.from_tooth
            path.throughput *= dr.select(face & hidden, 1 - flight.reflected, 1)
            flight.mirrors = is_reflected & ~hidden
        else:
            flight.shines = face & enters & (flight.si.wi.z > 0)
            flight.glossy = is_reflected & flight.shines
            flight.mirrors = is_reflected & ~enters

    def _vertex(self, path: Path, flight: Flight) -> mi.Interaction3f:
        # Here 1 - alpha below single precision is lost, unlike in the walk, because a picture does not show 1e-7.
        path.throughput *= dr.select(flight.scatters, self.media.albedo(self.teeth.medium(path.enclosure)), 1)
        vertex = dr.zeros(mi.Interaction3f)
        vertex.p = dr.select(flight.scatters, path.ray(flight.distance), flight.si.p)
        vertex.n = dr.select(flight.scatters, 0, flight.si.n)
        vertex.time, vertex.wavelengths = path.ray.time, path.ray.wavelengths
        return vertex

    def _connect_and_sample(
        self, path: Path, flight: Flight, vertex: mi.Interaction3f, connects: mi.Bool
    ) -> OnwardChoice:
        """Join the vertex to one emitter, and choose where the path goes; stock surfaces do both in one call."""
        sampler, si, scatters, ordinary = path.sampler, flight.si, flight.scatters, flight.ordinary
        light, brought = self.scene.sample_emitter_direction(vertex, sampler.next_2d(connects), False, connects)

        # Evaluate and sample a scattering in a tooth.
        part = self.teeth.medium(path.enclosure)
        u_lobe = sampler.next_1d(scatters) if self.media.two_lobes else None
        onward = self.media.sample_direction(part, path.leader, path.ray.d, u_lobe, sampler.next_2d(scatters))
        to_light, to_onward = self.media.phase(part, path.ray.d, light.d), self.media.phase(part, path.ray.d, onward)

        # Evaluate and sample an ordinary surface.
        value, density, bounce, weight = si.bsdf().eval_pdf_sample(
            mi.BSDFContext(), si, si.to_local(light.d), sampler.next_1d(ordinary), sampler.next_2d(ordinary), ordinary
        )
        value = dr.select(scatters, to_light, value)
        density = dr.select(scatters, self.media.mean_density(path.leader_densities, to_light), density)
        choice = OnwardChoice(
            dr.select(scatters, onward, si.to_world(bounce.wo)),
            dr.select(scatters, self.media.mean_density(path.leader_densities, to_onward), bounce.pdf),
            dr.select(scatters, 1, weight),
            ordinary & mi.has_flag(bounce.sampled_type, mi.BSDFFlags.Delta),
        )

        # Evaluate and sample the outside of a glossy face.
        if self.gloss is not None:
            shine, chance = self.gloss.evaluate(si, light.d)
            value, density = (
                dr.select(flight.shines, shine, value),
                dr.select(flight.shines, flight.reflected * chance, density),
            )
            image = self.gloss.sample(si, sampler.next_2d(flight.glossy))
            shine, chance = self.gloss.evaluate(si, image)
            choice.direction = dr.select(flight.glossy, image, choice.direction)
            choice.density = dr.select(flight.glossy, flight.reflected * chance, choice.density)
            choice.weight = dr.select(
                flight.glossy, dr.select(chance > 0, shine / (flight.reflected * chance), 0), choice.weight
            )

        self._connect(path, flight, vertex, light, value * brought, density, connects)
        path.leader_densities = self.media.multiply_densities(path.leader_densities, to_onward, scatters)
        return choice

    def _connect(
        self,
        path: Path,
        flight: Flight,
        vertex: mi.Interaction3f,
        light: mi.DirectionSample3f,
        value: mi.Spectrum,
        density: mi.Float,
        connects: mi.Bool,
    ) -> None:
        # In a tooth, join only with a probability in proportion to the light that the emitter could bring.
        value = path.throughput * self.media.channel_weights(path.leader_densities) * value
        chance = dr.clip(CONNECTION_GAIN * dr.max(value) * self.inverse_irradiance, CONNECTION_FLOOR, 1)
        chance = dr.select(flight.scatters, chance, 1)
        connects &= (light.pdf > 0) & (dr.max(value) > 0) & (path.sampler.next_1d(connects) < chance)
        line = flight.si.spawn_ray(light.d)
        line.o = dr.select(flight.scatters, vertex.p, line.o)
        line.maxt = light.dist * (1 - mi.math.ShadowEpsilon)
        share = dr.select(light.delta, 1, power(light.pdf, density)) / chance
        path.radiance += dr.select(connects, value * share * self._transmittance(line, path.enclosure, connects), 0)

    def _continue_path(self, path: Path, flight: Flight, vertex: mi.Interaction3f, choice: OnwardChoice) -> None:
        samples_direction, mirrors = flight.samples_direction, flight.mirrors
        crosses = flight.meets & ~samples_direction & ~mirrors
        path.enclosure = dr.select(
            crosses, self.teeth.beyond(path.enclosure, flight.part, flight.cosine), path.enclosure
        )
        mirrored = path.ray.d - mi.Vector3f(flight.si.n) * (2 * flight.cosine)
        direction = dr.select(samples_direction, choice.direction, dr.select(mirrors, mirrored, path.ray.d))
        onward = flight.si.spawn_ray(direction)
        onward.o = dr.select(flight.scatters, vertex.p, onward.o)
        path.ray = onward
        path.throughput *= dr.select(samples_direction, choice.weight, 1)
        path.last = dr.select(samples_direction, vertex, path.last)
        path.density = dr.select(samples_direction, choice.density, path.density)
        path.certain = dr.select(samples_direction, choice.certain, path.certain | mirrors)
        path.from_tooth = dr.select(samples_direction, flight.scatters, path.from_tooth)
        path.depth += dr.select(samples_direction, mi.UInt32(1), 0)

    def _transmittance(self, ray: mi.Ray3f, enclosure: mi.UInt32, active: mi.Bool) -> mi.Spectrum:
        """Transmittance of the straight line along ``ray``, through teeth as far as its maxt."""

        def step(shadow: Shadow) -> Shadow:
            found = self.scene.ray_intersect_preliminary(shadow.ray, coherent=False, active=shadow.alive)
            meets = shadow.alive & found.is_valid()
            si = found.compute_surface_interaction(shadow.ray, +mi.RayFlags.Minimal, meets)
            part = self.teeth.part(found, meets)
            length = dr.select(meets, found.t, dr.select((shadow.enclosure != 0) & shadow.alive, shadow.ray.maxt, 0))
            shadow.depth += self.media.extinction(self.teeth.medium(shadow.enclosure)) * length
            cosine = dr.dot(shadow.ray.d, si.n)
            if not self.boundary.unaltered:
                shadow.surface *= dr.select(meets & (part == ENAMEL), 1 - self.boundary.reflectance(dr.abs(cosine)), 1)
            shadow.surface *= dr.select(meets & (part == 0), 0, 1)
            shadow.alive = meets & (part != 0) & (dr.min(shadow.depth) < DARK_DEPTH)
            onward = si.spawn_ray(shadow.ray.d)
            onward.maxt = shadow.ray.maxt - found.t
            shadow.enclosure = dr.select(
                shadow.alive, self.teeth.beyond(shadow.enclosure, part, cosine), shadow.enclosure
            )
            shadow.ray = dr.select(shadow.alive, onward, shadow.ray)
            return shadow

        shadow = Shadow(ray, mi.UInt32(enclosure), mi.Spectrum(0), mi.Float(1), mi.Bool(active))
        (shadow,) = dr.while_loop(
            (shadow,), lambda shadow: shadow.alive, lambda shadow: (step(shadow),), label="light through teeth"
        )
        return shadow.surface * dr.exp(-shadow.depth)
