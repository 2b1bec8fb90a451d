"""Lips held open by a retractor in front of a virtual jaw, which cast shadows that no scan explains."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Mesh

FloatArray = NDArray[np.float64]
LIP_RADIUS_MM = 5.0
"""Half the thickness of a lip that is pulled outwards, mm."""
BOW_RADIUS_MM = 1.5
"""Half the thickness of a retractor's bow, mm."""
LIP_GAP_MM = 7.0
"""Distance from the front teeth to a lip's inner side, mm: a retractor holds it about half a finger's width away."""
OPENING_MM = (31.0, 19.0)
"""Half width and half height of the opened mouth along the lips' middle, mm, with a retractor of the middle size."""
BOW_AT = 0.78
"""Distance from the middle at which each bow crosses the opening, as a fraction of its half width."""
_AROUND, _ALONG = 16, 96
"""Numbers of vertices around a tube and along the ring of the lips."""


def lips_and_retractor(teeth: Sequence[Mesh]) -> Mesh:
    """Build the ring of both lips and the two bows of a retractor as one surface.

    It lies in the frame of the teeth: y forward, z towards the biting edge, mm.
    """
    vertices = np.concatenate([tooth.vertices_mm for tooth in teeth])
    front = np.sort(vertices[:, 1])[-20:].mean()
    edge = np.quantile(vertices[vertices[:, 1] > front - 4.0, 2], 0.99)
    centre_z = edge - 4.0  # the middle of the front crowns, half their height above the biting edge
    angle = np.linspace(0, 2 * np.pi, _ALONG, endpoint=False)
    x, z = OPENING_MM[0] * np.cos(angle), centre_z + OPENING_MM[1] * np.sin(angle)
    ring = np.stack([x, _lip_y(x, front), z], axis=1)
    parts = [_tube(ring, LIP_RADIUS_MM, closed=True)]
    for side in (-1, 1):
        z = centre_z + np.linspace(-0.75, 0.75, _ALONG // 2) * OPENING_MM[1]
        x = np.full(len(z), side * BOW_AT * OPENING_MM[0])
        parts.append(_tube(np.stack([x, _lip_y(x, front) + LIP_RADIUS_MM, z], axis=1), BOW_RADIUS_MM, closed=False))
    return joined(parts)


def joined(parts: Sequence[Mesh]) -> Mesh:
    """Join several surfaces to one mesh without changing their vertices."""
    offsets = np.cumsum([0, *(len(part.vertices_mm) for part in parts)])
    return Mesh(
        np.concatenate([part.vertices_mm for part in parts]),
        np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=False)]),
    )


def _lip_y(x: FloatArray, front: float) -> FloatArray:
    """Coordinate y (mm) of the lips' middle line, which follows the arch backwards to the corners of the mouth."""
    return front + LIP_GAP_MM + LIP_RADIUS_MM - 14.0 * (x / OPENING_MM[0]) ** 2


def _tube(line: FloatArray, radius_mm: float, *, closed: bool) -> Mesh:
    """Tube of round section about a line (N, 3) whose points lie closer together than its radius of curvature."""
    ahead, behind = (np.roll(line, -1, axis=0), np.roll(line, 1, axis=0)) if closed else (line[1:], line[:-1])
    along = ahead - behind if closed else np.vstack([ahead - behind, (ahead - behind)[-1:]])
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    # Make both axes of each section perpendicular to the line; here the line is never parallel to the forward axis.
    forward = np.array([0.0, 1.0, 0.0]) - along[:, 1:2] * along
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    sideways = np.cross(along, forward)
    angle = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)[:, None, None]
    points = line + radius_mm * (np.cos(angle) * forward + np.sin(angle) * sideways)  # (around, along, 3)
    number = np.arange(points.shape[0] * points.shape[1]).reshape(points.shape[:2])
    a, b = (number, np.roll(number, -1, axis=1)) if closed else (number[:, :-1], number[:, 1:])
    c, d = (np.roll(part, -1, axis=0) for part in (a, b))
    faces = np.concatenate([np.stack([a, c, b], axis=-1).reshape(-1, 3), np.stack([b, c, d], axis=-1).reshape(-1, 3)])
    return Mesh(points.reshape(-1, 3), faces)
