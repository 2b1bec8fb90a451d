"""The mouth of a virtual laboratory: the six upper front teeth of a subject, the gums, lips and a retractor, and a scan
of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.anatomy.scans.scan import LabelledScan
from services.anatomy.templates.jaw import build_jaw
from services.core.geometry import Mesh, Tooth
from services.phantom.lab.scan import scan_of, write_labelled_ply
from services.phantom.lips import lips_and_retractor

Floats = NDArray[np.float64]
TEETH_A_SIDE = 3
"""Number of teeth on each side of the midline."""
FITTED = 11
"""FDI number of the tooth whose optics are measured."""
SCAN_NOISE_MM = 0.02
"""Standard deviation of each coordinate of the scan, mm."""
SCAN_ROTATION_RAD, SCAN_SHIFT_MM = 1.0, 30.0
"""Half widths of the uniform draws of rotation vector and translation between the scan's frame and the mouth's."""


@dataclass(frozen=True)
class LabMouth:
    """True surfaces in the world of the rig, whose origin is the middle of the crowns.

    Attributes:
        teeth: the tooth that is measured, then the others from the patient's right to the left, with their dentin and
            with root stubs that end in the gums.
        gums: the solid that holds the roots of the whole jaw.
        shown_gums: the part of its surface that lips and cheeks do not hide.
        lips: lips and retractor.
        scan: scan of the teeth in a frame of its own.
        world_from_scan: rigid transform (4, 4).
    """

    teeth: tuple[Tooth, ...]
    gums: Mesh
    shown_gums: Mesh
    lips: Mesh
    scan: LabelledScan
    world_from_scan: Floats

    @property
    def fitted(self) -> Tooth:
        """The tooth that is measured."""
        return self.teeth[0]


def true_mouth(subject: int | None, seed: int) -> LabMouth:
    """Build a mouth.

    Args:
        subject: seed of the subject's teeth; None for the average.
        seed: seed of the scan's noise and frame.
    """
    from scipy.spatial.transform import Rotation

    jaw = build_jaw(subject)
    own = sorted(
        (tooth for tooth in jaw.teeth if tooth.fdi % 10 <= TEETH_A_SIDE), key=lambda tooth: tooth.fdi != FITTED
    )
    crowns = np.concatenate([tooth.outer.vertices_mm for tooth in own])
    shift = -(crowns.min(axis=0) + crowns.max(axis=0)) / 2
    shift[1] = -np.quantile(crowns[:, 1], 0.9)
    teeth = tuple(Tooth(one.fdi, _moved(one.outer, shift), _moved(one.dentin, shift)) for one in own)
    gums = _moved(jaw.gums, shift)

    random = np.random.default_rng([seed, 0x5CA])
    scan = scan_of(jaw, SCAN_NOISE_MM, seed, TEETH_A_SIDE)
    rotation = Rotation.from_rotvec(random.uniform(-SCAN_ROTATION_RAD, SCAN_ROTATION_RAD, 3)).as_matrix()
    translation = random.uniform(-SCAN_SHIFT_MM, SCAN_SHIFT_MM, 3)
    vertices = (scan.mesh.vertices_mm + shift) @ rotation.T + translation
    world_from_scan = np.eye(4)
    world_from_scan[:3, :3], world_from_scan[:3, 3] = rotation.T, -rotation.T @ translation
    return LabMouth(
        teeth,
        gums,
        _near(gums, float(min(tooth.outer.vertices_mm[:, 1].min() for tooth in teeth))),
        lips_and_retractor([tooth.outer for tooth in teeth]),
        LabelledScan(Mesh(vertices, scan.mesh.faces), scan.fdi),
        world_from_scan,
    )


def landmarks_mm(mouth: LabMouth) -> dict[tuple[int, str], Floats]:
    """Points (3,) of the scan that an operator clicks on, by tooth and name.

    They are each tooth's most occlusal point ("edge") and the most apical point of its front at mid-width ("neck").
    """
    found = {}
    world = mouth.scan.mesh.vertices_mm @ mouth.world_from_scan[:3, :3].T + mouth.world_from_scan[:3, 3]
    for tooth in mouth.teeth:
        own = np.unique(mouth.scan.mesh.faces[mouth.scan.fdi == tooth.fdi])
        front = own[world[own, 1] > np.median(world[own, 1])]
        # Look for the neck in the tooth's middle only, because it rises towards the neighbouring teeth.
        middle = front[np.abs(world[front, 0] - np.median(world[front, 0])) < 1.0]
        for name, vertex in (("edge", own[world[own, 2].argmax()]), ("neck", middle[world[middle, 2].argmin()])):
            found[tooth.fdi, name] = mouth.scan.mesh.vertices_mm[vertex]
    return found


def write_scan(path: Path, mouth: LabMouth) -> None:
    """Write the scan in a format that scanning software exports, a labelled PLY."""
    write_labelled_ply(path, mouth.scan.mesh, mouth.scan.fdi)


def _near(gums: Mesh, behind_mm: float) -> Mesh:
    # Cut off the gums behind the last teeth, where lips and cheeks would hide them.
    kept = gums.vertices_mm[gums.faces].mean(axis=1)[:, 1] > behind_mm
    return Mesh(gums.vertices_mm, gums.faces[kept])


def _moved(mesh: Mesh, by_mm: Floats) -> Mesh:
    return Mesh(mesh.vertices_mm + by_mm, mesh.faces)
