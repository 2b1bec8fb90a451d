"""Surroundings of the teeth of an upper jaw: the gums, a solid along the arch, and the wall of the mouth behind it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from services.anatomy.templates.arch import Arch
from services.anatomy.templates.crown import ROOT_STUB_MM
from services.anatomy.templates.sections import close_rings, superellipse
from services.core.geometry import Mesh

MARGIN_MM = 0.7
"""Height of the gums' crest above the cervical line at a tooth's middle, mm. The margin on the tooth is lower, because
the crest is rounded there."""
PAPILLA_MM = 0.8
"""Height of the crest between teeth in addition to the rise of the cervical lines, mm."""
BELOW_ROOT_MM = 3.5
"""Depth of the gums below the ends of the root stubs, mm."""
COVER_MM = 1.4
"""Thickness of the gums over the root on the labial and lingual sides, mm."""
EMBRASURE_MM = 0.5
"""Amount by which this thickness is less between two teeth, mm."""
BEHIND_MM = 3.5
"""Length of the gums behind the last tooth, mm."""
END_ROUNDING_MM = 4.0
"""Length of the rounded ends of the gums, mm."""
EXPONENT = 3.6
"""Exponent of the cross-sections' superellipse."""
STEP_MM = 0.6
"""Distance between cross-sections along the arch, mm."""
COLUMNS = 44
"""Number of vertices around a cross-section."""
FINE_MM = 0.05
"""Step of arc length at which crest and ridge are smoothed, mm."""
CREST_ROUNDING_MM, RIDGE_ROUNDING_MM = 0.8, 1.6
"""Standard deviations of the smoothing of the crest's height and of the ridge's depth along the arch, mm."""
VAULT_MM = 10.0
"""Height of the palate over its rim, mm."""
WALL_BELOW_MM = 5.0
"""Distance by which the back wall reaches beyond the occlusal plane, mm."""


@dataclass(frozen=True)
class Socket:
    """Place at which a tooth leaves the gums."""

    arc_mm: float
    """Signed arc length of the tooth's middle."""
    width_mm: float
    """Mesiodistal width of the tooth."""
    cervix_z_mm: float
    """Coordinate z of the cervical line."""
    half_depth_mm: float
    """Half the tooth's labiolingual diameter at the cervix."""
    curvature_mm: float
    """Rise of the cervical line between the teeth, mean of both sides."""


def build_gums(arch: Arch, sockets: tuple[Socket, ...]) -> Mesh:
    """Build one solid around all root stubs, whose crest rises between the teeth.

    Args:
        arch: the dental arch.
        sockets: places of the teeth, in order of arc length.
    """
    first, last = (
        sockets[0].arc_mm - sockets[0].width_mm / 2 - BEHIND_MM,
        sockets[-1].arc_mm + sockets[-1].width_mm / 2 + BEHIND_MM,
    )
    cap = (
        np.arange(1, round(np.pi / 2 * END_ROUNDING_MM / STEP_MM))
        / round(np.pi / 2 * END_ROUNDING_MM / STEP_MM)
        * np.pi
        / 2
    )
    low, high = first + END_ROUNDING_MM, last - END_ROUNDING_MM
    middle = np.linspace(low, high, round((high - low) / STEP_MM) + 1)
    stations = np.concatenate([low - END_ROUNDING_MM * np.cos(cap), middle, high + END_ROUNDING_MM * np.sin(cap)])
    scale = np.concatenate([np.sin(cap), np.ones_like(middle), np.cos(cap)])
    crest, floor, half_depth = _outline(sockets, stations)

    # Place the cross-sections across the arch, counter-clockwise seen from the last: first axis up, second outward.
    points, outward = arch.points_mm(stations), arch.outward(stations)
    rings = []
    for k in range(len(stations)):
        up, out = superellipse(scale[k] * (crest[k] - floor[k]) / 2, scale[k] * half_depth[k], COLUMNS, EXPONENT)
        rings.append(np.column_stack([points[k] + out[:, None] * outward[k], (crest[k] + floor[k]) / 2 + up])[::-1])
    ends = [
        np.append(arch.points_mm(np.array([end]))[0], (crest[k] + floor[k]) / 2) for end, k in ((first, 0), (last, -1))
    ]
    return close_rings(np.concatenate([*rings, np.stack(ends)]), len(rings), COLUMNS)


def build_cavity(arch: Arch, sockets: tuple[Socket, ...]) -> Mesh:
    """Build the open wall of the mouth: the palate's vault between the gums, and behind the last teeth a wall that
    reaches beyond the occlusal plane.
    """
    ends = (
        np.array([sockets[-1].arc_mm, -sockets[0].arc_mm])
        + np.array([sockets[-1].width_mm, sockets[0].width_mm]) / 2
        + BEHIND_MM / 2
    )
    lengths = np.linspace(4.0, float(ends.mean()), 48)
    half_width, y = arch.points_mm(lengths).T
    rim = float(np.mean([socket.cervix_z_mm for socket in sockets])) - ROOT_STUB_MM
    across = np.sin(np.linspace(-np.pi / 2, np.pi / 2, 57))
    # Let the vault rise behind the incisors and then stay at its height, with steep sides and a flat middle.
    rise = VAULT_MM * np.clip((y[0] - y) / 20.0, 0.0, 1.0) ** 0.7
    vault = np.stack(
        np.broadcast_arrays(half_width[:, None] * across, y[:, None], rim - rise[:, None] * (1 - across**4)), axis=-1
    )
    down = np.linspace(0.0, 1.0, 25)[1:, None]
    back = np.stack(
        np.broadcast_arrays(vault[-1, :, 0], vault[-1, :, 1], vault[-1, :, 2] * (1 - down) + WALL_BELOW_MM * down),
        axis=-1,
    )
    return _sheet(np.concatenate([vault, back]))


def _outline(
    sockets: tuple[Socket, ...], stations_mm: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    # Heights of crest and floor and half depth (N,) at arc lengths. Nodes lie at each tooth's middle and shoulders and
    # between neighbours; the curves are monotone between nodes and then smoothed.
    from scipy.interpolate import PchipInterpolator
    from scipy.ndimage import gaussian_filter1d

    ends = [(s, sign * (s.width_mm / 2 + BEHIND_MM)) for s, sign in ((sockets[0], -1.0), (sockets[-1], 1.0))]
    nodes = [
        (s.arc_mm + step, s.cervix_z_mm + MARGIN_MM, s.cervix_z_mm, s.half_depth_mm + COVER_MM) for s, step in ends
    ]
    for socket in sockets:
        crest, depth = socket.cervix_z_mm + MARGIN_MM, socket.half_depth_mm + COVER_MM
        nodes.append((socket.arc_mm, crest, socket.cervix_z_mm, depth))
        nodes += [
            (
                socket.arc_mm + side * 0.3 * socket.width_mm,
                crest + 0.3 * (socket.curvature_mm + PAPILLA_MM),
                socket.cervix_z_mm,
                depth,
            )
            for side in (-1, 1)
        ]
    for one, other in pairwise(sockets):
        cervix = (one.cervix_z_mm + other.cervix_z_mm) / 2
        papilla = cervix + MARGIN_MM + PAPILLA_MM + (one.curvature_mm + other.curvature_mm) / 2
        depth = (one.half_depth_mm + other.half_depth_mm) / 2 + COVER_MM - EMBRASURE_MM
        nodes.append(((one.arc_mm + one.width_mm / 2 + other.arc_mm - other.width_mm / 2) / 2, papilla, cervix, depth))
    arc, crest, cervix, depth = np.array(sorted(nodes)).T
    fine = np.arange(arc[0], arc[-1], FINE_MM)
    curves = [
        gaussian_filter1d(PchipInterpolator(arc, values)(fine), width / FINE_MM, mode="nearest")
        for values, width in ((crest, CREST_ROUNDING_MM), (cervix, RIDGE_ROUNDING_MM), (depth, RIDGE_ROUNDING_MM))
    ]
    crest_mm, cervix_mm, depth_mm = (np.interp(stations_mm, fine, values) for values in curves)
    return crest_mm, cervix_mm - ROOT_STUB_MM - BELOW_ROOT_MM, depth_mm


def _sheet(points_mm: NDArray[np.float64]) -> Mesh:
    # Triangle mesh of a grid of points (rows, columns, 3).
    rows, columns, _ = points_mm.shape
    a = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1)
    b, c, d = a + 1, a + columns, a + columns + 1
    return Mesh(
        points_mm.reshape(-1, 3), np.concatenate([np.stack([a, b, d], -1), np.stack([a, d, c], -1)]).astype(np.int32)
    )
