"""Teeth of a scan without labels: the operator points at each, an average crown is fitted there, and creases part the
surface.

A fitted crown only tells what is surely its tooth and what is surely not; between the two a minimal cut follows the
creases of the surface (Boykov and Jolly, "Interactive graph cuts", ICCV 2001). Teeth are told from each other by fronts
that run from what is surely theirs and that creases hold up (Dijkstra's distances).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.anatomy.scans.matching import CrownMatch, Placements
from services.anatomy.scans.patches import (
    areas_mm2,
    compact,
    manifold_piece,
    middle_mm,
    neighbours,
    smooth_labels,
    vector_area_mm2,
    without_specks,
)
from services.anatomy.templates.average_arch import side_of_front
from services.core.errors import CaptureInputError
from services.core.geometry import Mesh

Array = NDArray[np.float64]

GINGIVA = 0
PERMANENT_QUADRANTS, TEETH_A_QUADRANT = (1, 2, 3, 4), 8
FARTHEST_MM = 2.0
"""Of a point from the scan: clicks lie on the surface, and vertices some tenths of a millimetre apart."""
NEAREST_MM = 2.0
"""Between points of two teeth: the narrowest teeth are 5 mm wide."""
PATCH_MM, PATCH_DEPTH_MM = 8.0, 6.0
"""Around a point, and below it, that a crown is fitted to: half a molar's width with room, and the least height of a
crown."""
CROWN_POINTS, CROWN_ROUNDS = 300, 12
"""Of a fit, which need not be closer than a millimetre."""
SHIFTS_MM = (-2.5, 0.0, 2.5)
"""Towards the cheek, of where fits begin: people click the cusp, a premolar's or molar's being so far beside its
middle."""
CORE = 0.7
"""Share of the fitted crown's half width within which its upper half is surely the tooth's."""
CLICKED_MM = 1.0
"""Around a point, what is surely its tooth's."""
CORE_ABOVE_MM = 2.0
"""Above the fitted crown's top, as far as the core reaches."""
GUMS_MM = (1.0, 3.5)
"""Away from the boxes around all fitted crowns: where the surface begins to be likelier gums than tooth, and where it
surely is."""
GUMS_PER_MM = 0.3
"""Cost of a square millimetre that is taken for tooth just before it is surely gums, against a millimetre of border on
a flat surface."""
FLAT = 0.2
"""Spread of the points across their line, relative to that along it, above which they span the occlusal plane."""
SMOOTH_MM = 0.33
"""Over which normals are averaged before the surface's bend is taken: a scan's noise is shorter, a crease at a neck as
wide."""
MAX_ROUNDS = 30
CREASE_PER_MM = 0.4
"""Bend inwards, radians a millimetre, at which a border costs 1/e of one on a flat surface."""
FLOOR = 0.02
"""Least cost of a border, per length of one on a flat surface: what keeps it short along a crease."""
HOLD_MM2 = 20.0
"""How a crease holds up a front: a way over a bend of b per mm counts 1 + HOLD b² times as long."""
NEAREST_FACES_MM = 0.03
"""Two triangles' centres count as at least so far apart: slivers have no bend that means anything."""
UNITS_PER_MM = 1000.0
"""Cost of a border in whole numbers, which the flow takes."""


@dataclass(frozen=True)
class _Bends:
    """Pairs of neighbouring faces, each pair twice."""

    one: NDArray[np.int64]
    other: NDArray[np.int64]
    apart_mm: Array
    """Between the faces' centres."""
    inwards_per_mm: Array
    """How the surface bends inwards there; 0 where it is flat or bends outwards."""
    border_mm: Array
    """Length of the edge between the two."""


def part_by_landmarks(mesh: Mesh, points_mm: Mapping[int, Array], what: str) -> NDArray[np.int64]:
    """FDI number (F,) of each triangle of a scan, 0 for gingiva.

    Args:
        mesh: open surface of one jaw, counter-clockwise seen from outside.
        points_mm: by FDI number, points (N, 3) in the middle of the tooth's edge or chewing surface, or on a cusp; a
            tooth without any is left to the gums.
        what: the scan's name for messages.

    Raises:
        CaptureInputError: fewer than two teeth have points, a point is not on the scan, two teeth's are at one place,
            they point into the gums, or no crown is found about one.
    """
    teeth = tuple(sorted(points_mm))
    tops = np.array([points_mm[fdi].mean(axis=0) for fdi in teeth]).reshape(-1, 3)
    _require_points(mesh, points_mm, teeth, tops, what)
    kept = manifold_piece(mesh)
    surface = compact(Mesh(mesh.vertices_mm, mesh.faces[kept]))
    middles = surface.vertices_mm[surface.faces].mean(axis=1)
    is_core, outside_mm = _fitted_crowns(surface, middles, teeth, tops)
    bends = _bends(surface, middles)
    likely = np.clip((outside_mm - GUMS_MM[0]) / (GUMS_MM[1] - GUMS_MM[0]), 0, 1)
    is_tooth = _cut(bends, np.asarray(is_core.any(axis=1)), likely, GUMS_PER_MM * areas_mm2(surface))
    own = np.concatenate([[GINGIVA], teeth])[_reached(bends, is_core, is_tooth)]

    labels = np.full(len(mesh.faces), GINGIVA, dtype=np.int64)
    labels[kept] = without_specks(surface, smooth_labels(surface.faces, own))
    for fdi in teeth:
        if not (labels == fdi).any():
            raise CaptureInputError(
                f"No crown is found about the landmarks of tooth {fdi} in {what}; click the middle of its edge or"
                " chewing surface."
            )
    return labels


def _require_points(mesh: Mesh, points_mm: Mapping[int, Array], teeth: tuple[int, ...], tops: Array, what: str) -> None:
    from scipy.spatial import cKDTree

    if len(teeth) < 2:
        raise CaptureInputError(
            f"{what[0].upper()}{what[1:]} has no labels, and landmarks name {len(teeth)} of its teeth; click one point"
            " on each tooth, in the middle of its edge or chewing surface, in the page of dentine landmarks, or export"
            " the scan with its segmentation."
        )
    for fdi in teeth:
        if not (fdi // 10 in PERMANENT_QUADRANTS and 1 <= fdi % 10 <= TEETH_A_QUADRANT):
            raise CaptureInputError(
                f"Landmarks of {what} name tooth {fdi}, which is no permanent tooth; give FDI numbers, 11 to 48."
            )
    tree = cKDTree(mesh.vertices_mm)
    for fdi in teeth:
        off_mm = float(tree.query(points_mm[fdi])[0].max())
        if off_mm > FARTHEST_MM:
            raise CaptureInputError(
                f"A landmark of tooth {fdi} lies {off_mm:.3g} mm from {what}; give xyz_mm in the scan's own"
                " coordinates, in mm, and see whether the scan's units are right."
            )
    for k, fdi in enumerate(teeth[:-1]):
        apart = np.linalg.norm(tops[k + 1 :] - tops[k], axis=1)
        if apart.min() < NEAREST_MM:
            raise CaptureInputError(
                f"Landmarks of teeth {fdi} and {teeth[k + 1 + int(apart.argmin())]} are {apart.min():.2g} mm apart,"
                " which two teeth never are; correct the one that is on the wrong tooth."
            )
    if (tops.mean(axis=0) - middle_mm(mesh)) @ vector_area_mm2(mesh) < 0:
        raise CaptureInputError(
            f"{what[0].upper()}{what[1:]} is inside out or a mirror image: its teeth point into the gums; "
            "turn its triangles around, or mirror the scan back, and export it again."
        )


def _fitted_crowns(
    surface: Mesh, middles: Array, teeth: tuple[int, ...], tops: Array
) -> tuple[NDArray[np.bool_], Array]:
    # Faces that are surely of each tooth (F, T), and how far (F,) each lies outside the boxes of all teeth.
    from scipy.spatial import cKDTree

    is_core = np.zeros((len(middles), len(teeth)), dtype=bool)
    outside_mm = np.full(len(middles), np.inf)
    nearest = cKDTree(tops).query(middles)[1]
    for k, (fdi, axes) in enumerate(zip(teeth, _axes(surface, teeth, tops), strict=True)):
        off = middles - tops[k]
        near = (np.linalg.norm(off, axis=1) < PATCH_MM) & (off @ axes[2] > -PATCH_DEPTH_MM)
        match = CrownMatch(fdi, compact(Mesh(surface.vertices_mm, surface.faces[near])))
        found = _fitted(match, axes, tops[k])
        half = match.half_size_mm * found.scales[0]
        place = (middles - found.centres_mm[0]) @ found.axes[0].T
        is_core[:, k] = (
            (nearest == k)
            & (np.abs(place[:, :2]) < CORE * half[:2]).all(axis=1)
            & (place[:, 2] > 0)
            & (place[:, 2] < half[2] + CORE_ABOVE_MM)
        ) | (np.linalg.norm(off, axis=1) < CLICKED_MM)
        # A fit may slip to the next tooth, so the average crown below the point is spared as well.
        hung = off @ axes.T + [0, 0, match.half_size_mm[2]]
        for offset, size in ((place, half), (hung, match.half_size_mm)):
            beside_mm = np.linalg.norm(np.maximum(np.abs(offset) - size, 0), axis=1)
            outside_mm = np.minimum(outside_mm, beside_mm)
    return is_core, outside_mm


def _axes(surface: Mesh, teeth: tuple[int, ...], tops: Array) -> Array:
    # Canonical axes (T, 3, 3): z across the plane of the points, or of the scan's rim where they lie in a line; x along
    # the arch.
    opening = vector_area_mm2(surface)
    _, spread, principal = np.linalg.svd(tops - tops.mean(axis=0), full_matrices=False)
    plane = len(teeth) > 2 and spread[1] > FLAT * spread[0]
    occlusal = principal[2] if plane else opening - (opening @ principal[0]) * principal[0]
    occlusal = occlusal * np.sign(occlusal @ opening) / np.linalg.norm(occlusal)
    order = sorted(range(len(teeth)), key=lambda k: side_of_front(teeth[k]) * (teeth[k] % 10))
    axes = np.empty((len(teeth), 3, 3))
    for k, along in zip(order, np.gradient(tops[order], axis=0), strict=True):
        buccal = np.cross(occlusal, along)
        buccal /= np.linalg.norm(buccal)
        axes[k] = np.cross(buccal, occlusal), buccal, occlusal
    return axes


def _fitted(match: CrownMatch, axes: Array, top_mm: Array) -> Placements:
    # The best of several starts. A crown shrunk onto one cusp is close to the scan, but the scan is not close to it.
    found = [match.settled(axes[None], CROWN_POINTS, CROWN_ROUNDS, top_mm + shift * axes[1]) for shift in SHIFTS_MM]
    misfits = [float(one.misfits_mm[0] + match.reverse_misfits_mm(one)[0]) for one in found]
    return found[int(np.argmin(misfits))]


def _bends(surface: Mesh, middles: Array) -> _Bends:
    across, area = neighbours(surface.faces), areas_mm2(surface)
    one, corner = np.nonzero(across >= 0)
    other = across[one, corner]
    away = middles[other] - middles[one]
    apart = np.maximum(np.linalg.norm(away, axis=1), NEAREST_FACES_MM)

    # Means over a face and its neighbours, again and again, spread over the root of the rounds times the faces'
    # distance.
    rounds = int(np.clip(round((SMOOTH_MM / float(np.median(apart))) ** 2), 1, MAX_ROUNDS))
    a, b, c = (surface.vertices_mm[surface.faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a) / np.maximum(2 * area, np.finfo(float).tiny)[:, None]
    weight = np.where(across >= 0, area[across], 0.0)
    for _ in range(rounds):
        total = area[:, None] * normals + (weight[..., None] * normals[across]).sum(axis=1)
        normals = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), np.finfo(float).tiny)
    outwards = ((normals[other] - normals[one]) * away).sum(axis=1) / apart**2
    start, end = surface.faces[one, corner], surface.faces[one, (corner + 1) % 3]
    border = np.linalg.norm(surface.vertices_mm[start] - surface.vertices_mm[end], axis=1)
    return _Bends(one, other, apart, np.maximum(-outwards, 0), border)


def _cut(bends: _Bends, is_tooth: NDArray[np.bool_], likely_gums: Array, gums_cost: Array) -> NDArray[np.bool_]:
    # Faces (F,) on the teeth's side of the cheapest border, with what it costs to take likely gums for tooth.
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import breadth_first_order, maximum_flow

    count = len(is_tooth)
    cost = bends.border_mm * (FLOOR + np.exp(-bends.inwards_per_mm / CREASE_PER_MM))
    source, sink, endless = count, count + 1, np.iinfo(np.int32).max // 4
    inner, outer = np.flatnonzero(is_tooth), np.flatnonzero(~is_tooth & (likely_gums > 0))
    rows = np.concatenate([bends.one, np.full(len(inner), source), outer])
    columns = np.concatenate([bends.other, inner, np.full(len(outer), sink)])
    pulled = np.where(likely_gums < 1, UNITS_PER_MM * gums_cost * likely_gums, endless)[outer]
    capacity = np.concatenate([np.maximum(UNITS_PER_MM * cost, 1), np.full(len(inner), endless), pulled])
    graph = csr_matrix((capacity.astype(np.int32), (rows, columns)), shape=(count + 2, count + 2))
    left = graph - maximum_flow(graph, source, sink).flow
    left.data = np.maximum(left.data, 0)
    left.eliminate_zeros()
    reached = np.zeros(count + 2, dtype=bool)
    reached[breadth_first_order(left, source, return_predecessors=False)] = True
    return reached[:count]


def _reached(bends: _Bends, is_core: NDArray[np.bool_], is_tooth: NDArray[np.bool_]) -> NDArray[np.int64]:
    # For each face 1 + the number of the tooth whose front is there first, 0 for gums and what no front reaches.
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import dijkstra

    inside = is_tooth[bends.one] & is_tooth[bends.other]
    cost = bends.apart_mm * (1 + HOLD_MM2 * bends.inwards_per_mm**2)
    count = len(is_tooth)
    graph = csr_matrix((cost[inside], (bends.one[inside], bends.other[inside])), shape=(count, count))
    starts = np.flatnonzero(is_core.any(axis=1) & is_tooth)
    distance, _, origin = dijkstra(graph, indices=starts, min_only=True, return_predecessors=True)
    found = np.zeros(count, dtype=np.int64)
    there = np.isfinite(distance)
    found[there] = 1 + is_core.argmax(axis=1)[origin[there]]
    return found
