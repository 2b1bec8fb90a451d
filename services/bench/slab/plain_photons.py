"""Images of a cell by a simple random walk of photons: a truth for the slab's fit that shares no code with its kernel.

Every photon starts in the beam's profile, is refracted at the face, flies exponential distances, is reflected inside
with the probability of Fresnel's equations, and changes its direction by a finely tabulated phase function. Every
collision adds to the camera's image the light that reaches the camera directly and after up to three internal
reflections; a fourth would add less than 1e-5 at an index of 1.5. There is no forced collision, splitting, score
estimate or quadrature. Every image has photons of its own, so that its noise is independent: photons that contribute to
all cameras of a light would give errors that are correlated between the cameras, unlike in a measurement.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.core.slab.folder import Light, SlabFolder

Array = NDArray[np.float64]

NODES = 7201
"""Number of nodes of the phase function's table: one every 0.025 degrees."""
MIN_WEIGHT = 1e-4
"""Weight below which a photon continues with a probability of one in ten and tenfold weight (Russian roulette)."""
BATCHES = 16
"""Number of independent batches, whose scatter gives the variance."""


def plain_images(
    folder: SlabFolder,
    extinction_per_mm: float,
    albedo: float,
    phase_per_sr: Callable[[Array], Array],
    photons: int,
    seed: int,
) -> tuple[Array, Array]:
    """Return images in the folder's order and the variances of their means, both (images, rows, columns).

    Args:
        folder: description of the cell, its lights, cameras and images.
        extinction_per_mm: extinction coefficient of the medium.
        albedo: single-scattering albedo of the medium.
        phase_per_sr: phase function of the scattering angle in rad; its scale is arbitrary.
        photons: number of photons of each image, in all batches together.
        seed: seed of the random numbers.
    """
    angles = np.linspace(0.0, math.pi, NODES)
    phase, cosines = _normalised(phase_per_sr(angles), angles)
    cell = folder.cell
    index = 1.0 if cell.boundary == "matched" or cell.index is None else cell.index / cell.index_outside
    cameras = {camera.name: camera for camera in folder.cameras}
    shape = len(folder.images), folder.pixels.rows, folder.pixels.columns
    means, variances = np.zeros(shape), np.zeros(shape)
    (x_from, x_to), (y_from, y_to) = folder.pixels.x_mm, folder.pixels.y_mm
    grid = x_from, x_to, y_from, y_to, folder.pixels.columns, folder.pixels.rows
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for number, light in enumerate(folder.lights):
            light_images = [k for k, entry in enumerate(folder.images) if entry.light == light.name]
            if not light_images:
                continue
            beam = _arriving(folder, light, index)
            places = [(k, (seed, number, k, batch)) for batch in range(BATCHES) for k in light_images]

            def batch(place: tuple[int, tuple[int, ...]], beam: tuple[float, ...] = beam) -> Array:
                image, one = place
                view = np.array([_leaving(cameras[folder.images[image].camera], index)])
                images = np.zeros((1, *shape[1:]))
                _trace(np.random.default_rng(one), photons // BATCHES, beam, view, extinction_per_mm, albedo, phase,
                       cosines, cell.width_mm, index, grid, images)  # fmt: skip
                return np.asarray(images[0])

            batches = np.stack(list(pool.map(batch, places))) * folder.beam.power / (photons // BATCHES)
            batches = batches.reshape(BATCHES, len(light_images), *shape[1:])
            means[light_images] = batches.mean(axis=0)
            variances[light_images] = batches.var(axis=0, ddof=1) / BATCHES
    return means, variances


def _normalised(phase: Array, angles: Array) -> tuple[Array, Array]:
    """Return the phase function per sr at the nodes, and the cosines at equal steps of its cumulative distribution."""
    density = phase * np.sin(angles)
    steps = 0.5 * (density[1:] + density[:-1]) * np.diff(angles)
    total = float(steps.sum())
    cumulative = np.append(0.0, np.cumsum(steps)) / total
    cosines = np.interp(np.linspace(0.0, 1.0, 20 * NODES), cumulative, np.cos(angles))
    return phase / (2 * math.pi * total), cosines


def _arriving(folder: SlabFolder, light: Light, index: float) -> tuple[float, ...]:
    """Return the beam's sine in the medium, its sign of z, the depth of its face in mm, its footprint in x and y in mm
    as standard deviation or radius, and 1 for a disc or 0 for a Gaussian.
    """
    slant = math.cos(math.radians(light.angle_deg))
    front = light.side == "front"
    return (
        math.sin(math.radians(light.angle_deg)) / index, 1.0 if front else -1.0, 0.0 if front else folder.cell.width_mm,
        folder.beam.size_mm / slant, folder.beam.size_mm, float(folder.beam.profile == "disc"),
    )  # fmt: skip


def _leaving(camera: Any, index: float) -> tuple[float, float, float, float]:
    """Return the sine in the medium of light that reaches the camera, the sign of its z, and the position of a
    perspective camera's centre along x and its height above the face, infinite for an orthographic camera.
    """
    angle, sign = math.radians(camera.angle_deg), -1.0 if camera.side == "front" else 1.0
    if camera.distance_mm is None:
        return math.sin(angle) / index, sign, 0.0, math.inf
    return math.sin(angle) / index, sign, camera.distance_mm * math.sin(angle), camera.distance_mm * math.cos(angle)


@njit(nogil=True, cache=True)  # type: ignore[untyped-decorator]
def _reflectance(cosine: float, index: float) -> float:
    """Return the Fresnel reflectance of unpolarised light from inside a medium of relative index ``index``, at the
    cosine inside.
    """
    if index == 1.0:
        return 0.0
    outside = index * index * (1 - cosine * cosine)
    if outside >= 1:
        return 1.0
    other = math.sqrt(1 - outside)
    s = (index * cosine - other) / (index * cosine + other)
    p = (index * other - cosine) / (index * other + cosine)
    return 0.5 * (s * s + p * p)


@njit(nogil=True, cache=True)  # type: ignore[untyped-decorator]
def _send(
    image: Array, sine: float, sign: float, odd: int, x: float, y: float, z: float, power_per_sr: float,
    sigma_t: float, width: float, index: float, grid: tuple[float, float, float, float, int, int],
) -> None:  # fmt: skip
    """Add a collision's light to one camera's image: directly and after two reflections, or, where ``odd`` is 1, after
    one and three reflections.

    ``sine`` and ``sign`` (of z) describe the direction at the end of the flight; with an odd number of reflections the
    flight begins in the other direction of z.
    """
    x_from, x_to, y_from, y_to, columns, rows = grid
    cosine = math.sqrt(1 - sine * sine)
    reflectance = _reflectance(cosine, index)
    # Outside, radiance is power per projected area of the face and per solid angle; the cosines outside cancel.
    area = (x_to - x_from) * (y_to - y_from) / (columns * rows)
    share = power_per_sr * (1 - reflectance) / (index * index * cosine * area)
    onward = sign > 0 if odd == 0 else sign < 0
    distance = (width - z if onward else z) / cosine
    if odd == 1:
        distance += width / cosine
        share *= reflectance
    row = math.floor((y - y_from) / (y_to - y_from) * rows)
    for _ in range(2):
        column = math.floor((x + distance * sine - x_from) / (x_to - x_from) * columns)
        if 0 <= column < columns and 0 <= row < rows:
            image[row, column] += share * math.exp(-sigma_t * distance)
        distance += 2 * width / cosine
        share *= reflectance * reflectance


@njit(nogil=True, cache=True)  # type: ignore[untyped-decorator]
def _reach(sine: float, deep: float, height: float, index: float) -> float:
    """Return how far to the side light gets from a depth to a height above the face."""
    outside = index * sine
    return deep * sine / math.sqrt(1 - sine * sine) + height * outside / math.sqrt(1 - outside * outside)


@njit(nogil=True, cache=True)  # type: ignore[untyped-decorator]
def _send_to_centre(
    image: Array, view: Array, direction: tuple[float, float, float], x: float, y: float, z: float, power: float,
    phase: Array, sigma_t: float, width: float, index: float, grid: tuple[float, float, float, float, int, int],
) -> None:  # fmt: skip
    """Add a collision's light to the image of a perspective camera: directly and after up to three reflections.

    The direction to the centre is found by bisection, and how light spreads on its way there by differences.
    """
    x_from, x_to, y_from, y_to, columns, rows = grid
    _, sign, centre_x, height = view
    u, v, w = direction
    side = math.hypot(centre_x - x, y)
    to_x, to_y = (centre_x - x) / side, -y / side
    area = (x_to - x_from) * (y_to - y_from) / (columns * rows)
    for reflections in range(4 if index > 1 else 1):
        onward = sign > 0 if reflections % 2 == 0 else sign < 0
        deep = (width - z if onward else z) + reflections * width
        low, high = 0.0, 1 / index
        for _ in range(50):
            sine = (low + high) / 2
            if _reach(sine, deep, height, index) < side:
                low = sine
            else:
                high = sine
        cosine, outside = math.sqrt(1 - sine * sine), math.sqrt(1 - index * index * sine * sine)
        reflectance = _reflectance(cosine, index)
        step = 1e-6
        spread = (_reach(sine + step, deep, height, index) - _reach(sine - step, deep, height, index)) / (2 * step)
        # Solid angle in the medium per area that is perpendicular to the light at the centre; power per such area is
        # radiance times the face's area times its cosine over the squared distance.
        per_area = sine / (cosine * side * spread * outside)
        away = height / outside
        turned = u * sine * to_x + v * sine * to_y + w * (sign if reflections % 2 == 0 else -sign) * cosine
        node = math.acos(min(1.0, max(-1.0, turned))) / math.pi * (len(phase) - 1)
        k = min(int(node), len(phase) - 2)
        density = phase[k] + (node - k) * (phase[k + 1] - phase[k])
        value = power * density * (1 - reflectance) * reflectance**reflections * math.exp(-sigma_t * deep / cosine)
        path = deep * sine / cosine
        column = math.floor((x + path * to_x - x_from) / (x_to - x_from) * columns)
        row = math.floor((y + path * to_y - y_from) / (y_to - y_from) * rows)
        if 0 <= column < columns and 0 <= row < rows:
            image[row, column] += value * per_area * away * away / outside / area


@njit(nogil=True, cache=True)  # type: ignore[untyped-decorator]
def _trace(
    random: np.random.Generator, photons: int, beam: tuple[float, float, float, float, float, float], views: Array,
    sigma_t: float, albedo: float, phase: Array, cosines: Array, width: float, index: float,
    grid: tuple[float, float, float, float, int, int], images: Array,
) -> None:  # fmt: skip
    """Trace photons and add their contributions to ``images`` (cameras, rows, columns)."""
    beam_sine, beam_sign, face, size_x, size_y, disc = beam
    beam_cosine = math.sqrt(1 - beam_sine * beam_sine)
    entered = 1 - _reflectance(beam_cosine, index)
    to_node = (len(phase) - 1) / math.pi
    for _ in range(photons):
        if disc > 0:
            radius, turn = math.sqrt(random.random()), 2 * math.pi * random.random()
            x, y = size_x * radius * math.cos(turn), size_y * radius * math.sin(turn)
        else:
            x, y = size_x * random.standard_normal(), size_y * random.standard_normal()
        z, u, v, w, weight = face, beam_sine, 0.0, beam_sign * beam_cosine, entered
        while True:
            # Fly to the next collision. A face on the way either reflects the photon or lets it leave, at random.
            flight = -math.log(1 - random.random()) / sigma_t
            has_left = False
            while True:
                to_face = ((width - z) if w > 0 else -z) / w if w != 0 else math.inf
                if flight < to_face:
                    break
                x, y, flight = x + u * to_face, y + v * to_face, flight - to_face
                z = width if w > 0 else 0.0
                if random.random() >= _reflectance(abs(w), index):
                    has_left = True
                    break
                w = -w
            if has_left:
                break
            x, y, z = x + u * flight, y + v * flight, z + w * flight
            weight *= albedo

            for camera in range(len(views)):
                sine, sign, _, height = views[camera]
                if height < math.inf:
                    _send_to_centre(
                        images[camera], views[camera], (u, v, w), x, y, z, weight, phase, sigma_t, width, index, grid
                    )  # fmt: skip
                    continue
                for odd in range(2 if index > 1 else 1):
                    start = (sign if odd == 0 else -sign) * math.sqrt(1 - sine * sine)
                    node = math.acos(min(1.0, max(-1.0, u * sine + w * start))) * to_node
                    k = min(int(node), len(phase) - 2)
                    density = phase[k] + (node - k) * (phase[k + 1] - phase[k])
                    _send(
                        images[camera], sine, sign, odd, x, y, z, weight * density, sigma_t, width, index, grid
                    )  # fmt: skip

            # Rotate the direction by a random scattering angle and a random azimuth.
            cosine = cosines[int(random.random() * len(cosines))]
            turned, azimuth = math.sqrt(max(0.0, 1 - cosine * cosine)), 2 * math.pi * random.random()
            a, b = turned * math.cos(azimuth), turned * math.sin(azimuth)
            if abs(w) > 0.99999:
                u, v, w = a, b, math.copysign(1.0, w) * cosine
            else:
                flat = math.sqrt(1 - w * w)
                u, v, w = (
                    a * (u * w) / flat - b * v / flat + u * cosine,
                    a * (v * w) / flat + b * u / flat + v * cosine,
                    -a * flat + w * cosine,
                )
            length = math.sqrt(u * u + v * v + w * w)
            u, v, w = u / length, v / length, w / length
            if weight < MIN_WEIGHT:
                if random.random() > 0.1:
                    break
                weight *= 10
