"""Dentin as a blend shape made from the enamel's outer surface (teeth 2018 Eq. 5, Fig. 4).

V = B0 + Σ c_m (B_m − B0). B0 is the outer surface offset 0.1 mm inward, the most dentin there can be; B_m − B0 is the part along axis m of the
displacement that leads to the surface offset 1.5 mm inward. Where the tooth is thinner than that, the displacement ends at 0.6 of the way to the
middle, so that opposite walls never meet. Each V with 0 <= c <= 1 lies in a box whose corners are kept inside the enamel.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.errors import MeshError
from services.core.geometry import Mesh
from services.fit.anatomy.distance import SignedDistanceGrid, SurfaceDistance
from services.fit.anatomy.frame import ToothFrame
from services.fit.anatomy.isosurface import surface_net
from services.fit.transport.recipe import DentinShape

MODES = ("buccal", "proximal", "occlusal")
"""Order of the blend weights c."""
MODE_AXES = (1, 0, 2)
"""Axis of the canonical frame that each mode moves along."""
BASE_DEPTH_MM = 0.1
FULL_DEPTH_MM = 1.5
CLEARANCE_MM = 0.05
"""Enamel that is left everywhere for any c, away from the base's own depth."""
CORNER_DEPTH_MM = 0.075
"""Depth asked of each vertex's box at its corners: the clearance and half as much again for faces between vertices."""
CREASE_MM = 0.03
"""How much nearer to the enamel's surface a face's middle may come than its corners."""
MIDDLE_FRACTION = 0.6
STEP_MM = 0.05


def dentin_blend_shape(outer: Mesh, frame: ToothFrame | None = None, *, faces: int = 4000) -> DentinShape:
    """Base 0.1 mm below the enamel's surface and three modes towards 1.5 mm depth, in the coordinates of ``outer``.

    Args:
        outer: watertight enamel surface, mm.
        frame: the tooth's canonical frame; None when ``outer`` is in it.
        faces: about so many triangles for the dentin surface, whatever the enamel has.

    Raises:
        MeshError: the mesh cannot bound a medium, or is too thin for any dentin.
    """
    outer.require_solid("of the enamel")
    axes = (frame or ToothFrame.identity()).axes
    grid, surface = SignedDistanceGrid(outer), SurfaceDistance(outer)
    base = _base(outer, grid, surface, faces)
    inward = _unit(_smooth(base, grid.inward(base.vertices_mm), 6))

    reach = _smooth_below(base, _room_mm(base.vertices_mm, inward, grid))
    for _ in range(40):
        modes = np.stack([np.outer(reach * (inward @ axes[axis]), np.ones(3)) * axes[axis] for axis in MODE_AXES])
        short = _shallowest_corner_mm(base.vertices_mm, modes, grid) < CORNER_DEPTH_MM
        if not short.any():
            return DentinShape(base, modes)
        reach = _smooth_below(base, np.where(short, 0.8 * reach, reach))
    raise MeshError("The enamel mesh leaves no room for dentin between its walls; check its scale and that it is one solid tooth.")


def _base(outer: Mesh, grid: SignedDistanceGrid, surface: SurfaceDistance, faces: int) -> Mesh:
    # A surface net at the base's depth: closed by construction and evenly spaced, unlike the scan's own triangles moved inward.
    corners = outer.vertices_mm[outer.faces]
    area = float(np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2)
    pitch = np.sqrt(3 * area / faces)
    for _ in range(4):
        base = surface_net(grid.depth_mm, *grid.bounds_mm, pitch, BASE_DEPTH_MM)
        if len(base.faces) and (base.edge_counts() == 2).all() and base.signed_volume_mm3() > 0:
            break
        pitch *= 0.8
    else:
        raise MeshError("The enamel mesh has no closed surface 0.1 mm below it; check its scale and that it is one solid tooth.")

    # Exact projection to the depth; faces that cut through a concave crease of the enamel take their corners deeper.
    vertices = _smooth(base, base.vertices_mm, 2)
    depth = np.full(len(vertices), BASE_DEPTH_MM)
    for _ in range(5):
        nearest, distance, _hit = surface.closest(vertices)
        signed = np.where(grid.depth_mm(vertices) > 0, distance, -distance)
        direction = (vertices - nearest) / np.where(np.abs(signed) > 1e-9, signed, 1e-9)[:, None]
        vertices = vertices + (depth - signed)[:, None] * direction
        shortfall = BASE_DEPTH_MM - CREASE_MM - grid.depth_mm(vertices[base.faces].mean(axis=1))
        np.maximum.at(depth, base.faces, np.maximum(depth[base.faces], (BASE_DEPTH_MM + 2 * np.maximum(shortfall, 0))[:, None]))
    return Mesh(vertices, base.faces)


def _room_mm(start: NDArray[np.float64], inward: NDArray[np.float64], grid: SignedDistanceGrid) -> NDArray[np.float64]:
    # Walk straight inward while depth still rises; the walk ends at the middle of the tooth.
    full = FULL_DEPTH_MM - BASE_DEPTH_MM
    travelled, rising = np.zeros(len(start)), np.ones(len(start), dtype=bool)
    for step in range(1, int(np.ceil(full / MIDDLE_FRACTION / STEP_MM)) + 1):
        slope = np.einsum("ij,ij->i", grid.inward(start + step * STEP_MM * inward), inward)
        rising &= slope > 0.5
        travelled[rising] = step * STEP_MM
    return np.minimum(full, MIDDLE_FRACTION * travelled)


def _shallowest_corner_mm(start: NDArray[np.float64], modes: NDArray[np.float64], grid: SignedDistanceGrid) -> NDArray[np.float64]:
    # Depth is concave where the surface is convex, so a box's corners bound its inside; the edges' middles guard the lingual hollow.
    weights = np.stack(np.meshgrid(*[(0.0, 0.5, 1.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)[1:]
    return np.min([grid.depth_mm(start + np.tensordot(c, modes, axes=1)) for c in weights], axis=0)


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
    # A smooth field that never exceeds its limit.
    mean = _neighbour_mean(mesh)
    values = limit
    for _ in range(rounds):
        values = np.minimum(limit, 0.5 * values + 0.5 * (mean @ values))
    return values


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
