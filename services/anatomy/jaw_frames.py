"""Canonical frames of teeth whose FDI numbers are known: of one from its shape, of several from the arch that they form
and from each one's shape.

The shape is compared with the average tooth of its kind (``matching``). It tells the occlusal direction of a crown with
some root to a few degrees, but hardly buccal from lingual where cusps are alike; there a single tooth turns towards the
cameras and the tooth of a jaw out of the arch.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from services.anatomy.frame import ToothFrame
from services.anatomy.scans.matching import CrownMatch
from services.anatomy.scans.patches import middle_mm
from services.anatomy.templates.average_arch import arch_from_middles, is_upper, nominal_places
from services.anatomy.templates.dimensions import upper_tooth
from services.core.geometry import Tooth

Array = NDArray[np.float64]

TURNS = 576
"""From which a tooth alone is matched: about 20 degrees apart."""
KEPT = 40
"""Of these, that are matched closely."""
COARSE, MEDIUM, CLOSE = (80, 4), (80, 6), (300, 20)
"""Points of the average crown and rounds of closest points: from every turn, for the turns of an arch, and to the
end."""
VIEW_MM = 0.4
"""Misfit that a tooth is given for turning its back to the cameras. Misfits come to 1.0 to 1.4 mm on real crowns with
roots; the same crown with its front for its back adds -0.05 to 0.35, one upside down 0.4 to 0.7."""
ARCH_TURNS = 24
"""About the line of the teeth's middles: four front teeth, or those of one side, hardly leave it."""
WORST_ARCH_MM = 6.0
"""How much more than the best of these turns may bring the teeth's middles off an average arch's."""
ARCH_SHARE = 0.25
"""Misfit of shape that the same misfit of middles counts as: real arches are some millimetres wider or narrower."""
FREE_DRIFT_DEG = 15.0
"""By which a tooth's match may turn away from the arch's at no cost: half a step between turns, and how teeth stand in
an arch."""
DRIFT_MM_PER_DEG = 1 / 30
DOUBTFUL_MM, MUCH_LESS = 0.8, 0.5
"""Misfit, both ways, from which a tooth's number is doubted, and the share of it that another kind must come to.
Phantom teeth come to 0.3 by their own kind and to 1.1 to 1.5 by another family's; real bare crowns to 1.6 whichever
kind they are compared with, and nothing can be said of them."""
KINDS = (1, 3, 4, 6)
"""Places from the midline that stand for their families."""
KEPT_OF_KIND = 8
LARGEST_OWN_TURN_DEG = 40.0
"""Of a tooth's own match against the arch: upper incisors lean by 20 degrees, last molars by 30; beyond, the arch is
believed."""


def tooth_frame(tooth: Tooth, viewpoints_mm: Array) -> ToothFrame:
    """Canonical frame of a single tooth.

    With some root its axes are found to within 10 degrees or so; a bare crown of a premolar or molar, which is as wide
    as it is high, may be taken for one that lies on its side.

    Args:
        viewpoints_mm: camera centres (N, 3).
    """
    match = CrownMatch(tooth.fdi, tooth.outer)
    view = (viewpoints_mm - _box_middle_mm(tooth)).mean(axis=0)
    view /= np.linalg.norm(view)
    coarse = match.settled(_even_turns(TURNS), *COARSE)
    close = match.settled(coarse.axes[np.argsort(coarse.misfits_mm)[:KEPT]], *CLOSE)
    misfits = close.misfits_mm + match.reverse_misfits_mm(close) + VIEW_MM * (1 - close.axes[:, 1] @ view) / 2
    return ToothFrame.centred(close.axes[misfits.argmin()], tooth.outer)


def number_told(tooth: Tooth) -> str:
    """A sentence where a tooth clearly has the shape of another kind than its FDI number says; else nothing."""
    own_mm = _misfit_mm(tooth, tooth.fdi)
    if own_mm < DOUBTFUL_MM:
        return ""
    place = tooth.fdi % 10
    misfits_mm = {other: _misfit_mm(tooth, tooth.fdi - place + other) for other in KINDS if other != place}
    likest = min(misfits_mm, key=lambda other: misfits_mm[other])
    if misfits_mm[likest] > MUCH_LESS * own_mm:
        return ""
    shape, named = upper_tooth(likest).name, upper_tooth(place).name
    return (
        f"Tooth {tooth.fdi} is shaped like a {shape} and not like a {named}; give its right FDI number, as dentin's"
        " shape follows from it."
    )


def _misfit_mm(tooth: Tooth, fdi: int) -> float:
    match = CrownMatch(fdi, tooth.outer)
    coarse = match.settled(_even_turns(TURNS), *COARSE)
    close = match.settled(coarse.axes[np.argsort(coarse.misfits_mm)[:KEPT_OF_KIND]], *CLOSE)
    return float((close.misfits_mm + match.reverse_misfits_mm(close)).min())


def jaw_frames(teeth: Sequence[Tooth], viewpoints_mm: Array) -> tuple[ToothFrame, ...]:
    """Canonical frames of a jaw's teeth: some or all, of the upper jaw, the lower one or both.

    Args:
        viewpoints_mm: camera centres (N, 3); they count for the only tooth of its jaw.
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
    # The arch's pose first: of the turns about the line of middles, the one in which middles and shapes are nearest to
    # the average's.
    numbers, matches = tuple(tooth.fdi for tooth in teeth), [CrownMatch(tooth.fdi, tooth.outer) for tooth in teeth]
    middles = np.array([middle_mm(tooth.outer) for tooth in teeth])
    nominal, nominal_axes = nominal_places(numbers)
    turns, misfits = _arch_turns(
        arch_from_middles(numbers, middles), middles - middles.mean(axis=0), nominal - nominal.mean(axis=0)
    )
    misfits = ARCH_SHARE * misfits
    for match, axes in zip(matches, nominal_axes, strict=True):
        placed = match.settled(axes @ turns, *MEDIUM)
        drift = np.maximum(_angles_deg(placed.axes, axes @ turns) - FREE_DRIFT_DEG, 0.0)
        misfits = misfits + (placed.misfits_mm + match.reverse_misfits_mm(placed) + DRIFT_MM_PER_DEG * drift) / len(
            teeth
        )
    arch = turns[misfits.argmin()]

    # From there each tooth turns to where its own shape is nearest to the average's.
    frames = []
    for tooth, match, axes in zip(teeth, matches, nominal_axes, strict=True):
        own = match.settled((axes @ arch)[None], *CLOSE).axes[0]
        near = _angles_deg(own[None], (axes @ arch)[None])[0] <= LARGEST_OWN_TURN_DEG
        frames.append(ToothFrame.centred(own if near else axes @ arch, tooth.outer))
    return frames


def _arch_turns(best: Array, middles_mm: Array, nominal_mm: Array) -> tuple[Array, Array]:
    # Rotations (K, 3, 3) into the arch's frame, and how far each leaves the middles off the average's, root mean
    # square, mm.
    from scipy.spatial.transform import Rotation

    line = np.linalg.svd(middles_mm, full_matrices=False)[2][0]
    turns = (
        best @ Rotation.from_rotvec(np.linspace(0, 2 * np.pi, ARCH_TURNS, endpoint=False)[:, None] * line).as_matrix()
    )
    misfits = np.sqrt(((np.einsum("kij,nj->kni", turns, middles_mm) - nominal_mm) ** 2).sum(axis=2).mean(axis=1))
    near = misfits < misfits.min() + WORST_ARCH_MM
    return turns[near], misfits[near]


def _even_turns(count: int) -> Array:
    # Super-Fibonacci spiral of unit quaternions (Alexa 2022).
    from scipy.spatial.transform import Rotation

    at = np.arange(count) + 0.5
    inner, outer = np.sqrt(at / count), np.sqrt(1 - at / count)
    one, two = 2 * np.pi * at / np.sqrt(2), 2 * np.pi * at / 1.533751168755204288118041
    quaternions = np.stack(
        [inner * np.sin(one), inner * np.cos(one), outer * np.sin(two), outer * np.cos(two)], axis=-1
    )
    return np.asarray(Rotation.from_quat(quaternions).as_matrix())


def _angles_deg(one: Array, two: Array) -> Array:
    # Of the rotations between axes (N, 3, 3) and (N, 3, 3).
    cosine = (np.einsum("nij,nij->n", one, two) - 1) / 2
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def _box_middle_mm(tooth: Tooth) -> Array:
    return np.asarray((tooth.outer.vertices_mm.min(axis=0) + tooth.outer.vertices_mm.max(axis=0)) / 2)
