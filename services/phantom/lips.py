"""Lips held open by a retractor, which stand before a virtual jaw: what throws shadows on it that no scan explains."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Mesh

FloatArray = NDArray[np.float64]
LIP_RADIUS_MM = 5.0
"""Half the thickness of a lip that is pulled outwards."""
BOW_RADIUS_MM = 1.5
"""Half the thickness of a retractor's bow."""
LIP_GAP_MM = 7.0
"""From the front teeth to a lip's inner side: a retractor holds it about a finger's half width away."""
OPENING_MM = (31.0, 19.0)
"""Half width and half height of the opened mouth along the lips' middle, as a retractor of the middle size holds it."""
BOW_AT = 0.78
"""Where the two bows cross the opening, as a fraction of its half width."""
_AROUND, _ALONG = 16, 96


def lips_and_retractor(teeth: Sequence[Mesh]) -> Mesh:
    """One surface (V, 3), mm: the ring of both lips and the two bows of a retractor, in the teeth's frame (y forward, z
    towards the biting edge).
    """
    vertices = np.concatenate([tooth.vertices_mm for tooth in teeth])
    front = np.sort(vertices[:, 1])[-20:].mean()
    edge = np.quantile(vertices[vertices[:, 1] > front - 4.0, 2], 0.99)
    centre_z = edge - 4.0  # the middle of the front crowns, half their height above the biting edge
    turn = np.linspace(0, 2 * np.pi, _ALONG, endpoint=False)
    x, z = OPENING_MM[0] * np.cos(turn), centre_z + OPENING_MM[1] * np.sin(turn)
    ring = np.stack([x, _lip_y(x, front), z], axis=1)
    parts = [_tube(ring, LIP_RADIUS_MM, closed=True)]
    for side in (-1, 1):
        z = centre_z + np.linspace(-0.75, 0.75, _ALONG // 2) * OPENING_MM[1]
        x = np.full(len(z), side * BOW_AT * OPENING_MM[0])
        parts.append(_tube(np.stack([x, _lip_y(x, front) + LIP_RADIUS_MM, z], axis=1), BOW_RADIUS_MM, closed=False))
    return joined(parts)


def joined(parts: Sequence[Mesh]) -> Mesh:
    """Several surfaces as one."""
    offsets = np.cumsum([0, *(len(part.vertices_mm) for part in parts)])
    return Mesh(
        np.concatenate([part.vertices_mm for part in parts]),
        np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=False)]),
    )


def _lip_y(x: FloatArray, front: float) -> FloatArray:
    """How far in front the lips' middle lies (mm): they follow the arch backwards towards the corners of the mouth."""
    return front + LIP_GAP_MM + LIP_RADIUS_MM - 14.0 * (x / OPENING_MM[0]) ** 2


def _tube(line: FloatArray, radius_mm: float, *, closed: bool) -> Mesh:
    """A tube of round section about a line (N, 3) in which neighbours lie closer than its bends."""
    ahead, behind = (np.roll(line, -1, axis=0), np.roll(line, 1, axis=0)) if closed else (line[1:], line[:-1])
    along = ahead - behind if closed else np.vstack([ahead - behind, (ahead - behind)[-1:]])
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    # Both axes of each section are at right angles to the line; the forward axis is never along it here.
    forward = np.array([0.0, 1.0, 0.0]) - along[:, 1:2] * along
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    sideways = np.cross(along, forward)
    turn = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)[:, None, None]
    points = line + radius_mm * (np.cos(turn) * forward + np.sin(turn) * sideways)  # (around, along, 3)
    number = np.arange(points.shape[0] * points.shape[1]).reshape(points.shape[:2])
    a, b = (number, np.roll(number, -1, axis=1)) if closed else (number[:, :-1], number[:, 1:])
    c, d = (np.roll(part, -1, axis=0) for part in (a, b))
    faces = np.concatenate([np.stack([a, c, b], axis=-1).reshape(-1, 3), np.stack([b, c, d], axis=-1).reshape(-1, 3)])
    return Mesh(points.reshape(-1, 3), faces)
