"""Operations on parts of a triangle surface: neighbours, connected pieces, boundary loops, repair to a manifold."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Mesh

Faces = NDArray[np.int32]
TINY_MM2 = 1e-30
"""Area added to areas that are weights, so that a part with only degenerate triangles still has a middle."""


def neighbours(faces: Faces) -> NDArray[np.int64]:
    """Neighbouring face (F, 3) across each edge from corner k to corner k + 1; -1 at a boundary.

    Each edge must have at most two faces.
    """
    count = int(faces.max()) + 1
    start, end = faces.astype(np.int64).reshape(-1), np.roll(faces, -1, axis=1).astype(np.int64).reshape(-1)
    key, twin = start * count + end, end * count + start
    # Keys that are looked up in their order are found soonest.
    order, asked = np.argsort(key), np.argsort(twin)
    found = np.empty_like(order)
    found[asked] = np.minimum(np.searchsorted(key[order], twin[asked]), len(key) - 1)
    return np.where(key[order][found] == twin, order[found] // 3, -1).reshape(-1, 3)


def pieces(faces: Faces) -> NDArray[np.int64]:
    """Number (F,) of the connected piece of each face; faces that share only a vertex are not connected."""
    across = neighbours(faces)
    return _components(np.repeat(np.arange(len(faces)), 3)[across.reshape(-1) >= 0], across[across >= 0], len(faces))


def touching_pieces(faces: Faces) -> NDArray[np.int64]:
    """Number (F,) of the piece of each face, where a common vertex connects and edges may have any number of faces."""
    vertices = np.unique(faces, return_inverse=True)[1].reshape(-1, 3)
    number = _components(vertices.reshape(-1), np.roll(vertices, 1, axis=1).reshape(-1), int(vertices.max()) + 1)
    return np.unique(number[vertices[:, 0]], return_inverse=True)[1]


def areas_mm2(mesh: Mesh) -> NDArray[np.float64]:
    """Area (F,) of each face."""
    return np.asarray(np.linalg.norm(_crosses(mesh), axis=1) / 2)


def vector_area_mm2(mesh: Mesh) -> NDArray[np.float64]:
    """Vector area (3,): sum of the faces' normals times their areas, which depends only on the boundary loop."""
    return np.asarray(_crosses(mesh).sum(axis=0) / 2)


def middle_mm(mesh: Mesh) -> NDArray[np.float64]:
    """Centroid (3,) of a surface, weighted by area."""
    return np.asarray(np.average(mesh.vertices_mm[mesh.faces].mean(axis=1), axis=0, weights=areas_mm2(mesh) + TINY_MM2))


def manifold_piece(mesh: Mesh) -> NDArray[np.bool_]:
    """Mask (F,) of the faces of the largest manifold piece: no edge has three faces, no vertex alone connects parts."""
    area = areas_mm2(mesh)
    kept = (area > 0) & _first_of_equals(mesh.faces)
    while True:
        before = np.count_nonzero(kept)
        index = np.flatnonzero(kept)
        index = index[_simple_edges(mesh.faces[index])]
        index = index[_largest_fans(mesh.faces[index])]
        index = index[_largest(pieces(mesh.faces[index]), area[index])]
        kept = np.zeros(len(mesh.faces), dtype=bool)
        kept[index] = True
        if len(index) == before:
            return kept


def boundary_loops(faces: Faces) -> list[NDArray[np.int64]]:
    """Vertices of each boundary loop of a manifold piece, in the direction of its faces' edges.

    The loop with the most vertices comes first.
    """
    open_edge = (neighbours(faces) < 0).reshape(-1)
    following = dict(
        zip(
            faces.reshape(-1)[open_edge].tolist(),
            np.roll(faces, -1, axis=1).reshape(-1)[open_edge].tolist(),
            strict=True,
        )
    )
    loops = []
    while following:
        first, vertex = following.popitem()
        loop = [first]
        while vertex != first:
            loop.append(vertex)
            vertex = following.pop(vertex)
        loops.append(np.array(loop))
    return sorted(loops, key=len, reverse=True)


def fill_holes(mesh: Mesh) -> tuple[Mesh, NDArray[np.int64]]:
    """Close every boundary loop but the one with the most vertices by a fan about its middle.

    Returns:
        The mesh, and for each new face the old face (N,) across its outer edge.
    """
    across, owner = neighbours(mesh.faces), {}
    for face, corner in np.argwhere(across < 0):
        owner[int(mesh.faces[face, corner])] = int(face)
    vertices, faces, sources = [mesh.vertices_mm], [mesh.faces], []
    for number, loop in enumerate(boundary_loops(mesh.faces)[1:]):
        vertices.append(mesh.vertices_mm[loop].mean(axis=0, keepdims=True))
        middle = np.full(len(loop), len(mesh.vertices_mm) + number)
        faces.append(np.stack([np.roll(loop, -1), loop, middle], axis=1).astype(np.int32))
        sources += [owner[int(vertex)] for vertex in loop]
    return Mesh(np.concatenate(vertices), np.concatenate(faces)), np.array(sources, dtype=np.int64)


def compact(mesh: Mesh) -> Mesh:
    """Remove vertices that no face uses."""
    used, index = np.unique(mesh.faces, return_inverse=True)
    return Mesh(mesh.vertices_mm[used], index.reshape(-1, 3).astype(np.int32))


def harmonic_rows(first_mm: NDArray[np.float64], last_mm: NDArray[np.float64], steps: int) -> NDArray[np.float64]:
    """Rings (steps, N, 3) between a first ring (N, 3), which is not included, and a last one, which is.

    Each point is the mean of its four neighbours. Around the ring the solution is a Fourier series. Its wave k changes
    over the rows as a hyperbolic sine with the rate from cosh(rate) = 2 - cos(2 pi k / N), so that ragged details of a
    ring vanish within a few rows.
    """
    count = len(first_mm)
    rate = np.arccosh(2 - np.cos(2 * np.pi * np.arange(1, count) / count))
    row = np.arange(1, steps + 1)[:, None]
    from_first, from_last = (
        1 - np.broadcast_to(row, (steps, count)) / steps,
        np.broadcast_to(row, (steps, count)) / steps,
    )
    # Compute sinh(rate n) / sinh(rate steps) without overflow.
    from_first[:, 1:] = np.exp(-rate * row) * np.expm1(-2 * rate * (steps - row)) / np.expm1(-2 * rate * steps)
    from_last[:, 1:] = np.exp(rate * (row - steps)) * np.expm1(-2 * rate * row) / np.expm1(-2 * rate * steps)
    waves = from_first[..., None] * np.fft.fft(first_mm, axis=0) + from_last[..., None] * np.fft.fft(last_mm, axis=0)
    return np.asarray(np.fft.ifft(waves, axis=1).real)


def ring_faces(rings: NDArray[np.int64], vertices_mm: NDArray[np.float64]) -> NDArray[np.int64]:
    """Triangles between rings of vertices (R, N); quads are split along their shorter diagonal.

    The first ring is a boundary loop of the surface that the triangles continue.
    """
    a, b = rings[:-1], np.roll(rings[:-1], -1, axis=1)
    c, d = rings[1:], np.roll(rings[1:], -1, axis=1)
    falling = (
        np.linalg.norm(vertices_mm[b] - vertices_mm[c], axis=-1)
        <= np.linalg.norm(vertices_mm[a] - vertices_mm[d], axis=-1)
    )[..., None]
    one = np.where(falling, np.stack([b, a, c], -1), np.stack([b, a, d], -1))
    two = np.where(falling, np.stack([b, c, d], -1), np.stack([a, c, d], -1))
    return np.concatenate([one.reshape(-1, 3), two.reshape(-1, 3)])


def smooth_labels(faces: Faces, labels: NDArray[np.int64], rounds: int = 10) -> NDArray[np.int64]:
    """Smooth labels (F,): repeatedly, a face with two neighbours of the same other label takes that label."""
    across = neighbours(faces)
    for _ in range(rounds):
        around = np.where(across >= 0, labels[across], labels[:, None])
        for k in range(3):
            one, two = around[:, k], around[:, (k + 1) % 3]
            labels = np.where((one == two) & (one != labels), one, labels)
    return labels


def without_specks(mesh: Mesh, labels: NDArray[np.int64], share: float = 0.05) -> NDArray[np.int64]:
    """Remove specks from labels (F,): pieces below ``share`` of their label's area take a neighbour's label."""
    across, area = neighbours(mesh.faces), areas_mm2(mesh)
    speck = np.zeros(len(labels), dtype=bool)
    for label in np.unique(labels):
        own = np.flatnonzero(labels == label)
        number = pieces(mesh.faces[own])
        size = np.bincount(number, weights=area[own])
        speck[own] = size[number] < share * size.sum()
    labels = labels.copy()
    while speck.any():
        is_adjacent = (across >= 0) & ~speck[across] & speck[:, None]
        reached = np.flatnonzero(is_adjacent.any(axis=1))
        if len(reached) == 0:
            break
        labels[reached] = labels[across[reached, is_adjacent[reached].argmax(axis=1)]]
        speck[reached] = False
    return labels


def smooth_borders(mesh: Mesh, labels: NDArray[np.int64], rounds: int = 6) -> Mesh:
    """Straighten the lines between labels along the surface.

    A vertex is not moved if a face about it would fold or nearly vanish.
    """
    # Move each vertex on an edge between labels towards the mean of its neighbours along these edges, except where a
    # line ends at the scan's rim.
    across = neighbours(mesh.faces)
    border = (across >= 0) & (labels[across] != labels[:, None])
    start, end = mesh.faces[border], np.roll(mesh.faces, -1, axis=1)[border]
    degree = np.bincount(start, minlength=len(mesh.vertices_mm))
    moving = np.flatnonzero(degree > 1)
    vertices = mesh.vertices_mm.copy()
    for _ in range(rounds):
        total = np.stack(
            [np.bincount(start, weights=vertices[end, axis], minlength=len(vertices)) for axis in range(3)], axis=-1
        )
        vertices[moving] = (vertices[moving] + total[moving] / degree[moving, None]) / 2
    if len(moving):
        vertices[moving] = _back_on_surface(mesh, mesh.vertices_mm[moving], vertices[moving])

    normals, area = _crosses(mesh), 2 * areas_mm2(mesh)
    for _ in range(20):
        moved = _crosses(Mesh(vertices, mesh.faces))
        bad = np.einsum("ij,ij->i", normals, moved) < np.maximum(
            0.5 * area * np.linalg.norm(moved, axis=1), 0.1 * area**2
        )
        if not bad.any() or np.array_equal(vertices[mesh.faces[bad]], mesh.vertices_mm[mesh.faces[bad]]):
            break
        vertices[mesh.faces[bad]] = mesh.vertices_mm[mesh.faces[bad]]
    return Mesh(vertices, mesh.faces)


def _back_on_surface(mesh: Mesh, before_mm: NDArray[np.float64], moved_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    # Points (N, 3) of the surface nearest to points that were on it before they moved. None is farther from it than it
    # moved, so that faces whose corners are all farther than this and an edge need no search.
    from scipy.spatial import cKDTree

    from services.anatomy.distance import SurfaceDistance

    corners = mesh.vertices_mm[mesh.faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max(axis=1)
    farthest = np.linalg.norm(moved_mm - before_mm, axis=1).max()
    apart = cKDTree(moved_mm).query(mesh.vertices_mm)[0][mesh.faces].min(axis=1)
    near = Mesh(mesh.vertices_mm, mesh.faces[apart <= farthest + longest])
    return SurfaceDistance(near).closest(moved_mm)[0]


def _crosses(mesh: Mesh) -> NDArray[np.float64]:
    a, b, c = (mesh.vertices_mm[mesh.faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def _components(one: NDArray[np.int64], two: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    return np.asarray(
        connected_components(coo_matrix((np.ones(len(one)), (one, two)), shape=(count, count)), directed=False)[1],
        dtype=np.int64,
    )


def _largest(number: NDArray[np.int64], weight: NDArray[np.float64]) -> NDArray[np.bool_]:
    return np.asarray(number == np.bincount(number, weights=weight).argmax())


def _first_of_equals(faces: Faces) -> NDArray[np.bool_]:
    ordered = np.sort(faces, axis=1)
    order = np.lexsort(ordered.T)
    first = np.zeros(len(faces), dtype=bool)
    first[order[np.append(True, (np.diff(ordered[order], axis=0) != 0).any(axis=1))]] = True
    return first


def _simple_edges(faces: Faces) -> NDArray[np.bool_]:
    # Faces whose edges have at most two faces, and not two faces that run along an edge in the same direction.
    start, end = faces.astype(np.int64), np.roll(faces, -1, axis=1).astype(np.int64)
    count = int(faces.max()) + 1

    def shared_by(key: NDArray[np.int64]) -> NDArray[np.int64]:
        _, index, counts = np.unique(key, return_inverse=True, return_counts=True)
        return np.asarray(counts[index.reshape(-1, 3)].max(axis=1))

    by_few = shared_by(np.minimum(start, end) * count + np.maximum(start, end)) <= 2
    return np.asarray(by_few & (shared_by(start * count + end) == 1))


def _largest_fans(faces: Faces) -> NDArray[np.bool_]:
    # Faces that belong to the largest fan at each of their vertices. Corners of a vertex belong to one fan if they are
    # joined across edges that end there.
    across = neighbours(faces)
    face, k = np.nonzero(across >= 0)
    other = across[face, k]
    joined = []
    for corner in (k, (k + 1) % 3):
        vertex = faces[face, corner]
        joined.append((3 * face + corner, 3 * other + (faces[other] == vertex[:, None]).argmax(axis=1)))
    fan = _components(np.concatenate([a for a, _ in joined]), np.concatenate([b for _, b in joined]), 3 * len(faces))
    size = np.bincount(fan)
    vertex_of_fan = np.zeros(len(size), dtype=np.int64)
    vertex_of_fan[fan] = faces.reshape(-1)
    order = np.lexsort((size, vertex_of_fan))
    best = np.zeros(len(size), dtype=bool)
    best[order[np.append(np.diff(vertex_of_fan[order]) > 0, True)]] = True
    return np.asarray(best[fan].reshape(-1, 3).all(axis=1))
