"""Segmentation of a scan without labels: the operator clicks on each tooth, an average crown is fitted there, and the
surface is cut along its creases.

A fitted crown only determines triangles that surely belong to its tooth and triangles that surely do not. Between the
two, a minimal cut follows the creases of the surface (Boykov and Jolly, "Interactive graph cuts", ICCV 2001). Teeth are
separated from each other by fronts that start from the sure triangles of each tooth and are slowed down by creases
(Dijkstra's distances).
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
"""Label of triangles of the gums."""
PERMANENT_QUADRANTS, TEETH_A_QUADRANT = (1, 2, 3, 4), 8
FARTHEST_MM = 2.0
"""Largest distance of a point from the scan's vertices, mm: clicks lie on the surface, and vertices are some tenths of
a millimetre apart."""
NEAREST_MM = 2.0
"""Smallest distance between the points of two teeth, mm: the narrowest teeth are 5 mm wide."""
TOP_MM = 3.0
"""Height below a tooth's highest point, mm, within which points are on its edge or chewing surface: cusps differ by 2
mm at most, and the gums are 5 mm below them and more."""
PATCH_MM, PATCH_DEPTH_MM = 8.0, 6.0
"""Radius around a point and depth below it of the patch to which a crown is fitted, mm: half a molar's width with some
margin, and the smallest height of a crown."""
CROWN_POINTS, CROWN_ROUNDS = 300, 12
"""Numbers of points and iterations of a fit, which need not be more accurate than a millimetre."""
SHIFTS_MM = (-2.5, 0.0, 2.5)
"""Displacements towards the cheek from which fits start, mm: people click on a cusp, which in a premolar or molar is
this far from the middle."""
CORE = 0.7
"""Fraction of the fitted crown's half width within which its upper half surely belongs to the tooth."""
CLICKED_MM = 1.0
"""Radius around a point within which triangles surely belong to its tooth, mm."""
CORE_ABOVE_MM = 2.0
"""Height above the fitted crown's top up to which triangles surely belong to the tooth, mm."""
GUMS_MM = (1.0, 3.5)
"""Distances from the boxes around all fitted crowns, mm: where gums begin to be likelier than teeth, and beyond which
the surface surely is gums."""
GUMS_PER_MM = 0.3
"""Cost of assigning a square millimetre of likely gums to the teeth, just before it is surely gums, in units of the
cost of a millimetre of border on a flat surface."""
MIN_SPREAD_RATIO = 0.2
"""Ratio of the spread of points or crowns across their line to that along it, above which they span the occlusal
plane."""
SMOOTH_MM = 0.33
"""Distance over which normals are averaged before the curvature is computed, mm: the noise of a scan has shorter waves,
and a crease at a neck is as wide."""
MAX_ROUNDS = 30
"""Largest number of rounds of averaging."""
CREASE_PER_MM = 0.4
"""Concave curvature, radians per mm, at which a border costs 1/e of one on a flat surface."""
MIN_BORDER_COST = 0.02
"""Smallest cost of a border relative to one of the same length on a flat surface; it keeps borders along creases
short."""
CREASE_DELAY_MM2 = 20.0
"""Strength by which a crease slows down a front: a path across a concave curvature of b per mm counts 1 + HOLD b² times
its length."""
NEAREST_FACES_MM = 0.03
"""Smallest distance that the centres of two triangles count with, mm, because the curvature at slivers is
meaningless."""
UNITS_PER_MM = 1000.0
"""Cost units per mm of border: the flow algorithm needs integers."""


@dataclass(frozen=True)
class _FacePairs:
    """Pairs (P,) of neighbouring faces; each pair occurs twice, once in each order."""

    one: NDArray[np.int64]
    other: NDArray[np.int64]
    distance_mm: Array
    """Distance between the faces' centres."""
    inwards_per_mm: Array
    """Concave curvature between the faces, radians per mm; 0 where the surface is flat or convex."""
    border_mm: Array
    """Length of the edge between the faces."""


def segment_by_landmarks(mesh: Mesh, points_mm: Mapping[int, Array], what: str) -> NDArray[np.int64]:
    """Find the FDI number (F,) of each triangle of a scan, 0 for gingiva.

    Args:
        mesh: open surface of one jaw, counter-clockwise seen from outside.
        points_mm: by FDI number, points (N, 3) in the middle of the tooth's edge or chewing surface, or on a cusp.
            Points farther down, as at the gums, are left out. A tooth without points is treated as gums.
        what: the scan's name for messages.

    Raises:
        CaptureInputError: fewer than two teeth have points, a point is not on the scan or on a piece apart from the
            largest one, points of two teeth coincide, the teeth point into the gums, or no crown is found at a tooth's
            points.
    """
    teeth = tuple(sorted(points_mm))
    opening = vector_area_mm2(mesh)
    tops = np.array([_top(points_mm[fdi], opening) for fdi in teeth]).reshape(-1, 3)
    _require_points(mesh, points_mm, teeth, tops, what)
    is_kept = manifold_piece(mesh)
    surface = compact(Mesh(mesh.vertices_mm, mesh.faces[is_kept]))
    _require_connected(surface, points_mm, what)
    middles = surface.vertices_mm[surface.faces].mean(axis=1)
    is_core, outside_mm = _fitted_crowns(surface, middles, teeth, tops, what)
    pairs = _face_pairs(surface, middles)
    likely = np.clip((outside_mm - GUMS_MM[0]) / (GUMS_MM[1] - GUMS_MM[0]), 0, 1)
    is_tooth = _minimal_cut(pairs, np.asarray(is_core.any(axis=1)), likely, GUMS_PER_MM * areas_mm2(surface))
    own = np.concatenate([[GINGIVA], teeth])[_nearest_teeth(pairs, is_core, is_tooth)]

    labels = np.full(len(mesh.faces), GINGIVA, dtype=np.int64)
    labels[is_kept] = without_specks(surface, smooth_labels(surface.faces, own))
    for fdi in teeth:
        _require_crown(bool((labels == fdi).any()), fdi, what)
    return labels


def _require_crown(is_found: bool, fdi: int, what: str) -> None:
    if not is_found:
        raise CaptureInputError(
            f"No crown is found about the landmarks of tooth {fdi} in {what}; click the middle of its edge or"
            " chewing surface."
        )


def _top(points_mm: Array, opening: Array) -> Array:
    # Mean (3,) of a tooth's highest points, in the direction of a vector (3,) away from the gums.
    heights_mm = points_mm @ opening / max(float(np.linalg.norm(opening)), np.finfo(float).tiny)
    return np.asarray(points_mm[heights_mm > heights_mm.max() - TOP_MM].mean(axis=0))


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
        distance_mm = float(tree.query(points_mm[fdi])[0].max())
        if distance_mm > FARTHEST_MM:
            raise CaptureInputError(
                f"A landmark of tooth {fdi} lies {distance_mm:.3g} mm from {what}; give xyz_mm in the scan's own"
                " coordinates, in mm, and see whether the scan's units are right."
            )
    for k, fdi in enumerate(teeth[:-1]):
        distances_mm = np.linalg.norm(tops[k + 1 :] - tops[k], axis=1)
        if distances_mm.min() < NEAREST_MM:
            raise CaptureInputError(
                f"Landmarks of teeth {fdi} and {teeth[k + 1 + int(distances_mm.argmin())]} are {distances_mm.min():.2g}"
                " mm apart, which two teeth never are; correct the one that is on the wrong tooth."
            )
    if (tops.mean(axis=0) - middle_mm(mesh)) @ vector_area_mm2(mesh) < 0:
        raise CaptureInputError(
            f"{what[0].upper()}{what[1:]} is inside out or a mirror image: its teeth point into the gums; "
            "turn its triangles around, or mirror the scan back, and export it again."
        )


def _require_connected(surface: Mesh, points_mm: Mapping[int, Array], what: str) -> None:
    # Refuse points that lie on another piece of the scan than its largest one, which alone is segmented.
    from scipy.spatial import cKDTree

    tree = cKDTree(surface.vertices_mm)
    for fdi in sorted(points_mm):
        apart_mm = float(tree.query(points_mm[fdi])[0].max())
        if apart_mm > FARTHEST_MM:
            raise CaptureInputError(
                f"A landmark of tooth {fdi} lies on a piece of {what} that does not hang together with the largest"
                f" piece, {apart_mm:.3g} mm away; export the jaw with its gums as one connected surface, or remove the"
                " landmark if the piece is no tooth of this jaw."
            )


def _fitted_crowns(
    surface: Mesh, middles: Array, teeth: tuple[int, ...], tops: Array, what: str
) -> tuple[NDArray[np.bool_], Array]:
    # Faces (F, T) that surely belong to each tooth, and distance (F,) of each face from the boxes of all teeth.
    from scipy.spatial import cKDTree

    is_core = np.zeros((len(middles), len(teeth)), dtype=bool)
    outside_mm = np.full(len(middles), np.inf)
    nearest = cKDTree(tops).query(middles)[1]
    for k, (fdi, axes) in enumerate(zip(teeth, _axes(surface, teeth, tops), strict=True)):
        from_top = middles - tops[k]
        near = (np.linalg.norm(from_top, axis=1) < PATCH_MM) & (from_top @ axes[2] > -PATCH_DEPTH_MM)
        _require_crown(bool(near.any()), fdi, what)
        match = CrownMatch(fdi, compact(Mesh(surface.vertices_mm, surface.faces[near])))
        found = _fitted(match, axes, tops[k])
        half = match.half_size_mm * found.scales[0]
        from_middle = (middles - found.centres_mm[0]) @ found.axes[0].T
        is_core[:, k] = (
            (nearest == k)
            & (np.abs(from_middle[:, :2]) < CORE * half[:2]).all(axis=1)
            & (from_middle[:, 2] > 0)
            & (from_middle[:, 2] < half[2] + CORE_ABOVE_MM)
        ) | (np.linalg.norm(from_top, axis=1) < CLICKED_MM)
        # Keep the box of an average crown below the point out of the gums too, because a fit may slip to the next
        # tooth.
        from_average_middle = from_top @ axes.T + [0, 0, match.half_size_mm[2]]
        for offset, size in ((from_middle, half), (from_average_middle, match.half_size_mm)):
            beside_mm = np.linalg.norm(np.maximum(np.abs(offset) - size, 0), axis=1)
            outside_mm = np.minimum(outside_mm, beside_mm)
    return is_core, outside_mm


def _axes(surface: Mesh, teeth: tuple[int, ...], tops: Array) -> Array:
    # Approximate canonical axes (T, 3, 3): z is normal to the plane of the points, or to the scan's rim if they lie in
    # a line; x runs along the arch.
    opening = vector_area_mm2(surface)
    _, spread, principal = np.linalg.svd(tops - tops.mean(axis=0), full_matrices=False)
    plane = len(teeth) > 2 and spread[1] > MIN_SPREAD_RATIO * spread[0]
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
    # Choose the best of several starts by the misfit in both directions: a crown shrunk onto one cusp is close to the
    # scan, but the scan is not close to it.
    found = [match.register(axes[None], CROWN_POINTS, CROWN_ROUNDS, top_mm + shift * axes[1]) for shift in SHIFTS_MM]
    misfits = [float(one.misfits_mm[0] + match.reverse_misfits_mm(one)[0]) for one in found]
    return found[int(np.argmin(misfits))]


def _face_pairs(surface: Mesh, middles: Array) -> _FacePairs:
    across, area = neighbours(surface.faces), areas_mm2(surface)
    one, corner = np.nonzero(across >= 0)
    other = across[one, corner]
    away = middles[other] - middles[one]
    distance_mm = np.maximum(np.linalg.norm(away, axis=1), NEAREST_FACES_MM)

    # Average normals repeatedly over a face and its neighbours; the width of this smoothing is the square root of the
    # number of rounds times the distance between faces.
    rounds = int(np.clip(round((SMOOTH_MM / float(np.median(distance_mm))) ** 2), 1, MAX_ROUNDS))
    a, b, c = (surface.vertices_mm[surface.faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a) / np.maximum(2 * area, np.finfo(float).tiny)[:, None]
    weight = np.where(across >= 0, area[across], 0.0)
    for _ in range(rounds):
        total = area[:, None] * normals + (weight[..., None] * normals[across]).sum(axis=1)
        normals = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), np.finfo(float).tiny)
    outwards = ((normals[other] - normals[one]) * away).sum(axis=1) / distance_mm**2
    start, end = surface.faces[one, corner], surface.faces[one, (corner + 1) % 3]
    border = np.linalg.norm(surface.vertices_mm[start] - surface.vertices_mm[end], axis=1)
    return _FacePairs(one, other, distance_mm, np.maximum(-outwards, 0), border)


def _minimal_cut(
    pairs: _FacePairs, is_tooth: NDArray[np.bool_], likely_gums: Array, gums_cost: Array
) -> NDArray[np.bool_]:
    # Faces (F,) on the teeth's side of the cheapest border (minimal cut), with a cost for likely gums on that side.
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import breadth_first_order, maximum_flow

    count = len(is_tooth)
    cost = pairs.border_mm * (MIN_BORDER_COST + np.exp(-pairs.inwards_per_mm / CREASE_PER_MM))
    source, sink, unlimited = count, count + 1, np.iinfo(np.int32).max // 4
    inner, outer = np.flatnonzero(is_tooth), np.flatnonzero(~is_tooth & (likely_gums > 0))
    rows = np.concatenate([pairs.one, np.full(len(inner), source), outer])
    columns = np.concatenate([pairs.other, inner, np.full(len(outer), sink)])
    gum_capacity = np.where(likely_gums < 1, UNITS_PER_MM * gums_cost * likely_gums, unlimited)[outer]
    capacity = np.concatenate([np.maximum(UNITS_PER_MM * cost, 1), np.full(len(inner), unlimited), gum_capacity])
    graph = csr_matrix((capacity.astype(np.int32), (rows, columns)), shape=(count + 2, count + 2))
    residual = graph - maximum_flow(graph, source, sink).flow
    residual.data = np.maximum(residual.data, 0)
    residual.eliminate_zeros()
    reached = np.zeros(count + 2, dtype=bool)
    reached[breadth_first_order(residual, source, return_predecessors=False)] = True
    return reached[:count]


def _nearest_teeth(pairs: _FacePairs, is_core: NDArray[np.bool_], is_tooth: NDArray[np.bool_]) -> NDArray[np.int64]:
    # For each face (F,) 1 + the index of the tooth whose front arrives first; 0 for gums and faces that no front
    # reaches.
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import dijkstra

    inside = is_tooth[pairs.one] & is_tooth[pairs.other]
    cost = pairs.distance_mm * (1 + CREASE_DELAY_MM2 * pairs.inwards_per_mm**2)
    count = len(is_tooth)
    graph = csr_matrix((cost[inside], (pairs.one[inside], pairs.other[inside])), shape=(count, count))
    starts = np.flatnonzero(is_core.any(axis=1) & is_tooth)
    distance, _, origin = dijkstra(graph, indices=starts, min_only=True, return_predecessors=True)
    found = np.zeros(count, dtype=np.int64)
    is_reached = np.isfinite(distance)
    found[is_reached] = 1 + is_core.argmax(axis=1)[origin[is_reached]]
    return found
