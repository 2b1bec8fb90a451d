"""Displacements of a dentin surface that a blend shape cannot follow, as the modes of a Gaussian process.

The dentin of real teeth differs from the nearest blend shape by smooth bulges and hollows. They are described by a
random displacement along the surface's normals, with a standard deviation of ``ERROR_MM`` and a correlation that falls
with distance and with the angle between the normals, so that the two walls of a thin edge move independently::

    Cov(d(p), d(q)) = s(p) s(q) exp(-|p - q|^2 / 2 l^2) (1 + n(p).n(q)) / 2

Its leading eigenvectors, each times the root of its eigenvalue, are independent modes of one standard deviation each
(Karhunen-Loeve expansion). The Nystroem formula continues them from a part of the vertices to all.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.anatomy.blend import crown_height
from services.anatomy.dentin_shape import DentinShape
from services.anatomy.distance import SignedDistanceGrid
from services.anatomy.frame import ToothFrame
from services.anatomy.templates.dimensions import ToothDimensions
from services.core.geometry import Mesh

Array = NDArray[np.float64]

ERROR_MM = 0.16
"""Standard deviation of the displacement: the distance (rms) of the micro-CT incisor's dentin from its nearest blend
shape; that of phantom incisors is 0.12 to 0.18 mm."""
LENGTH_MM = 2.5
"""Correlation length l: the micro-CT incisor's labial distances keep their sign over the first 5 mm below the edge and
over the next 4, as those of such a process do over about two lengths."""
MODES = 8
"""Number of modes. They hold some 0.78 of a crown's variance and are lengthened to carry all of it."""
FADING_HEIGHT = 0.1
"""Relative height of the crown below which displacements fade towards the cervical line."""
CLEARANCE_MM = 0.06
"""Enamel that a displaced surface leaves, mm."""
CHOSEN_VERTICES = 500
"""Largest number of vertices from which the modes are computed."""
MIN_EIGENVALUE = 1e-6
"""Smallest eigenvalue of a mode, relative to the largest."""


def shape_errors(
    outer: Mesh, dentin: DentinShape, shape: tuple[float, ...], frame: ToothFrame, crown: ToothDimensions
) -> Array:
    """Displacements (K, V, 3) of one standard deviation each, mm, of the dentin's surface at the blend weights
    ``shape``; K is ``MODES`` at most.

    A displacement of either sign leaves ``CLEARANCE_MM`` of enamel.

    Args:
        outer: enamel's outer surface, mm.
        dentin: blend shape of the dentin.
        shape: its blend weights.
        frame: the tooth's canonical frame.
        crown: average dimensions of the tooth's kind, which place the cervical line.
    """
    surface = Mesh(dentin.vertices_mm(shape), dentin.base.faces)
    points, normals = surface.vertices_mm, _vertex_normals(surface)
    size = ERROR_MM * np.clip(crown_height(points @ frame.axes.T, crown) / FADING_HEIGHT, 0.0, 1.0)
    of_crown = np.flatnonzero(size > 0)
    chosen = of_crown[:: max(len(of_crown) // CHOSEN_VERTICES, 1)]

    def covariance(rows: NDArray[np.int_]) -> Array:
        distances = ((points[rows, None] - points[None, chosen]) ** 2).sum(axis=2)
        similar = 0.5 * (1 + normals[rows] @ normals[chosen].T)
        return np.asarray(np.outer(size[rows], size[chosen]) * np.exp(-distances / (2 * LENGTH_MM**2)) * similar)

    values, vectors = np.linalg.eigh(covariance(chosen))
    kept = np.flatnonzero(values > MIN_EIGENVALUE * values[-1])[-MODES:][::-1]
    lengths = np.zeros((len(points), len(kept)))
    lengthened = np.sqrt(values.sum() / values[kept].sum())
    lengths[of_crown] = lengthened * covariance(of_crown) @ vectors[:, kept] / np.sqrt(values[kept])
    room = np.maximum(SignedDistanceGrid(outer).depth_mm(points) - CLEARANCE_MM, 0.0)[:, None]
    return np.asarray(np.clip(lengths, -room, room).T[:, :, None] * normals)


def _vertex_normals(surface: Mesh) -> Array:
    # Outward unit normals (V, 3), means over faces by their areas.
    a, b, c = (surface.vertices_mm[surface.faces[:, k]] for k in range(3))
    of_faces, normals = np.cross(b - a, c - a), np.zeros_like(surface.vertices_mm)
    for corner in range(3):
        np.add.at(normals, surface.faces[:, corner], of_faces)
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30))
