"""Gums of a scanned jaw: the gingiva's own triangles, a membrane in place of each crown, and a base that encloses the
roots.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.anatomy.scans.patches import boundary_loops, harmonic_rows, ring_faces
from services.core.errors import MeshError
from services.core.geometry import Mesh

COVER_MM = 1.5
"""Depth of the gums below the deepest root and below the scan's rim, mm."""
ROW_MM = 0.8
"""Distance between rows of vertices from the rim to the base, mm."""
RIM_ROUNDS = 200
"""Number of rounds of smoothing that turn the rim's outline into that of the base."""


def gums_solid(surface: Mesh, gingiva: NDArray[np.bool_], occlusal: NDArray[np.float64], deepest_mm: float) -> Mesh:
    """Build a watertight solid of the gums, which on the gingiva is the scan itself.

    The crowns' triangles are kept, but shrink to a membrane across each cervical line: every vertex off the gingiva
    moves to the mean of its neighbours. The scan's rim is extended away from the teeth to a flat base. Teeth stand in
    the solid and overlap it.

    Args:
        surface: the scan, manifold, with one boundary loop.
        gingiva: faces (F,) of the gingiva.
        occlusal: unit vector (3,).
        deepest_mm: coordinate of the deepest root along ``occlusal``.

    Raises:
        MeshError: there is not exactly one rim, or its outline crosses itself.
    """
    loops = boundary_loops(surface.faces)
    if len(loops) != 1:
        raise MeshError(f"The scan has {len(loops)} open rims; give one open surface of the jaw, its holes filled.")
    vertices = _membrane(surface, gingiva)
    loop = loops[0]
    height = vertices @ occlusal
    base = min(deepest_mm, float(height.min())) - COVER_MM

    # Make rows from the rim to the base, whose outline is that of the rim without its steps.
    rim = vertices[loop] - np.outer(height[loop], occlusal)
    outline = rim
    for _ in range(RIM_ROUNDS):
        outline = outline / 2 + (np.roll(outline, 1, axis=0) + np.roll(outline, -1, axis=0)) / 4
    steps = max(2, int(np.ceil((height[loop].mean() - base) / ROW_MM)))
    wall = harmonic_rows(vertices[loop], outline + base * occlusal, steps)
    ring = np.concatenate([loop[None], len(vertices) + np.arange(steps * len(loop)).reshape(steps, -1)])
    everything = np.concatenate([vertices, wall.reshape(-1, 3)])

    across = np.linalg.svd(occlusal[None])[2][1:]
    across[1] = np.cross(occlusal, across[0])
    lid = ring[-1][fill_outline(outline @ across.T)][:, ::-1]
    solid = Mesh(everything, np.concatenate([surface.faces, ring_faces(ring, everything), lid]).astype(np.int32))
    solid.require_solid("of the gums, closed by a base,", (2.0, 200.0))
    return solid


def fill_outline(outline: NDArray[np.float64]) -> NDArray[np.int64]:
    """Delaunay triangles (N - 2, 3), counter-clockwise, inside a closed outline (N, 2).

    The vertices must be dense in comparison with the outline's bends and its width.

    Raises:
        MeshError: the outline crosses itself, or its vertices are not dense enough.
    """
    from scipy.spatial import Delaunay

    triangles: NDArray[np.int64] = np.asarray(Delaunay(outline).simplices, dtype=np.int64)
    a, b, c = (outline[triangles[:, k]] for k in range(3))
    turned = (b - a)[:, 0] * (c - a)[:, 1] < (b - a)[:, 1] * (c - a)[:, 0]
    triangles = np.where(turned[:, None], triangles[:, ::-1], triangles)

    # Keep triangles inside the outline, from whose middles a ray towards +x crosses it an odd number of times.
    (x, y), start, end = ((a + b + c) / 3).T, outline, np.roll(outline, -1, axis=0)
    spans = (start[:, 1] > y[:, None]) != (end[:, 1] > y[:, None])
    rise = np.where(start[:, 1] == end[:, 1], 1.0, end[:, 1] - start[:, 1])
    crossing = start[:, 0] + (y[:, None] - start[:, 1]) / rise * (end[:, 0] - start[:, 0])
    triangles = triangles[np.count_nonzero(spans & (crossing > x[:, None]), axis=1) % 2 == 1]
    if len(triangles) != len(outline) - 2:
        raise MeshError(
            "The scan's rim crosses itself when seen along the teeth; trim the scan's border and export it again."
        )
    return triangles


def _membrane(surface: Mesh, gingiva: NDArray[np.bool_]) -> NDArray[np.float64]:
    # Vertices (V, 3) of the harmonic map with uniform weights: each free vertex lies at the mean of its neighbours.
    from scipy.sparse import coo_matrix, diags
    from scipy.sparse.linalg import spsolve

    count = len(surface.vertices_mm)
    edges = np.unique(np.sort(surface.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    start, end = np.concatenate([edges, edges[:, ::-1]]).T
    adjacency = coo_matrix((np.ones(len(start)), (start, end)), shape=(count, count)).tocsr()
    matrix = (diags(np.asarray(adjacency.sum(axis=1)).reshape(-1)) - adjacency).tocsr()
    free = np.ones(count, dtype=bool)
    free[surface.faces[gingiva]] = False
    vertices = surface.vertices_mm.copy()
    vertices[free] = spsolve(matrix[free][:, free].tocsc(), -matrix[free][:, ~free] @ vertices[~free])
    return vertices
