"""A jaw of solids from a labelled scan, in arch coordinates: x along the front teeth, y to the front, z occlusal, with
the origin in the arch's middle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from services.anatomy.frame import ToothFrame
from services.anatomy.scans.patches import (
    areas_mm2,
    boundary_loops,
    compact,
    fill_holes,
    manifold_piece,
    middle_mm,
    smooth_borders,
    smooth_labels,
    touching_pieces,
    vector_area_mm2,
    without_specks,
)
from services.anatomy.scans.roots import STUB, Root, close_crown, whole_root
from services.anatomy.scans.scan import LabelledScan
from services.anatomy.scans.scanned_gums import gums_solid
from services.anatomy.scans.segmentation import GINGIVA, MIN_SPREAD_RATIO
from services.anatomy.templates.average_arch import nominal_positions, side_of_front
from services.core.errors import CaptureInputError
from services.core.geometry import Mesh, Tooth

LARGEST_SHARE = 0.8
"""Smallest fraction of a tooth's area that must be in one piece; the rest is taken for specks."""
SMALLEST_CROWN_MM2 = 15.0
"""Smallest area of a crown, mm²; a lower incisor shows about 100, an erupting one about 20."""
STEEPEST_TILT_DEG = 25.0
"""Largest angle between a tooth's axis and the arch's normal; upper front teeth lean to the front by about this
angle."""


@dataclass(frozen=True)
class Repairs:
    """Repairs of a scan's surface."""

    doubled_vertices: int
    """Number of vertices that were joined with others at the same place."""
    unused_vertices: int
    """Number of vertices that no triangle used and that were left out."""
    removed_triangles: int
    """Number of removed triangles: degenerate, duplicate, at an edge with more than two, or apart from the jaw."""
    holes_mm: tuple[float, ...]
    """Circumferences of the holes that were closed, the longest first."""

    def sentence(self) -> str:
        """Describe the repairs in one sentence for a report."""
        unused = f"{self.unused_vertices} vertices that no triangle uses left out, " if self.unused_vertices else ""
        holes = f"{len(self.holes_mm)} holes closed" + (
            f" (the longest {self.holes_mm[0]:.1f} mm around)" if self.holes_mm else ""
        )
        return (
            f"{self.doubled_vertices} doubled vertices joined, {unused}{self.removed_triangles} triangles removed that"
            f" did not belong to one plain surface, {holes}."
        )


@dataclass(frozen=True)
class ScannedJaw:
    """Solids in arch coordinates, mm.

    Teeth overlap the gums, which contain their roots. The roots and the base of the gums are assumed, not scanned.
    """

    teeth: tuple[Tooth, ...]
    frames: tuple[ToothFrame, ...]
    """Canonical frame of each tooth: y buccal, z occlusal and x = y × z, which is mesial in the quadrants 1 and 3 and
    distal in 2 and 4."""
    gums: Mesh
    arch_from_scan: NDArray[np.float64]
    """Rigid transform (4, 4) from the scan's coordinates to arch coordinates."""
    repairs: Repairs


def jaw_from_scan(scan: LabelledScan, roots: Literal["stub", "whole"] = "stub") -> ScannedJaw:
    """Close every crown and the gums of a scan.

    Args:
        scan: labelled scan of one jaw.
        roots: a stub of 4 mm, beyond which light that a camera sees does not reach, or a root of average length for the
            tooth's kind.

    Raises:
        CaptureInputError: a label is too small or in several pieces, left and right are exchanged, or the scan is
            inside out. MeshError: a part cannot be closed.
    """
    _require_whole_teeth(scan)
    surface, labels, repairs = _clean(scan)
    crowns = {number: compact(Mesh(surface.vertices_mm, surface.faces[labels == number])) for number in scan.teeth}
    middles = np.array([middle_mm(crown) for crown in crowns.values()])
    _require_outward(surface, labels)
    rotation = _arch_axes(scan.teeth, surface, middles)
    turned = surface.vertices_mm @ rotation.T
    shift = -(turned.min(axis=0) + turned.max(axis=0)) / 2

    # Continue in arch coordinates.
    surface = Mesh(turned + shift, surface.faces)
    crowns = {number: Mesh(crown.vertices_mm @ rotation.T + shift, crown.faces) for number, crown in crowns.items()}
    axes = _tooth_axes(scan.teeth, crowns, middles @ rotation.T + shift)
    teeth = tuple(
        Tooth(number, close_crown(crowns[number], axes[number][2], f"tooth {number}", _root(number, roots)))
        for number in scan.teeth
    )
    deepest = min(float(tooth.outer.vertices_mm[:, 2].min()) for tooth in teeth)
    gums = gums_solid(surface, labels == GINGIVA, np.array([0.0, 0.0, 1.0]), deepest)
    frames = tuple(ToothFrame.centred(axes[tooth.fdi], tooth.outer) for tooth in teeth)
    arch_from_scan = np.block([[rotation, shift[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
    return ScannedJaw(teeth, frames, gums, arch_from_scan, repairs)


def _root(fdi: int, roots: Literal["stub", "whole"]) -> Root:
    return whole_root(fdi) if roots == "whole" else STUB


def _require_outward(surface: Mesh, labels: NDArray[np.int64]) -> None:
    # Check that crowns rise above the gingiva at their necks along the surface's mean normal; in a mirror image they
    # would lie below.
    crowns, gingiva = (Mesh(surface.vertices_mm, surface.faces[keep]) for keep in (labels > 0, labels == GINGIVA))
    neck = np.intersect1d(crowns.faces, gingiva.faces)
    rise = (middle_mm(crowns) - surface.vertices_mm[neck].mean(axis=0)) @ _unit(vector_area_mm2(surface))
    if rise < 0:
        raise CaptureInputError(
            "The scan is inside out or a mirror image: its teeth point into the gums; "
            "turn its triangles around, or mirror the scan back, and export it again."
        )


def _require_whole_teeth(scan: LabelledScan) -> None:
    area = areas_mm2(scan.mesh)
    for number in scan.teeth:
        own = scan.fdi == number
        if area[own].sum() < SMALLEST_CROWN_MM2:
            raise CaptureInputError(
                f"The label of tooth {number} covers {area[own].sum():.2g} mm², less than any tooth shows; "
                "label the tooth, or give the label's triangles to what they are of."
            )
        size = np.bincount(touching_pieces(scan.mesh.faces[own]), weights=area[own])
        if size.max() < LARGEST_SHARE * size.sum():
            raise CaptureInputError(
                f"The label of tooth {number} is in {len(size)} pieces, the largest {size.max() / size.sum():.0%} of"
                " its area; relabel the scan so that it is one."
            )


def _clean(scan: LabelledScan) -> tuple[Mesh, NDArray[np.int64], Repairs]:
    # Manifold surface with one rim, its labels without specks and with smooth borders, and the repairs.
    kept = manifold_piece(scan.mesh)
    labels = scan.fdi[kept]
    missing = set(scan.teeth) - set(labels.tolist())
    if missing or not (labels == GINGIVA).any():
        what = f"tooth {min(missing)}" if missing else "the gingiva"
        raise CaptureInputError(
            f"In the scan {what} hangs together with nothing else; export one connected surface of the jaw."
        )
    surface = compact(Mesh(scan.mesh.vertices_mm, scan.mesh.faces[kept]))
    holes_mm = sorted(
        (_length_mm(surface.vertices_mm[loop]) for loop in boundary_loops(surface.faces)[1:]), reverse=True
    )
    repairs = Repairs(scan.doubled_vertices, scan.unused_vertices, int(np.count_nonzero(~kept)), tuple(holes_mm))
    surface, sources = fill_holes(surface)
    labels = np.concatenate([labels, labels[sources]])
    labels = without_specks(surface, smooth_labels(surface.faces, labels))
    return smooth_borders(surface, labels), labels, repairs


def _length_mm(loop_mm: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(np.roll(loop_mm, -1, axis=0) - loop_mm, axis=1).sum())


def _arch_axes(teeth: tuple[int, ...], surface: Mesh, middles: NDArray[np.float64]) -> NDArray[np.float64]:
    # Take the normal of the plane through the crowns' middles as the occlusal axis. If the crowns lie in a line, the
    # normal of the scan's rim determines the rotation about that line.
    opening = vector_area_mm2(surface)
    _, spread, principal = np.linalg.svd(middles - middles.mean(axis=0), full_matrices=False)
    plane = len(teeth) > 2 and spread[1] > MIN_SPREAD_RATIO * spread[0]
    occlusal = principal[2] if plane else opening - (opening @ principal[0]) * principal[0]
    occlusal = _unit(occlusal * np.sign(occlusal @ opening))

    # Find the rotation about this axis that brings the crowns nearest to an average arch. They must not be clearly
    # nearer to a mirrored arch.
    side = np.linalg.svd(occlusal[None])[2][1]
    across = np.stack([side, np.cross(occlusal, side)])
    projected = (middles - middles.mean(axis=0)) @ across.T
    nominal = nominal_positions(teeth)[0][:, :2]
    nominal -= nominal.mean(axis=0)
    measured_plane, nominal_plane = projected @ (1, 1j), nominal @ (1, 1j)
    match, mirrored = np.vdot(nominal_plane, measured_plane), np.vdot(nominal_plane.conj(), measured_plane)
    if abs(mirrored) > abs(match) * (1 + 1e-3) and len(teeth) > 2 and plane:
        raise CaptureInputError(
            "The scan's teeth run the wrong way around the arch; exchange left and right in its labels, or mirror the"
            " scan back."
        )
    front = match / abs(match)
    x = front.real * across[0] + front.imag * across[1]
    return np.stack([x, np.cross(occlusal, x), occlusal])


def _tooth_axes(
    teeth: tuple[int, ...], crowns: dict[int, Mesh], middles: NDArray[np.float64]
) -> dict[int, NDArray[np.float64]]:
    order = sorted(range(len(teeth)), key=lambda k: side_of_front(teeth[k]) * (teeth[k] % 10))
    tangents = np.gradient(middles[order], axis=0)
    upward, axes = np.array([0.0, 0.0, 1.0]), {}
    for k, tangent in zip(order, tangents, strict=True):
        # Halve the tilt of the crown's opening: a cervical line rises between teeth and lies deepest in front, so its
        # normal leans about twice as far as the tooth.
        occlusal = _unit(_unit(vector_area_mm2(crowns[teeth[k]])) + upward)
        tilt = np.arccos(occlusal @ upward)
        if tilt > np.radians(STEEPEST_TILT_DEG):
            tilt_direction = _unit(occlusal - (occlusal @ upward) * upward)
            occlusal = (
                np.cos(np.radians(STEEPEST_TILT_DEG)) * upward + np.sin(np.radians(STEEPEST_TILT_DEG)) * tilt_direction
            )
        buccal = _unit(np.cross(occlusal, tangent))
        axes[teeth[k]] = np.stack([np.cross(buccal, occlusal), buccal, occlusal])
    return axes


def _unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(vector / np.linalg.norm(vector))
