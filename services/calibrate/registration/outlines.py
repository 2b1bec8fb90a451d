"""Refinement of a scan's pose on the outlines of its teeth in the photographs.

Each round computes the outlines at the present pose, searches the photograph's edge along the line across each outline
point (Harris, "Tracking with rigid models", 1992), and changes the pose to reduce the distances across, large ones with
less weight. The edge of a tooth beside gums, lips or the dark of the mouth is where the likeness to tooth falls; the
edge between two teeth is a dark line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from services.calibrate.registration.appearance import Appearance, learn_appearance
from services.calibrate.registration.contours import Contour, tooth_contours
from services.calibrate.registration.edges import edges_in_light
from services.calibrate.registration.pose import Floats, PoseStep, RigidPose, millimetres_a_pixel, pixel_derivatives
from services.core.errors import CaptureInputError
from services.core.geometry import Camera, Mesh
from services.core.robust import robust_sigma

NARROW_PX = 3.0
"""Distance to which edges are searched in the last rounds, in which their position is then refined in the light."""
STEP_PX = 0.5
"""Distance between samples across an outline."""
MAX_POINTS = 1500
"""Largest number of outline points per camera: neighbouring points give the same information."""
MIN_STRENGTH = 0.25
"""Smallest strength of an edge, as a fraction of the 90th percentile of the edges' strengths."""
TUKEY = 2.5
"""Distance in standard errors beyond which a point has no weight (Tukey's biweight). The usual 4.7 would save a fifth
of the variance of clean edges, but the edges of lips, which cross the outlines, lie nearer than that: with 4.7 they
rotated drawn phantoms by 0.12° in place of 0.08°."""
MIN_SPREAD_PX = 0.15
"""Smallest standard error of the points of one photograph."""
OTHER_TOOTH = 0.5
"""Likeness to tooth at the outer end of the search from which on another tooth is assumed there."""
BETWEEN_WEIGHT = 0.25
"""Weight of a point between two teeth: the dark line lies at an unknown distance from either tooth's edge."""
ROUNDS = 12
"""Largest number of rounds."""
MIN_FOUND = 0.3
"""Smallest fraction of the outline points for which an edge must be found; lips and retractor hide some."""
SECTORS = 6
"""Number of parts of a tooth's outline within which errors are taken as fully correlated, for the covariance."""
SHIFT_PX = (0.15, 0.1, 0.5)
"""Prior standard errors of the shifts that all outlines beside background, beside gums and beside another tooth have in
common in all photographs. Their causes are rims that darken, and the dark line between teeth, which lies behind the
edge of the nearer tooth. The shifts are unknowns of the pose's equations; outlines on both sides of a tooth determine
them. On phantoms at their true pose the medians were, as rms, 0.09 to 0.2, 0.01 to 0.1 and 0.1 to 0.8 px."""

SIDE_PX = 0.1
"""Standard error of a further shift that one side of all teeth has in common in one photograph, because of the light
that falls on it; only the covariance contains it. On the same phantoms it was 0.03 to 0.12 px beside background and
gums."""


@dataclass(frozen=True)
class View:
    """One camera's photograph without lens distortion, whole or cropped to the teeth, and the camera of this image."""

    camera: Camera
    image: NDArray[np.float32]
    """Linear image (H, W, C), 0 at black."""


@dataclass(frozen=True)
class FoundEdges:
    """Edges of a photograph that were found for the outline points of its view."""

    contour: Contour
    offset_px: Floats
    """Distances (N,) from the predicted outline to the photograph's edge, outwards."""
    is_found: NDArray[np.bool_]
    """True where an edge was found (N,)."""


def pose_from_outlines(
    views: Sequence[View],
    teeth: Sequence[Mesh],
    occluders: Sequence[Mesh],
    start: PoseStep,
    centre_mm: Floats,
    reach_px: float = 14.0,
) -> PoseStep:
    """Refine a pose on the outlines of all teeth in all photographs.

    Args:
        views: photographs of all cameras.
        teeth: solids of the scan, in the scan's frame.
        occluders: solids of the scan that hide teeth, such as gums.
        start: first pose; it and its covariance are a prior.
        centre_mm: centre of the teeth in the scan (3,).
        reach_px: distance to which edges are searched in the first round.

    Raises:
        CaptureInputError: fewer than ``MIN_FOUND`` of the outline points have an edge in the photographs.
    """
    pose, prior = start.pose, np.asarray(np.linalg.inv(start.covariance), dtype=np.float64)
    appearances: list[Appearance] = []
    found: list[FoundEdges] = []
    normal, spread, shifts_px = _with_shifts(prior), {}, np.zeros(len(SHIFT_PX))
    for number in range(ROUNDS):
        # Narrow the search from the uncertainty of the start to a few pixels.
        reach = max(reach_px * 0.75**number, NARROW_PX)
        moved = [_transformed(mesh, pose) for mesh in teeth]
        hidden = [_transformed(mesh, pose) for mesh in occluders]
        predicted = [tooth_contours(view.camera, moved, hidden) for view in views]
        if number % 4 == 0:
            appearances = [
                learn_appearance(view.image, label >= 0, reach / 2)
                for view, (_, label) in zip(views, predicted, strict=True)
            ]
        found = [
            _search_edges(_subsampled(contour), appearance, reach)
            for (contour, _), appearance in zip(predicted, appearances, strict=True)
        ]
        if reach <= NARROW_PX:
            found = [_refine_in_light(one, view.image) for one, view in zip(found, views, strict=True)]
        centre = pose.apply(centre_mm[None])[0]
        normal = _with_shifts(prior)
        right = normal @ np.concatenate([pose.twist_to(start.pose, centre), -shifts_px])
        for view, one in zip(views, found, strict=True):
            jacobian, residual, weight, spread[view.camera.name] = _equations(view.camera, one, centre, shifts_px)
            normal += jacobian.T @ (weight[:, None] * jacobian)
            right += jacobian.T @ (weight * residual)
        step, moved_px = np.split(np.asarray(np.linalg.solve(normal, right), dtype=np.float64), [len(prior)])
        shifts_px = shifts_px + moved_px
        pose = pose.moved(step, centre)
        if reach <= NARROW_PX and np.abs(step).max() < 1e-4:
            break
    _require_edges(found)
    centre = pose.apply(centre_mm[None])[0]
    covariance = _sandwich(views, found, centre, len(teeth), shifts_px, normal, prior)
    median_px = {
        view.camera.name: float(np.median(np.abs(one.offset_px[one.is_found])))
        for view, one in zip(views, found, strict=True)
        if one.is_found.any()
    }
    sizes = [millimetres_a_pixel(view.camera, centre[None])[0] for view in views if view.camera.name in median_px]
    residual_mm = float(np.mean([px * size for px, size in zip(median_px.values(), sizes, strict=True)]))
    missing = [
        (
            f"{1 - one.is_found.mean():.0%} of the outlines in camera {view.camera.name}"
            if len(one.is_found)
            else f"camera {view.camera.name}, which sees no tooth at this pose"
        )
        for view, one in zip(views, found, strict=True)
    ]
    return PoseStep(
        "outlines",
        pose,
        covariance,
        median_px,
        residual_mm,
        int(sum(one.is_found.sum() for one in found)),
        tuple(missing),
    )


def outline_misfit_mm(
    views: Sequence[View], teeth: Sequence[Mesh], occluders: Sequence[Mesh], pose: RigidPose, reach_mm: float = 1.2
) -> float:
    """Return the median distance in mm at the teeth between their outlines at a pose and the photographs' edges.

    In a narrow search some edge is always close, even for another person's teeth. So the strongest edge within a wide
    reach counts here, and a point without a clear edge counts with the reach as distance. Outlines between teeth are
    left out.
    """
    distances = []
    for view in views:
        contour, label = tooth_contours(
            view.camera, [_transformed(mesh, pose) for mesh in teeth], [_transformed(mesh, pose) for mesh in occluders]
        )
        if len(contour.pixels) == 0:
            continue
        size_mm = float(np.median(millimetres_a_pixel(view.camera, contour.points_mm)))
        appearance = learn_appearance(view.image, label >= 0, 0.5 * reach_mm / size_mm)
        found = _search_edges(_subsampled(contour), appearance, reach_mm / size_mm)
        off = np.where(found.is_found, np.abs(found.offset_px) * size_mm, reach_mm)
        distances.append(off[~found.contour.between])
    return float(np.median(np.concatenate(distances))) if distances else reach_mm


def _transformed(mesh: Mesh, pose: RigidPose) -> Mesh:
    return Mesh(pose.apply(mesh.vertices_mm), mesh.faces)


def _subsampled(contour: Contour) -> Contour:
    if len(contour.pixels) <= MAX_POINTS:
        return contour
    chosen = np.sort(np.random.default_rng(0).choice(len(contour.pixels), MAX_POINTS, replace=False))
    return Contour(*(getattr(contour, field)[chosen] for field in Contour.__dataclass_fields__))


def _search_edges(contour: Contour, appearance: Appearance, reach_px: float) -> FoundEdges:
    import cv2

    if len(contour.pixels) == 0:
        return FoundEdges(contour, np.zeros(0), np.zeros(0, dtype=bool))
    # Sample along the line across each point, with additional samples at both ends for the differences.
    steps = np.arange(-np.ceil(reach_px / STEP_PX), np.ceil(reach_px / STEP_PX) + 1) * STEP_PX
    padded = np.concatenate([steps[0] - STEP_PX * np.arange(4, 0, -1), steps, steps[-1] + STEP_PX * np.arange(1, 5)])
    place = contour.pixels[:, None] + padded[None, :, None] * contour.outward[:, None] - 0.5
    x, y = (place[..., k].astype(np.float32) for k in range(2))
    likeness, brightness = (
        cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float64)
        for image in (appearance.likeness, appearance.brightness)
    )
    ahead, behind, here = slice(8, None), slice(None, -8), slice(4, -4)
    fall = likeness[:, behind] - likeness[:, ahead]
    valley = brightness[:, ahead] + brightness[:, behind] - 2 * brightness[:, here]
    height, width = appearance.likeness.shape
    outside = (x < 1) | (y < 1) | (x > width - 2) | (y > height - 2)
    near = np.exp(-(steps**2) / (2 * (0.6 * reach_px) ** 2))
    offset, is_found = np.zeros(len(x)), np.zeros(len(x), dtype=bool)
    # On the other side there may be a tooth that the scan does not have, of the other jaw or behind the scan's last.
    contour = replace(contour, between=contour.between | (likeness[:, -1] > OTHER_TOOTH))
    for between, strength in ((False, fall), (True, valley)):
        own = np.flatnonzero(contour.between == between)
        if len(own) == 0:
            continue
        score = np.where(outside[own][:, here], -np.inf, strength[own]) * near
        best = score.argmax(axis=1)
        top = np.take_along_axis(strength[own], best[:, None], axis=1)[:, 0]
        inner = (best > 0) & (best < len(steps) - 1)
        clear = inner & np.isfinite(score.max(axis=1)) & (top > MIN_STRENGTH * np.percentile(top, 90)) & (top > 0)
        offset[own] = steps[best] + STEP_PX * _vertex(strength[own], np.clip(best, 1, len(steps) - 2))
        is_found[own] = clear
    return FoundEdges(contour, offset, is_found)


def _refine_in_light(found: FoundEdges, image: NDArray[np.float32]) -> FoundEdges:
    # A dark line between teeth has the same light on both sides, so its position remains that of the darkest sample.
    contour, offset, is_found = found.contour, found.offset_px.copy(), found.is_found.copy()
    own = np.flatnonzero(is_found & ~contour.between)
    if len(own) == 0:
        return found
    offset[own], is_found[own] = edges_in_light(image, contour.pixels[own], contour.outward[own], offset[own])
    return replace(found, offset_px=offset, is_found=is_found)


def _vertex(strength: Floats, best: NDArray[np.int64]) -> Floats:
    # Return the offset in samples of the vertex of the parabola through three samples.
    left, middle, right = (np.take_along_axis(strength, best[:, None] + k, axis=1)[:, 0] for k in (-1, 0, 1))
    bend = left - 2 * middle + right
    return np.asarray(np.clip(np.where(bend < 0, (left - right) / np.where(bend < 0, 2 * bend, 1.0), 0.0), -1, 1))


def _equations(
    camera: Camera, found: FoundEdges, centre_mm: Floats, shifts_px: Floats
) -> tuple[Floats, Floats, Floats, float]:
    contour = found.contour
    across = np.einsum("nk,nkj->nj", contour.outward, pixel_derivatives(camera, contour.points_mm, centre_mm))
    neighbours = _neighbour_kinds(contour)
    across = np.concatenate([across, np.eye(len(SHIFT_PX))[neighbours]], axis=1)
    residual = np.where(found.is_found, found.offset_px - shifts_px[neighbours], 0.0)
    found_px = np.abs(residual[found.is_found])
    spread = max(robust_sigma(found_px) if len(found_px) else MIN_SPREAD_PX, MIN_SPREAD_PX)
    far = np.clip(np.abs(residual) / (TUKEY * spread), 0, 1)
    weight = found.is_found * (1 - far**2) ** 2 * np.where(contour.between, BETWEEN_WEIGHT, 1.0) / spread**2
    return across, residual, weight, spread


def _neighbour_kinds(contour: Contour) -> NDArray[np.int64]:
    # Return the index (N,) into ``SHIFT_PX`` of the kind of neighbour of each point.
    return np.where(contour.between, 2, contour.gums.astype(np.int64))


def _with_shifts(prior: Floats) -> Floats:
    # Join the prior's inverse covariances of the twist and of the outlines' common shifts.
    shifts = np.diag(1 / np.square(SHIFT_PX))
    return np.block([[prior, np.zeros((len(prior), len(shifts)))], [np.zeros((len(shifts), len(prior))), shifts]])


def _sandwich(
    views: Sequence[View],
    found: Sequence[FoundEdges],
    centre_mm: Floats,
    teeth: int,
    shifts_px: Floats,
    normal: Floats,
    prior: Floats,
) -> Floats:
    # Errors along one part of an outline are correlated in all cameras, so scores are summed over this part before they
    # are squared (cluster-robust covariance). Errors of one side of all teeth in one camera are correlated too, because
    # of the light that falls on it.
    scores, sides = np.zeros((teeth * SECTORS, len(normal))), []
    for view, one in zip(views, found, strict=True):
        jacobian, residual, weight, _ = _equations(view.camera, one, centre_mm, shifts_px)
        angle = np.arctan2(one.contour.outward[:, 1], one.contour.outward[:, 0])
        side = np.floor((angle + np.pi) / (2 * np.pi) * SECTORS).astype(np.int64) % SECTORS
        np.add.at(scores, one.contour.tooth * SECTORS + side, (weight * residual)[:, None] * jacobian)
        together = np.zeros((len(SHIFT_PX) * SECTORS, len(normal)))
        np.add.at(together, _neighbour_kinds(one.contour) * SECTORS + side, weight[:, None] * jacobian)
        sides.append(SIDE_PX * together)
    shared, count = np.concatenate(sides), int(scores.any(axis=1).sum())
    middle = scores.T @ scores * max(count, 7) / (max(count, 7) - 6) + shared.T @ shared
    inverse = np.linalg.inv(normal)
    covariance = np.asarray(inverse @ (middle + _with_shifts(prior)) @ inverse)
    return covariance[: len(prior), : len(prior)]


def _require_edges(found: Sequence[FoundEdges]) -> None:
    total, found_count = sum(len(one.is_found) for one in found), sum(int(one.is_found.sum()) for one in found)
    if total == 0 or found_count < MIN_FOUND * total:
        share = 0.0 if total == 0 else found_count / total
        raise CaptureInputError(
            f"Only {share:.0%} of the teeth's outlines are seen as edges in the photographs; see in the overlay"
            " pictures whether the landmarks put the scan on the teeth, and whether the frames are sharp and bright."
        )
