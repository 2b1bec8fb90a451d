"""Dentin as a blend shape made from the enamel's outer surface (teeth 2018 Eq. 5, Fig. 4).

V = B0 + Σ c_m (B_m − B0). The base B0 is the outer surface offset 0.1 mm inward, the largest possible dentin. The modes
thicken the enamel:

* The thickness of enamel grows from zero at the cervical line about with the square root of height (the wall of the
  micro-CT incisor: 1.25 mm √s to within 0.1 mm, with s the height as a fraction of the crown's). The two modes of the
  walls grow in the same way and thicken the enamel to 1.8 mm at the top.
* The buccal mode moves dentin inward along the buccal axis. Where the tooth is thin it moves it at most 0.75 of the way
  to the middle, so that opposite walls never meet.
* The proximal mode makes dentin narrower, most at its sides, so that the surface cannot fold.
* At an edge or a cusp dentin ends lower rather than becoming thinner: the occlusal mode lowers it to 2 mm below the
  edge, and moves lower points by less.

A vertex that a mode would move out of the crown, which is hollow at the back and narrows downwards, is kept at the
base's depth. Every V with 0 <= c <= 1 lies in a box of displacements whose corners are kept inside the enamel.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.anatomy.dentin_shape import DentinShape
from services.anatomy.distance import SignedDistanceGrid
from services.anatomy.frame import ToothFrame
from services.anatomy.isosurface import surface_net
from services.anatomy.templates.dimensions import ToothDimensions
from services.core.errors import MeshError
from services.core.geometry import Mesh

MODES = ("buccal", "proximal", "occlusal")
"""Order of the blend weights c."""
MODE_AXES = (1, 0, 2)
"""Axis of the canonical frame that each mode moves along."""
BASE_DEPTH_MM = 0.1
"""Depth of the base below the enamel's surface, mm."""
FULL_DEPTH_MM = 1.8
"""Depth of the walls' dentin below the surface at full weight and at the height of the edge, mm."""
FULL_DROP_MM = 2.0
"""Distance by which dentin ends below the edge or cusps at full weight, mm."""
CLEARANCE_MM = 0.05
"""Smallest enamel thickness for any c, away from the base's own depth, mm."""
CORNER_DEPTH_MM = 0.075
"""Smallest depth at the corners of each vertex's box, mm: the clearance and half as much again for the faces between
vertices."""
CREASE_MM = 0.03
"""Distance by which a face's middle may come nearer to the enamel's surface than its corners, mm."""
MIDDLE_FRACTION = 0.75
"""Largest fraction of the way to the tooth's middle that the buccal mode moves dentin."""
PROXIMAL_FRACTION = 0.48
"""Largest displacement of the proximal mode, as a fraction of half the width at the same height. Below one half, points
keep their order from the middle outwards."""
STEP_MM = 0.05
"""Step of the walk towards the tooth's middle, mm."""
UNFOLDING_ROUNDS = 12
"""Number of rounds in which the vertices of turned-over faces are moved less; faces that remain turned over are
slivers."""
CORNERS = np.stack(np.meshgrid(*[(0.0, 1.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)[1:]
"""Corners (7, 3) of the box of weights, without that of the base."""
SLICES = 20
"""Number of slices of the tooth's height in which its width is measured."""


def dentin_blend_shape(
    outer: Mesh, frame: ToothFrame | None = None, *, crown: ToothDimensions | None = None, faces: int = 4000
) -> DentinShape:
    """Build a base 0.1 mm below the enamel's surface and three modes that thicken the enamel, in ``outer``'s frame.

    Args:
        outer: watertight enamel surface, mm.
        frame: the tooth's canonical frame; None if ``outer`` is in it.
        crown: average dimensions of the tooth's kind, which place the cervical line; None for a mesh that is all crown.
        faces: approximate number of triangles of the dentin surface.

    Raises:
        MeshError: the mesh cannot bound a medium, or is too thin for any dentin.
    """
    outer.require_solid("of the enamel")
    frame = frame or ToothFrame.identity()
    axes = frame.axes
    grid = SignedDistanceGrid(outer)
    base = _base(outer, grid, faces)
    inward = _unit(_smooth(base, grid.inward(base.vertices_mm), 6))

    height = crown_height(base.vertices_mm @ axes.T, crown)
    buccal = _smooth(base, _free_depth_mm(base.vertices_mm, inward, grid), 6) * np.sqrt(height)
    proximal = _side(base.vertices_mm @ axes.T) * np.sqrt(height)
    drop = (FULL_DROP_MM - BASE_DEPTH_MM) * height**2
    share = np.ones(len(height))
    for attempt in range(40):
        along = (share * buccal * (inward @ axes[1]), -share * proximal, -share * drop)
        moved = [
            _kept_inside(base.vertices_mm + np.outer(length, axes[axis]), grid)
            for length, axis in zip(along, MODE_AXES, strict=True)
        ]
        modes = np.stack(moved) - base.vertices_mm
        short = _shallowest_corner_mm(base.vertices_mm, modes, grid) < CORNER_DEPTH_MM
        if attempt < UNFOLDING_ROUNDS:
            short[np.unique(base.faces[_turned_over(base, modes)])] = True
        if not short.any():
            return DentinShape(base, modes, frame)
        share = _smooth_below(base, np.where(short, 0.8 * share, share))
    raise MeshError(
        "The enamel mesh leaves no room for dentin between its walls; check its scale and that it is one solid tooth."
    )


def _kept_inside(points_mm: NDArray[np.float64], grid: SignedDistanceGrid) -> NDArray[np.float64]:
    for _ in range(4):
        points_mm = points_mm + np.maximum(BASE_DEPTH_MM - grid.depth_mm(points_mm), 0)[:, None] * grid.inward(
            points_mm
        )
    return points_mm


def crown_height(points_mm: NDArray[np.float64], crown: ToothDimensions | None) -> NDArray[np.float64]:
    """Relative height (N,) of points (N, 3) in the canonical frame's axes: 0 at the cervical line, which rises on the
    proximal sides, and on the root, 1 at the edge.
    """
    across, up = points_mm[:, 0], points_mm[:, 2]
    top, bottom = up.max(), np.full(len(up), up.min())
    if crown is not None:
        half = crown.md_cervix_mm / 2
        rise = (crown.curvature_mesial_mm + crown.curvature_distal_mm) / 2
        bottom = top - crown.crown_length_mm + rise * np.clip((across - np.median(across)) / half, -1, 1) ** 2
    return np.asarray(np.clip((up - bottom) / (top - bottom), 0.0, 1.0))


def _side(points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    # Displacement (N,) in mm of points in the canonical frame's axes by the proximal mode. It grows with the square of
    # a point's relative distance from the middle.
    up, middle = points_mm[:, 2], np.median(points_mm[:, 0])
    across = points_mm[:, 0] - middle
    edges = np.linspace(up.min(), up.max(), SLICES + 1)
    slices = np.clip(np.digitize(up, edges) - 1, 0, SLICES - 1)
    half = np.array([np.abs(across[slices == k]).max(initial=0.0) for k in range(SLICES)])
    half_mm = np.maximum(np.interp(up, (edges[1:] + edges[:-1]) / 2, half), 1e-6)
    reach = np.minimum(FULL_DEPTH_MM - BASE_DEPTH_MM, PROXIMAL_FRACTION * half_mm)
    return np.asarray(reach * np.sign(across) * np.minimum(np.abs(across) / half_mm, 1) ** 2)


def _base(outer: Mesh, grid: SignedDistanceGrid, faces: int) -> Mesh:
    # Extract a surface net at the base's depth, which is closed by construction and evenly spaced, unlike the scan's
    # own triangles moved inward.
    corners = outer.vertices_mm[outer.faces]
    area = float(
        np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    )
    pitch = np.sqrt(3 * area / faces)
    for _ in range(4):
        base = surface_net(grid.depth_mm, *grid.bounds_mm, pitch, BASE_DEPTH_MM)
        if len(base.faces) and (base.edge_counts() == 2).all() and base.signed_volume_mm3() > 0:
            break
        pitch *= 0.8
    else:
        raise MeshError(
            "The enamel mesh has no closed surface 0.1 mm below it; check its scale and that it is one solid tooth."
        )

    # Project vertices exactly to the depth, and move the corners of faces that cut through a concave crease deeper.
    vertices = _smooth(base, base.vertices_mm, 2)
    depth = np.full(len(vertices), BASE_DEPTH_MM)
    for _ in range(5):
        nearest, distance, _hit = grid.surface.closest(vertices)
        signed = np.where(grid.depth_mm(vertices) > 0, distance, -distance)
        direction = (vertices - nearest) / np.where(np.abs(signed) > 1e-9, signed, 1e-9)[:, None]
        vertices = vertices + (depth - signed)[:, None] * direction
        shortfall = BASE_DEPTH_MM - CREASE_MM - grid.depth_mm(vertices[base.faces].mean(axis=1))
        np.maximum.at(
            depth, base.faces, np.maximum(depth[base.faces], (BASE_DEPTH_MM + 2 * np.maximum(shortfall, 0))[:, None])
        )
    return Mesh(vertices, base.faces)


def _free_depth_mm(
    start: NDArray[np.float64], inward: NDArray[np.float64], grid: SignedDistanceGrid
) -> NDArray[np.float64]:
    # Distance (N,) that the buccal mode may move each point: walk straight inward while the depth increases; the walk
    # ends at the middle of the tooth.
    full = FULL_DEPTH_MM - BASE_DEPTH_MM
    travelled, rising = np.zeros(len(start)), np.ones(len(start), dtype=bool)
    for step in range(1, int(np.ceil(full / MIDDLE_FRACTION / STEP_MM)) + 1):
        slope = np.einsum("ij,ij->i", grid.inward(start + step * STEP_MM * inward), inward)
        rising &= slope > 0.5
        travelled[rising] = step * STEP_MM
    return np.minimum(full, MIDDLE_FRACTION * travelled)


def _shallowest_corner_mm(
    start: NDArray[np.float64], modes: NDArray[np.float64], grid: SignedDistanceGrid
) -> NDArray[np.float64]:
    # Smallest depth (V,) over each vertex's box. Depth is concave where the surface is convex, so the box's corners
    # bound its inside; the middles of its edges cover the lingual hollow.
    weights = np.stack(np.meshgrid(*[(0.0, 0.5, 1.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)[1:]
    return np.asarray(np.min([grid.depth_mm(start + np.tensordot(c, modes, axes=1)) for c in weights], axis=0))


def _turned_over(base: Mesh, modes: NDArray[np.float64]) -> NDArray[np.bool_]:
    # Faces (F,) that turn over at one of the corners of the box of weights.
    before = _normals(base.vertices_mm, base.faces)
    turned = np.zeros(len(before), dtype=bool)
    for c in CORNERS:
        turned |= (before * _normals(base.vertices_mm + np.tensordot(c, modes, axes=1), base.faces)).sum(axis=1) <= 0
    return turned


def _normals(vertices_mm: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.float64]:
    a, b, c = (vertices_mm[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def _neighbour_mean(mesh: Mesh) -> Any:
    from scipy.sparse import coo_matrix, diags

    edges = mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    count = len(mesh.vertices_mm)
    adjacency = coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count)).tocsr()
    return diags(1 / np.asarray(adjacency.sum(axis=1)).reshape(-1)) @ adjacency


def _smooth(mesh: Mesh, values: NDArray[np.float64], rounds: int) -> NDArray[np.float64]:
    mean = _neighbour_mean(mesh)
    for _ in range(rounds):
        values = 0.5 * values + 0.5 * (mean @ values)
    return values


def _smooth_below(mesh: Mesh, limit: NDArray[np.float64], rounds: int = 15) -> NDArray[np.float64]:
    # Smooth a field so that it never exceeds its limit.
    mean = _neighbour_mean(mesh)
    values = limit
    for _ in range(rounds):
        values = np.minimum(limit, 0.5 * values + 0.5 * (mean @ values))
    return values


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
