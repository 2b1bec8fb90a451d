"""Directions of a perspective camera: through which point of the face, and how strongly, it sees a point of the medium.

The centre of projection lies in the plane y = 0. By Fermat's principle there is one way from a point through the flat
layers to the centre; its exit point is found by iteration, in which the error falls by the ratio of depth and distance.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

ITERATIONS = 4
"""Number of iterations; at a distance of twenty depths the exit point is then right to 1e-5 of the depth."""


@njit(cache=True, inline="always")
def leaving_direction(x, y, sine, distance, outside):  # type: ignore[no-untyped-def]  # compiled
    """Direction in the medium (x, y; z follows) of light that leaves the face at x, y towards the camera, and the
    cosine outside; x and y may be arrays.

    sine: lateral direction in the medium of light that leaves at x = y = 0. outside: n_outside / n.
    """
    central = sine / outside
    height = distance * math.sqrt(1 - central * central)
    to_x = distance * central - x
    away = np.sqrt(to_x * to_x + y * y + height * height)
    return outside * to_x / away, -outside * y / away, height / away


@njit(cache=True, inline="always")
def glass_shift(sine2, glass):  # type: ignore[no-untyped-def]  # compiled
    """Displacement on one way through the glass, in units of the lateral direction in the medium.

    glass: (n_outside / n, n_glass / n or 0, thickness).
    """
    _, wall, thickness = glass
    return thickness / (wall * math.sqrt(1 - sine2 / (wall * wall))) if wall > 0 else 0.0


@njit(cache=True, inline="always")
def perspective_view(x, y, deep, shift, sine, distance, glass):  # type: ignore[no-untyped-def]  # compiled
    """Direction in the medium (x, y, z) in which light from a point flies to the camera, its exit point, and the
    radiance there in units of that towards an orthographic camera of the same direction.

    deep: way along z, all passes together. shift: displacement by reflections in the glass, in units of the lateral
    direction. sine, distance: as in ``leaving_direction``.
    """
    outside = glass[0]
    lateral_x, lateral_y, out = sine, 0.0, math.sqrt(1 - sine * sine)
    exit_x, exit_y, cosine, passes = x, y, 1.0, 0.0
    for _ in range(ITERATIONS):
        sine2 = lateral_x * lateral_x + lateral_y * lateral_y
        out = math.sqrt(1 - sine2)
        passes = shift + glass_shift(sine2, glass)
        exit_x = x + lateral_x * (deep / out + passes)
        exit_y = y + lateral_y * (deep / out + passes)
        lateral_x, lateral_y, cosine = leaving_direction(exit_x, exit_y, sine, distance, outside)
    sine2 = lateral_x * lateral_x + lateral_y * lateral_y
    out = math.sqrt(1 - sine2)

    # The radiance is the irradiance of the camera's centre per solid angle of the face: it falls by how much farther
    # than from the face light spreads, across the plane of the flight and in it.
    height = distance * math.sqrt(1 - (sine / outside) ** 2)
    across = (deep / out + passes) * outside * cosine / height
    bend = 1 - sine2 / (glass[1] * glass[1]) if glass[1] > 0 else 1.0
    along = (deep / out**3 + passes / bend) * outside * cosine**3 / height
    return lateral_x, lateral_y, out, exit_x, exit_y, 1 / ((1 + across) * (1 + along))
