"""The walk of one light: orders two and up, with the scores of all knots, compiled by Numba.

A path follows the beam; each of its vertices from the second on is connected to every camera through the flat face. The
derivative of a contribution with respect to ln f_n is the contribution times (sum over its scatterings of the share of
knot n in f(theta)) minus f_n Omega_n times its path length, by Eq. 18 of Gkioulekas et al. (2013) as ``optics.md``
corrects it: so each image carries a row of KNOTS sums of shares, and one sum of path lengths.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from services.slab.cell.dictionary import KNOTS, SPACING_RAD
from services.slab.cell.kernel_tables import GUIDE
from services.slab.cell.perspective import perspective_view
from services.slab.cell.streams import path_state, uniform

MAX_SCATTERS = 8192
"""Number of scatterings at which a path ends; the weight that it still carries is reported."""
FIRST_ROULETTE = 0.1
"""Share of the beam below which a path's weight is doubled with probability one half, or the path ends."""
SPARSE_SCATTERS = 48
"""Largest number of scatterings whose shares are added one by one; beyond, adding all knots at once is as fast."""
REFLECTED_SHARE = 0.125
"""Probability that a vertex is also connected by way of one more reflection; such connections carry some 2 % of the
light."""
LATE_ORDER = 8
"""Scattering order from which only a share of the vertices is connected where the cell is thick."""


@njit(cache=True, inline="always")
def reflectance(cosine, eta):  # type: ignore[no-untyped-def]  # compiled
    """Unpolarised Fresnel reflectance, eta = n_beyond / n_before."""
    q2 = (eta - 1) * (eta + 1) + cosine * cosine
    if q2 <= 0:
        return 1.0
    q = math.sqrt(q2)
    s = (cosine - q) / (cosine + q)
    p = (eta * eta * cosine - q) / (eta * eta * cosine + q)
    return 0.5 * (s * s + p * p)


@njit(cache=True, inline="always")
def face_reflectance(cosine, glass):  # type: ignore[no-untyped-def]  # compiled
    """Reflectance of a face with or without glass, to and fro in the glass included; ``glass`` as in
    ``sample_face``.
    """
    outside, wall, _ = glass
    if wall == 0:
        return reflectance(cosine, outside)
    near = reflectance(cosine, wall)
    inner2 = 1 - (1 - cosine * cosine) / (wall * wall)
    far = reflectance(math.sqrt(inner2), outside / wall) if inner2 > 0 else 1.0
    return near + (1 - near) ** 2 * far / (1 - near * far)


@njit(cache=True, nogil=True)
def sample_face(cosine, glass, state):  # type: ignore[no-untyped-def]  # compiled
    """Whether light comes back from a face, its displacement in the glass in units of its lateral direction, and the
    next random state.

    glass: (n_outside / n, n_glass / n or 0, thickness).
    """
    outside, wall, thickness = glass
    u, state = uniform(state)
    if wall == 0:
        return u < reflectance(cosine, outside), 0.0, state
    near = reflectance(cosine, wall)
    if u < near:
        return True, 0.0, state
    sine = math.sqrt(max(1 - cosine * cosine, 0.0)) / wall
    inner = math.sqrt(max(1 - sine * sine, 1e-12))
    far = reflectance(inner, outside / wall)
    # Displacement per unit of lateral direction in the medium: t tan(a_glass) / sin(a).
    pass_shift = thickness / (wall * inner)
    shift = 0.0
    while True:
        shift += pass_shift
        u, state = uniform(state)
        if u >= far:
            return False, shift, state
        shift += pass_shift
        u, state = uniform(state)
        if u >= near:
            return True, shift, state


@njit(cache=True, nogil=True)
def sample_reflected_shift(cosine, glass, state):  # type: ignore[no-untyped-def]  # compiled
    """Displacement in the glass of light that comes back, in units of its lateral direction, and the next random
    state.
    """
    while True:
        back, shift, state = sample_face(cosine, glass, state)
        if back:
            return shift, state


@njit(cache=True, inline="always")
def draw_cosine(u, v, cumulative, cosines, guide):  # type: ignore[no-untyped-def]  # compiled
    """A scattering cosine, and the cell that it lies in."""
    cell = guide[int(u * GUIDE)]
    while cumulative[cell] < u:
        cell += 1
    return cosines[cell] + v * (cosines[cell + 1] - cosines[cell]), cell


@njit(cache=True, inline="always")
def interpolate_f(cosine, scattering):  # type: ignore[no-untyped-def]  # compiled
    """f(theta), the knot below theta, and the shares of both knots in f."""
    place = math.acos(min(max(cosine, -1.0), 1.0)) / SPACING_RAD
    knot = min(int(place), KNOTS - 2)
    upper = (place - knot) * scattering[knot + 1]
    lower = (knot + 1 - place) * scattering[knot]
    value = lower + upper
    return value, knot, lower / value, upper / value


@njit(cache=True, inline="always")
def rotated(x, y, z, cosine, azimuth):  # type: ignore[no-untyped-def]  # compiled
    """A direction turned by a scattering angle, renormalised (Duff et al. 2017 for the frame)."""
    sine = math.sqrt(max(1 - cosine * cosine, 0.0))
    a, b = sine * math.cos(azimuth), sine * math.sin(azimuth)
    sign = 1.0 if z >= 0 else -1.0
    k = -1.0 / (sign + z)
    xy = x * y * k
    nx = cosine * x + a * (1 + sign * x * x * k) + b * xy
    ny = cosine * y + a * sign * xy + b * (sign + y * y * k)
    nz = cosine * z - a * sign * x - b * y
    scale = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz)
    return nx * scale, ny * scale, nz * scale


@njit(cache=True, inline="always")
def beam_offset(beam, state):  # type: ignore[no-untyped-def]  # compiled
    """A random point of the beam's cross-section; beam: (is a disc, size along x, along y)."""
    u, state = uniform(state)
    v, state = uniform(state)
    radius = math.sqrt(u) if beam[0] else math.sqrt(-2 * math.log(u))
    return radius * math.cos(2 * math.pi * v) * beam[1], radius * math.sin(2 * math.pi * v) * beam[2], state


@njit(cache=True, nogil=True)
def trace(  # type: ignore[no-untyped-def]  # compiled
    key,
    paths,
    medium,
    width,
    late_share,
    glass,
    light,
    beam,
    far,
    sines,
    scales,
    shifts,
    mirrors,
    distances,
    grid,
    scores,
    images,
    rows,
    totals,
):
    """Add ``paths`` paths to images (C, P), rows (C, P, KNOTS + 1) and totals (light out of the front, the back, cut
    off).

    light: (sine, transmittance, shift, total reflectance along the beam). mirrors: reflectance of a face along each
    camera. distances: of centres of projection, infinite for orthographic cameras. grid: (x from, y from, pitch x,
    pitch y, columns, rows, folded). Without ``scores`` rows stay as they are.
    """
    scattering, sigma_t, albedo, cumulative, cosines, densities, guide = medium
    x_from, y_from, pitch_x, pitch_y, columns, row_count, folded = grid
    knots = np.empty(MAX_SCATTERS, np.int64)
    lowers = np.empty(MAX_SCATTERS)
    uppers = np.empty(MAX_SCATTERS)
    dense = np.zeros(KNOTS)
    beam_cosine = math.sqrt(1 - light[0] ** 2)
    crossing = width / beam_cosine
    collided = -math.expm1(-sigma_t * crossing)
    repeat = light[3] * (1 - collided)

    for path in range(paths):
        state = path_state(key, path)
        # The first scattering is forced: the beam's passes between the faces form a geometric series that is sampled
        # exactly.
        weight = light[1] * albedo * collided / (1 - repeat)
        x, y, path_length = light[2], 0.0, 0.0
        dx, dy, dz = light[0], 0.0, beam_cosine
        u, state = uniform(state)
        while u < repeat:
            u /= repeat
            path_length += crossing
            x += dx * crossing
            if glass[1] > 0:
                shift, state = sample_reflected_shift(beam_cosine, glass, state)
                x += dx * shift
            dz = -dz
        u, state = uniform(state)
        step = -math.log1p(-u * collided) / sigma_t
        path_length += step
        x += dx * step
        z = dz * step if dz > 0 else width + dz * step

        scatters = 0
        alive = True
        while alive:
            # Scatter by the phase function; the weight corrects for the uniform density within a cell.
            u, state = uniform(state)
            v, state = uniform(state)
            cosine, cell = draw_cosine(u, v, cumulative, cosines, guide)
            value, knot, lower, upper = interpolate_f(cosine, scattering)
            weight *= value / densities[cell]
            knots[scatters], lowers[scatters], uppers[scatters] = knot, lower, upper
            dense[knot] += lower
            dense[knot + 1] += upper
            scatters += 1
            u, state = uniform(state)
            dx, dy, dz = rotated(dx, dy, dz, cosine, 2 * math.pi * u)

            # Fly to the next scattering, or out.
            u, state = uniform(state)
            step = -math.log(u) / sigma_t
            while True:
                edge = width if dz > 0 else 0.0
                reach = (edge - z) / dz if dz != 0 else math.inf
                if step < reach:
                    break
                step -= reach
                path_length += reach
                back, shift, state = sample_face(abs(dz), glass, state)
                x += dx * (reach + shift)
                y += dy * (reach + shift)
                z = edge
                if not back:
                    totals[1 if dz > 0 else 0] += weight
                    alive = False
                    break
                dz = -dz
            if not alive:
                break
            path_length += step
            x += dx * step
            y += dy * step
            z += dz * step
            weight *= albedo

            # Connect this vertex with all cameras, directly and by way of a geometric number of reflections.
            share = 1.0
            if scatters + 1 >= LATE_ORDER and late_share < 1:
                u, state = uniform(state)
                share = 1 / late_share if u < late_share else 0.0
            if share > 0:
                offset_x, offset_y, state = beam_offset(beam, state)
                reflections = 0
                while True:
                    for camera in range(len(far)):
                        lateral = sines[camera]
                        out = math.sqrt(1 - lateral * lateral)
                        towards_far = far[camera] != (reflections % 2 == 1)
                        deep = (width - z if towards_far else z) + reflections * width
                        onward = dz if towards_far else -dz
                        shift, in_glass = shifts[camera], 0.0
                        for _ in range(reflections):
                            if glass[1] > 0:
                                more, state = sample_reflected_shift(out, glass, state)
                                shift += lateral * more
                                in_glass += more
                        scale, mirror = scales[camera], mirrors[camera]
                        if distances[camera] == math.inf:
                            flight = deep / out
                            toward_camera = dx * lateral + onward * out
                            exit_x = x + lateral * flight + shift + offset_x
                            exit_y = y + offset_y
                        else:
                            to_x, to_y, own_out, exit_x, exit_y, share_of_parallel = perspective_view(
                                x + offset_x, y + offset_y, deep, in_glass, lateral, distances[camera], glass
                            )
                            flight = deep / own_out
                            toward_camera = dx * to_x + dy * to_y + onward * own_out
                            passed = 1 - face_reflectance(own_out, glass)
                            scale *= share_of_parallel * passed / (1 - mirror) * out / own_out
                            mirror = 1 - passed
                        value, knot, lower, upper = interpolate_f(toward_camera, scattering)
                        amount = share * weight * value / (sigma_t * albedo) * math.exp(-sigma_t * flight) * scale
                        if reflections > 0:
                            amount *= (mirror / REFLECTED_SHARE) ** reflections
                        px = (exit_x - x_from) / pitch_x
                        py = ((abs(exit_y) if folded else exit_y) - y_from) / pitch_y
                        if px < 0 or py < 0 or px >= columns or py >= row_count:
                            continue
                        pixel = int(py) * columns + int(px)
                        images[camera, pixel] += amount
                        if not scores:
                            continue
                        row = rows[camera, pixel]
                        row[knot] += amount * lower
                        row[knot + 1] += amount * upper
                        row[KNOTS] += amount * (path_length + flight)
                        if scatters <= SPARSE_SCATTERS:
                            for j in range(scatters):
                                row[knots[j]] += amount * lowers[j]
                                row[knots[j] + 1] += amount * uppers[j]
                        else:
                            for j in range(KNOTS):
                                row[j] += amount * dense[j]
                    u, state = uniform(state)
                    if light[3] == 0 or u >= REFLECTED_SHARE:
                        break
                    reflections += 1

            # End paths that are faint by roulette, and those that are too long.
            if weight < FIRST_ROULETTE:
                u, state = uniform(state)
                if u < 0.5:
                    alive = False
                weight *= 2
            if scatters == MAX_SCATTERS:
                totals[2] += weight
                alive = False
        for j in range(scatters):
            dense[knots[j]] = 0.0
            dense[knots[j] + 1] = 0.0
