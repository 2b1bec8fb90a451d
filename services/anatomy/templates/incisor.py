"""A procedural upper central incisor after Wheeler's averages, with a model of its labial enamel thickness.

Superellipse cross-sections are stacked along the tooth's axis. The labiolingual diameter is 6.0 mm at the cervix, 7.0
mm at 2.5 mm above it and 1.5 mm at the incisal edge, 10.5 mm above it; the mesiodistal one is 7.0 mm at the cervix and
8.5 mm at the widest. At a height of z mm above the cervix, labial enamel is 0.35 mm + 0.75 mm · z / 10.5 thick. Frame:
x mesial, y buccal, z occlusal, mm, centred at the origin.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from services.anatomy.templates.sections import close_rings, superellipse
from services.core.geometry import Mesh

if TYPE_CHECKING:
    from scipy.interpolate import PchipInterpolator

Profile = tuple[NDArray[np.float64], ...]

CROWN_MM = 10.5
"""Length of the crown from cervical line to incisal edge."""
ROOT_STUB_MM = 3.0
"""Length of the root stub below the cervical line."""
ROOT_ENAMEL_MM = 0.08
"""Thickness of the cover of the root stub: enough to keep the two surfaces apart."""
EDGE_ROUNDING_MM = 0.45
"""Radius of the rim at the incisal edge."""
ROOT_ROUNDING_MM = 0.8
"""Radius of the rim at the stub's end."""
DENTIN_EDGE_MM = 0.2
"""Half the labiolingual thickness at which dentin ends below the incisal edge."""
EXPONENT = 2.4
"""Exponent of the cross-sections' superellipse."""

HEIGHT_MM = (-ROOT_STUB_MM, 0.0, 2.5, 6.0, 9.0, CROWN_MM)
"""Heights above the cervical line at which the following three dimensions are given."""
LABIAL_MM = (2.75, 3.0, 3.40, 2.95, 1.75, 0.95)
"""Distance of the labial wall from the axis."""
LABIOLINGUAL_MM = (5.5, 6.0, 7.0, 4.6, 2.35, 1.5)
"""Labiolingual diameter."""
MESIODISTAL_MM = (6.5, 7.0, 7.6, 8.3, 8.5, 8.1)
"""Mesiodistal diameter."""


@dataclass(frozen=True)
class Incisor:
    """Nested closed surfaces: enamel outside, dentin inside, gums around the root."""

    outer: Mesh
    dentin: Mesh
    gums: Mesh


def enamel_thickness_mm(height_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Labial enamel thickness in mm at heights above the cervical line; it fades to the root's cover below it."""
    crown = 0.35 + 0.75 * np.clip(height_mm, 0.0, CROWN_MM) / CROWN_MM
    fade = np.clip(1.0 + height_mm / 1.0, 0.0, 1.0)
    smooth = fade * fade * (3 - 2 * fade)
    return ROOT_ENAMEL_MM + (crown - ROOT_ENAMEL_MM) * smooth


def build_incisor(columns: int = 40) -> Incisor:
    """Build the incisor with its gums.

    Args:
        columns: vertices around a cross-section; 40 gives about 4,300 triangles for the enamel surface.
    """
    crown = _stack(_outer_profile, (-ROOT_STUB_MM, CROWN_MM), (ROOT_ROUNDING_MM, EDGE_ROUNDING_MM), columns)
    heights = np.linspace(0.0, CROWN_MM, 1000)
    fits = (_dentin_profile(heights)[1] >= DENTIN_EDGE_MM) & (heights + enamel_thickness_mm(heights) <= CROWN_MM)
    core = _stack(
        _dentin_profile,
        (-ROOT_STUB_MM + ROOT_ENAMEL_MM, float(heights[fits].max())),
        (ROOT_ROUNDING_MM, DENTIN_EDGE_MM / 2),
        columns,
    )
    shift = -(crown.vertices_mm.min(axis=0) + crown.vertices_mm.max(axis=0)) / 2
    return Incisor(_moved(crown, shift), _moved(core, shift), _moved(_gum_collar(columns), shift))


def _outer_profile(height_mm: NDArray[np.float64]) -> Profile:
    # Half axes along x and y, and labial offset of the centre line, interpolated monotonically between the measured
    # heights, so that no waist appears.
    labial, diameter, width = (curve(height_mm) for curve in _curves())
    return width / 2, diameter / 2, labial - diameter / 2


@cache
def _curves() -> tuple[PchipInterpolator, ...]:
    from scipy.interpolate import PchipInterpolator

    return tuple(PchipInterpolator(HEIGHT_MM, values) for values in (LABIAL_MM, LABIOLINGUAL_MM, MESIODISTAL_MM))


def _dentin_profile(height_mm: NDArray[np.float64]) -> Profile:
    # Thickness is a distance along the normal; on an inclined wall the horizontal step is longer by the secant of its
    # slope.
    width, depth, centre = _outer_profile(height_mm)
    thickness, step = enamel_thickness_mm(height_mm), 1e-3

    def inset(wall: NDArray[np.float64], above: NDArray[np.float64]) -> NDArray[np.float64]:
        return wall - thickness * np.sqrt(1 + ((above - wall) / step) ** 2)

    width_above, depth_above, centre_above = _outer_profile(height_mm + step)
    labial = inset(depth + centre, depth_above + centre_above)
    lingual = inset(depth - centre, depth_above - centre_above)
    return inset(width, width_above), (labial + lingual) / 2, (labial - lingual) / 2


def _stack(
    profile: Callable[[NDArray[np.float64]], Profile],
    ends_mm: tuple[float, float],
    rounding_mm: tuple[float, float],
    columns: int,
) -> Mesh:
    # List the rows: a flat lid that grows from a pole, a rounded rim, the wall, and the same at the other end.
    wall_rows, rim_rows = max(8, columns), max(4, columns // 8)
    rows = []
    for end, rounding, sign in ((ends_mm[0], rounding_mm[0], -1.0), (ends_mm[1], rounding_mm[1], 1.0)):
        angle = np.linspace(np.pi / 2, 0, rim_rows + 1)[:-1]
        height = np.full(rim_rows, end) - sign * rounding * (1 - np.sin(angle))
        inset = rounding * (1 - np.cos(angle))
        lid = [(end, rounding, scale) for scale in (1 / 3, 2 / 3)]
        part = lid + [(float(z), float(i), 1.0) for z, i in zip(height, inset, strict=True)]
        rows.append(part if sign < 0 else part[::-1])
    wall = np.linspace(ends_mm[0] + rounding_mm[0], ends_mm[1] - rounding_mm[1], wall_rows)
    sections = rows[0] + [(float(z), 0.0, 1.0) for z in wall] + rows[1]

    rings = []
    for row_height, row_inset, scale in sections:
        half_x, half_y, centre = (float(value[0]) for value in profile(np.array([row_height])))
        cut = min(row_inset, 0.85 * min(half_x, half_y))
        x, y = superellipse(scale * (half_x - cut), scale * (half_y - cut), columns, EXPONENT)
        rings.append(np.stack([x, y + centre, np.full(columns, row_height)], axis=-1))
    poles = [np.array([[0.0, float(profile(np.array([end]))[2][0]), end]]) for end in ends_mm]
    return close_rings(np.concatenate([*rings, *poles]), len(rings), columns)


def _gum_collar(columns: int) -> Mesh:
    # Block around the root whose top rises to papillae between the teeth; the enamel hides the part inside the tooth.
    def profile(height_mm: NDArray[np.float64]) -> Profile:
        return np.full_like(height_mm, 6.5), np.full_like(height_mm, 5.0), np.full_like(height_mm, 0.2)

    block = _stack(profile, (-ROOT_STUB_MM - 1.0, 0.4), (0.8, 0.8), columns)
    x, y, z = block.vertices_mm.T
    papilla = 1.6 * np.exp(-(((np.abs(x) - 4.6) / 1.3) ** 2)) * np.clip((z + ROOT_STUB_MM) / ROOT_STUB_MM, 0, 1)
    return Mesh(np.stack([x, y, z + papilla], axis=-1), block.faces)


def _moved(mesh: Mesh, shift_mm: NDArray[np.float64]) -> Mesh:
    return Mesh(mesh.vertices_mm + shift_mm, mesh.faces)
