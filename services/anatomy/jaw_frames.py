"""Canonical frames of teeth with known FDI numbers: of a single tooth from its shape, of several teeth from the arch
that they form and from their shapes.

A tooth's shape is compared with the average tooth of its kind (``matching``). The shape determines the occlusal
direction of a crown with some root to a few degrees, but hardly distinguishes buccal from lingual where cusps are
alike. In that case the buccal side of a single tooth is turned towards the cameras, and that of a tooth in a jaw out of
the arch.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from services.anatomy.frame import ToothFrame
from services.anatomy.scans.matching import CrownMatch
from services.anatomy.scans.patches import middle_mm
from services.anatomy.templates.average_arch import arch_from_middles, is_upper, nominal_positions
from services.core.geometry import Tooth

Array = NDArray[np.float64]

START_ROTATIONS = 576
"""Number of rotations from which a single tooth is matched; they are about 20 degrees apart."""
REFINED_ROTATIONS = 40
"""Number of the best rotations after the coarse match that are matched closely."""
COARSE, MEDIUM, CLOSE = (80, 4), (80, 6), (300, 20)
"""Number of points of the average crown and of rounds of closest points: for the match from every rotation, for the
rotations of an arch, and for the final match."""
VIEW_MM = 0.4
"""Misfit in mm that is added to a tooth with its back to the cameras. The misfit of real crowns with roots is 1.0 to
1.4 mm; exchanging front and back adds -0.05 to 0.35 mm, and turning upside down 0.4 to 0.7 mm."""
ARCH_ROTATIONS = 24
"""Number of rotations of the arch about the line through the teeth's middles. Four front teeth, or those of one side,
hardly leave this line, so their middles do not determine the rotation about it."""
WORST_ARCH_MM = 6.0
"""Largest excess, mm, of a rotation's misfit of the teeth's middles over that of the best rotation."""
ARCH_SHARE = 0.25
"""Weight of the misfit of the middles relative to that of the shapes: real arches are some millimetres wider or
narrower."""
FREE_DRIFT_DEG = 15.0
"""Angle by which a tooth's match may deviate from the arch at no cost: half a step between rotations, and the variation
of teeth in an arch."""
DRIFT_MM_PER_DEG = 1 / 30
"""Misfit added for each degree beyond ``FREE_DRIFT_DEG``, mm."""
MAX_DEVIATION_FROM_ARCH_DEG = 40.0
"""Largest angle between a tooth's own match and the arch. Upper incisors lean by 20 degrees and last molars by 30; a
match that deviates more is replaced by the arch's axes."""


def tooth_frame(tooth: Tooth, viewpoints_mm: Array) -> ToothFrame:
    """Find the canonical frame of a single tooth.

    With some root the axes are accurate to about 10 degrees. The axes of a premolar's or molar's bare crown, which is
    as wide as it is high, may be found as if the crown lay on its side.

    Args:
        tooth: the tooth with its FDI number.
        viewpoints_mm: camera centres (N, 3).
    """
    match = CrownMatch(tooth.fdi, tooth.outer)
    view = (viewpoints_mm - _box_middle_mm(tooth)).mean(axis=0)
    view /= np.linalg.norm(view)
    coarse = match.register(_even_rotations(START_ROTATIONS), *COARSE)
    close = match.register(coarse.axes[np.argsort(coarse.misfits_mm)[:REFINED_ROTATIONS]], *CLOSE)
    misfits = close.misfits_mm + match.reverse_misfits_mm(close) + VIEW_MM * (1 - close.axes[:, 1] @ view) / 2
    return ToothFrame.centred(close.axes[misfits.argmin()], tooth.outer)


def jaw_frames(teeth: Sequence[Tooth], viewpoints_mm: Array) -> tuple[ToothFrame, ...]:
    """Find the canonical frames of some or all teeth of the upper jaw, the lower jaw or both.

    Args:
        teeth: teeth with their FDI numbers.
        viewpoints_mm: camera centres (N, 3); they are used only for a tooth that is the only one of its jaw.
    """
    frames: dict[int, ToothFrame] = {}
    for upper in (True, False):
        own = [k for k, tooth in enumerate(teeth) if is_upper(tooth.fdi) == upper]
        if len(own) == 1:
            frames[own[0]] = tooth_frame(teeth[own[0]], viewpoints_mm)
        elif own:
            frames |= zip(own, _arch_frames([teeth[k] for k in own]), strict=True)
    return tuple(frames[k] for k in range(len(teeth)))


def _arch_frames(teeth: Sequence[Tooth]) -> list[ToothFrame]:
    # Find the arch's rotation first: of the rotations about the line of middles, the one in which middles and shapes
    # are nearest to those of the average.
    numbers, matches = tuple(tooth.fdi for tooth in teeth), [CrownMatch(tooth.fdi, tooth.outer) for tooth in teeth]
    middles = np.array([middle_mm(tooth.outer) for tooth in teeth])
    nominal, nominal_axes = nominal_positions(numbers)
    rotations, misfits = _arch_rotations(
        arch_from_middles(numbers, middles), middles - middles.mean(axis=0), nominal - nominal.mean(axis=0)
    )
    misfits = ARCH_SHARE * misfits
    for match, axes in zip(matches, nominal_axes, strict=True):
        placed = match.register(axes @ rotations, *MEDIUM)
        drift = np.maximum(_angles_deg(placed.axes, axes @ rotations) - FREE_DRIFT_DEG, 0.0)
        misfits = misfits + (placed.misfits_mm + match.reverse_misfits_mm(placed) + DRIFT_MM_PER_DEG * drift) / len(
            teeth
        )
    arch = rotations[misfits.argmin()]

    # Then turn each tooth to where its own shape is nearest to that of the average.
    frames = []
    for tooth, match, axes in zip(teeth, matches, nominal_axes, strict=True):
        own = match.register((axes @ arch)[None], *CLOSE).axes[0]
        near = _angles_deg(own[None], (axes @ arch)[None])[0] <= MAX_DEVIATION_FROM_ARCH_DEG
        frames.append(ToothFrame.centred(own if near else axes @ arch, tooth.outer))
    return frames


def _arch_rotations(best: Array, middles_mm: Array, nominal_mm: Array) -> tuple[Array, Array]:
    # Rotations (K, 3, 3) into the arch's frame, and for each the root mean square distance (K,) in mm of the middles
    # from those of the average.
    from scipy.spatial.transform import Rotation

    line = np.linalg.svd(middles_mm, full_matrices=False)[2][0]
    rotations = (
        best
        @ Rotation.from_rotvec(np.linspace(0, 2 * np.pi, ARCH_ROTATIONS, endpoint=False)[:, None] * line).as_matrix()
    )
    misfits = np.sqrt(((np.einsum("kij,nj->kni", rotations, middles_mm) - nominal_mm) ** 2).sum(axis=2).mean(axis=1))
    near = misfits < misfits.min() + WORST_ARCH_MM
    return rotations[near], misfits[near]


def _even_rotations(count: int) -> Array:
    # Rotations (count, 3, 3) on a super-Fibonacci spiral of unit quaternions (Alexa 2022).
    from scipy.spatial.transform import Rotation

    at = np.arange(count) + 0.5
    inner, outer = np.sqrt(at / count), np.sqrt(1 - at / count)
    one, two = 2 * np.pi * at / np.sqrt(2), 2 * np.pi * at / 1.533751168755204288118041
    quaternions = np.stack(
        [inner * np.sin(one), inner * np.cos(one), outer * np.sin(two), outer * np.cos(two)], axis=-1
    )
    return np.asarray(Rotation.from_quat(quaternions).as_matrix())


def _angles_deg(one: Array, two: Array) -> Array:
    # Angles (N,) of the rotations between axes (N, 3, 3) and (N, 3, 3).
    cosine = (np.einsum("nij,nij->n", one, two) - 1) / 2
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def _box_middle_mm(tooth: Tooth) -> Array:
    return np.asarray((tooth.outer.vertices_mm.min(axis=0) + tooth.outer.vertices_mm.max(axis=0)) / 2)
