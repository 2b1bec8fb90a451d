"""A phantom upper jaw: fourteen teeth of average dimensions along an arch, their gums, and the wall of the mouth.

Jaw frame as in ``arch``: x to the patient's left, y forward, z occlusal. Each tooth's canonical frame has y buccal, z
occlusal and x = y × z, which is mesial for the patient's right (11 to 17) and distal for the left (21 to 27), so that
all transforms are rotations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from services.anatomy.distance import SurfaceDistance
from services.anatomy.frame import ToothFrame
from services.anatomy.templates.arch import Arch
from services.anatomy.templates.crown import ToothSolid, build_tooth
from services.anatomy.templates.dimensions import ToothDimensions, upper_tooth
from services.anatomy.templates.gums import Socket, build_cavity, build_gums
from services.core.errors import MeshError
from services.core.geometry import Mesh

RIGHT, LEFT = 10, 20
"""Numbers of the upper quadrants, to which the position is added to give the FDI number."""
POSITIONS = range(1, 8)
"""Positions of the teeth from the midline; there are no third molars."""
GAP_MM = 0.07
"""Smallest distance between neighbours, mm."""
MAX_MOVES = 60
"""Largest number of moves of a tooth along the arch."""
GAP_ERROR_MM = 0.005
"""Largest accepted error of the gap, mm."""
SEPARATION_MM = 1.0
"""Distance between two teeth, in addition to their half widths, before they are moved together, mm."""
SHORT_OF_PLANE_MM = {2: 0.6, 7: 0.3}
"""Distance in mm by which teeth end above the occlusal plane, by position from the midline."""
MIRROR = np.diag([-1.0, 1.0, 1.0])
"""Reflection (3, 3) that exchanges left and right."""

SIZE_SPREAD = 0.05
"""Relative half width of the uniform draw of a subject's size."""
ENAMEL_SPREAD = 0.10
"""Relative half width of the uniform draw of a tooth's enamel thickness."""
TURN_SPREAD_DEG = 4.0
"""Half width of the uniform draw of a tooth's rotation about its axis, degrees."""
TILT_SPREAD_DEG = 2.5
"""Half width of the uniform draws of a tooth's torque and tip, degrees."""
SHIFT_SPREAD_MM = 0.25
"""Half width of the uniform draws of a tooth's forward displacement and of its height, mm."""


@dataclass(frozen=True)
class JawTooth:
    """One tooth in jaw coordinates."""

    fdi: int
    outer: Mesh
    """Outer surface of the enamel, with a root stub."""
    dentin: Mesh
    frame: ToothFrame
    """Canonical frame of the tooth; its world is the jaw frame."""
    cervix_mm: float
    """Height of the cervical line in the canonical frame."""

    @property
    def jaw_from_tooth(self) -> NDArray[np.float64]:
        """Rigid transform (4, 4) from the canonical frame to the jaw frame."""
        pose = np.eye(4)
        pose[:3, :3] = self.frame.rotation.T
        pose[:3, 3] = -self.frame.rotation.T @ self.frame.translation_mm
        return pose


@dataclass(frozen=True)
class Jaw:
    """Teeth from 17 to 27 in their order from the patient's right to the left, gums, and the wall of the mouth."""

    teeth: tuple[JawTooth, ...]
    gums: Mesh
    cavity: Mesh
    """Wall of the mouth, an open surface."""

    def tooth(self, fdi: int) -> JawTooth:
        """Tooth with the given FDI number."""
        return next(tooth for tooth in self.teeth if tooth.fdi == fdi)


@dataclass(frozen=True)
class ToothVariation:
    """Deviation of one tooth from the average."""

    enamel_scale: float = 1.0
    """Thickness of the enamel relative to the average."""
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Rotations about the canonical axes x (torque), y (tip) and z."""
    forward_mm: float = 0.0
    """Displacement out of the arch, towards lips and cheeks."""
    longer_mm: float = 0.0
    """Displacement in the occlusal direction."""


def build_jaw(seed: int | None = None) -> Jaw:
    """Build a subject's upper jaw.

    Args:
        seed: None for the average, which is symmetric; a number for a subject whose size varies by 5 %, enamel by 10 %,
            and whose teeth stand a little askew.
    """
    arch = Arch()
    random = None if seed is None else np.random.default_rng(seed)
    size = 1.0 if random is None else 1 + SIZE_SPREAD * float(random.uniform(-1, 1))
    right = _quadrant(arch, _variations(random), None)
    # Build the left quadrant as a mirrored right one, in contact with the mirrored right central incisor.
    left = right if random is None else _quadrant(arch, _variations(random), _mirrored(right[0][0]))

    sockets = tuple(socket for _, socket in reversed(right)) + tuple(
        replace(socket, arc_mm=-socket.arc_mm) for _, socket in left
    )
    teeth = tuple(tooth for tooth, _ in reversed(right)) + tuple(_mirrored(tooth) for tooth, _ in left)
    gums, cavity = build_gums(arch, sockets), build_cavity(arch, sockets)
    return Jaw(tuple(_grown(tooth, size) for tooth in teeth), _scaled(gums, size), _scaled(cavity, size))


def _variations(random: np.random.Generator | None) -> tuple[ToothVariation, ...]:
    if random is None:
        return tuple(ToothVariation() for _ in POSITIONS)
    tilt, turn = TILT_SPREAD_DEG, TURN_SPREAD_DEG
    draws = random.uniform(-1, 1, (len(POSITIONS), 6)) * [
        ENAMEL_SPREAD,
        tilt,
        tilt,
        turn,
        SHIFT_SPREAD_MM,
        SHIFT_SPREAD_MM,
    ]
    return tuple(
        ToothVariation(1 + enamel, (x, y, z), forward, longer) for enamel, x, y, z, forward, longer in draws.tolist()
    )


def _quadrant(
    arch: Arch, variations: tuple[ToothVariation, ...], first: JawTooth | None
) -> list[tuple[JawTooth, Socket]]:
    # Starting at the midline, move each tooth along the arch until it almost touches the tooth before it. The first
    # tooth is moved to the midline's plane if it has no neighbour.
    placed: list[tuple[JawTooth, Socket]] = []
    neighbour = None if first is None else SurfaceDistance(_far_half(first))
    arc_mm = 0.0
    for position, variation in zip(POSITIONS, variations, strict=True):
        d = upper_tooth(position)
        solid = build_tooth(d, variation.enamel_scale)
        arc_mm -= d.md_crown_mm / 2 + SEPARATION_MM
        facing = solid.outer.vertices_mm[solid.outer.vertices_mm[:, 0] > d.md_crown_mm / 4]
        frame, gap_error_mm = _upright_frame(arch, arc_mm, solid, d, variation), SEPARATION_MM
        for _ in range(MAX_MOVES):
            if abs(gap_error_mm) < GAP_ERROR_MM:
                break
            points = frame.world_from_canonical(facing)
            gap_error_mm = float(
                -points[:, 0].max() - GAP_MM / 2 if neighbour is None else neighbour.smallest_mm(points) - GAP_MM
            )
            # Move by a little less than the gap, because turning with the arch may bring a corner nearer than the move.
            arc_mm += 0.85 * gap_error_mm
            frame = _upright_frame(arch, arc_mm, solid, d, variation)
        else:
            raise MeshError(
                f"Tooth {RIGHT + position} finds no place beside its neighbour along the arch; give it a smaller"
                " variation."
            )
        tooth = _posed(solid, frame, RIGHT + position)
        neighbour = SurfaceDistance(_far_half(tooth))
        cervix_z_mm = float(frame.world_from_canonical(np.array([[0.0, 0.0, solid.cervix_mm]]))[0, 2])
        curvature_mm = (d.curvature_mesial_mm + d.curvature_distal_mm) / 2
        placed.append((tooth, Socket(arc_mm, d.md_crown_mm, cervix_z_mm, d.ll_cervix_mm / 2, curvature_mm)))
        arc_mm -= d.md_crown_mm / 2
    return placed


def _upright_frame(
    arch: Arch, arc_mm: float, solid: ToothSolid, d: ToothDimensions, variation: ToothVariation
) -> ToothFrame:
    # Frame of a tooth that stands upright on the arch with its tip on the occlusal plane, then turned about its middle.
    from scipy.spatial.transform import Rotation

    at = np.array([arc_mm])
    point, outward, mesial = arch.points_mm(at)[0], arch.outward(at)[0], arch.tangents(at)[0]
    upright = np.array([[*mesial, 0.0], [*outward, 0.0], [0.0, 0.0, 1.0]])
    rotation = Rotation.from_euler("xyz", variation.turn_deg, degrees=True).as_matrix().T @ upright
    tip_mm = float(solid.outer.vertices_mm[:, 2].max())
    height = variation.longer_mm - SHORT_OF_PLANE_MM.get(d.position, 0.0) - tip_mm
    origin = np.append(point + variation.forward_mm * outward, height)
    return ToothFrame(rotation, -rotation @ origin)


def _posed(solid: ToothSolid, frame: ToothFrame, fdi: int) -> JawTooth:
    outer, dentin = (
        Mesh(frame.world_from_canonical(mesh.vertices_mm), mesh.faces) for mesh in (solid.outer, solid.dentin)
    )
    return JawTooth(fdi, outer, dentin, frame, solid.cervix_mm)


def _far_half(tooth: JawTooth) -> Mesh:
    # Side of the crown that the next tooth on the right touches: a right tooth's distal side, or across the midline the
    # mesial side.
    canonical = tooth.frame.canonical_from_world(tooth.outer.vertices_mm)
    kept = (canonical[:, 0] < 0) & (canonical[:, 2] > tooth.cervix_mm)
    return Mesh(tooth.outer.vertices_mm, tooth.outer.faces[kept[tooth.outer.faces].all(axis=1)])


def _mirrored(tooth: JawTooth) -> JawTooth:
    # Mirror a tooth to the patient's other side. The frame's x axis changes from mesial to distal, so that the frame
    # stays right-handed.
    outer, dentin = (
        Mesh(mesh.vertices_mm @ MIRROR, mesh.faces[:, ::-1].copy()) for mesh in (tooth.outer, tooth.dentin)
    )
    frame = ToothFrame(MIRROR @ tooth.frame.rotation @ MIRROR, MIRROR @ tooth.frame.translation_mm)
    return JawTooth(tooth.fdi - RIGHT + LEFT, outer, dentin, frame, tooth.cervix_mm)


def _grown(tooth: JawTooth, size: float) -> JawTooth:
    frame = replace(tooth.frame, translation_mm=size * tooth.frame.translation_mm)
    return JawTooth(tooth.fdi, _scaled(tooth.outer, size), _scaled(tooth.dentin, size), frame, size * tooth.cervix_mm)


def _scaled(mesh: Mesh, size: float) -> Mesh:
    return Mesh(size * mesh.vertices_mm, mesh.faces)
