"""Upper teeth of every kind from their dimensions: superellipse cross-sections along the axis, then cusps.

Enamel and dentin are stacks of cross-sections, one inside the other. Two maps shape both alike: the cross-section
narrows towards the tongue, and the occlusal part sinks between the cusps. Both maps keep the order of points along x
and along z, so dentin stays inside enamel. Frame: x mesial (of a right tooth), y buccal, z occlusal, mm, centred at the
origin.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.anatomy.templates.dimensions import ToothDimensions
from services.anatomy.templates.sections import cover_rings, superellipse
from services.core.geometry import Mesh

Profile = Callable[[NDArray[np.float64]], tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]]
"""Half axes along x and y and the centre's y at heights above the cervical line, mm."""

ROOT_STUB_MM = 4.0
"""Length of the root stub below the cervical line, mm."""
ROOT_ENAMEL_MM = 0.08
"""Thickness of the cover of the root stub, mm: enough to keep the two surfaces apart."""
ROOT_ROUNDING_MM = 0.8
"""Radius of the rim at the stub's end, mm."""
ROOT_TAPER = 0.92
"""Diameter of the stub's end relative to the cervix."""
DENTIN_EDGE_MM = 0.3
"""Half the labiolingual thickness at which dentin ends below a thin incisal edge, mm."""
DENTIN_ROUNDING = 0.35
"""Radius of the dentin's upper rim relative to that of the enamel."""
CROWN_STEP_MM, ROOT_STEP_MM = 0.36, 0.8
"""Distances between cross-sections of the crown and of the root, mm."""
LID_STEP_MM, ROOT_LID_STEP_MM = 0.45, 1.0
"""Distances between the rings of the flat lids at the crown's and at the root's end, mm."""
THIN_LID_MM = 0.8
"""Half width of a flat lid below which it is bridged in one step, mm."""
CUSP_RADIUS_MM = 0.6
"""Radius of the rounding of a cusp's tip, mm."""
CUSP_BLEND_MM = 0.25
"""Height scale of the soft maximum over cusps and fossa, mm."""
CUSP_START = 0.35
"""Fraction of the crown's length above which cusps shape it."""


@dataclass(frozen=True)
class CrownForm:
    """Form of a kind of crown, relative to its dimensions."""

    heights: tuple[float, ...]
    """Heights of the cross-sections above the cervix, relative to the crown's length."""
    mesiodistal: tuple[float, ...]
    """Mesiodistal diameters of the cross-sections, relative to the crown's."""
    labiolingual: tuple[float, ...]
    """Labiolingual diameters of the cross-sections, relative to the crown's."""
    labial: tuple[float, ...]
    """Distances of the labial wall from the axis, relative to the crown's labiolingual diameter."""
    cusps: tuple[tuple[float, float, float], ...]
    """For each cusp x and y relative to the crown's half diameters, and its height below the highest cusp, mm."""
    cusp_slope: float
    """Slope of a cusp's sides, height over distance."""
    cusp_roundness: float
    """Shape of a cusp: 1 if it slopes to all sides, 0 for a ridge that slopes mesially and distally only."""
    fossa_mm: float
    """Largest depth of the occlusal table below the highest cusp, mm."""
    exponent: float
    """Exponent of the cross-sections' superellipse."""
    lingual_taper: float
    """Relative change of width from the axis to the labial or lingual end."""
    rounding_mm: float
    """Radius of the enamel's upper rim, mm."""
    enamel_mm: tuple[float, float]
    """Enamel thickness at the cervix and at the tip, mm."""
    columns: int
    """Number of vertices around a cross-section."""


INCISOR = CrownForm(
    heights=(0.24, 0.57, 0.857, 1.0),
    mesiodistal=(0.894, 0.976, 1.0, 0.953),
    labiolingual=(1.0, 0.657, 0.336, 0.214),
    labial=(0.486, 0.421, 0.25, 0.136),
    cusps=((0.35, 0.0, 0.0), (-0.15, 0.0, 0.0)),
    cusp_slope=0.2,
    cusp_roundness=0.0,
    fossa_mm=1.5,
    exponent=2.4,
    lingual_taper=0.15,
    rounding_mm=0.45,
    enamel_mm=(0.35, 1.1),
    columns=60,
)
CANINE = CrownForm(
    heights=(0.28, 0.55, 0.8, 1.0),
    mesiodistal=(0.9, 1.0, 0.97, 0.86),
    labiolingual=(1.0, 0.84, 0.54, 0.27),
    labial=(0.5, 0.445, 0.325, 0.17),
    cusps=((0.05, 0.0, 0.0),),
    cusp_slope=0.75,
    cusp_roundness=0.4,
    fossa_mm=2.4,
    exponent=2.3,
    lingual_taper=0.18,
    rounding_mm=0.6,
    enamel_mm=(0.35, 1.15),
    columns=60,
)
PREMOLAR = CrownForm(
    heights=(0.33, 0.65, 0.86, 1.0),
    mesiodistal=(0.92, 1.0, 0.96, 0.84),
    labiolingual=(1.0, 0.97, 0.87, 0.74),
    labial=(0.5, 0.48, 0.42, 0.35),
    cusps=((0.0, 0.5, 0.0), (0.06, -0.52, 0.5)),
    cusp_slope=0.6,
    cusp_roundness=1.0,
    fossa_mm=1.7,
    exponent=2.4,
    lingual_taper=0.1,
    rounding_mm=1.0,
    enamel_mm=(0.4, 1.25),
    columns=64,
)
MOLAR = CrownForm(
    heights=(0.33, 0.65, 0.86, 1.0),
    mesiodistal=(0.93, 1.0, 0.96, 0.86),
    labiolingual=(1.0, 0.97, 0.88, 0.77),
    labial=(0.5, 0.48, 0.42, 0.36),
    cusps=((0.44, 0.5, 0.0), (-0.44, 0.48, 0.2), (0.36, -0.48, 0.0), (-0.48, -0.52, 0.6)),
    cusp_slope=0.55,
    cusp_roundness=1.0,
    fossa_mm=1.6,
    exponent=2.8,
    lingual_taper=0.05,
    rounding_mm=1.0,
    enamel_mm=(0.4, 1.35),
    columns=72,
)
FORMS = (INCISOR, INCISOR, CANINE, PREMOLAR, PREMOLAR, MOLAR, MOLAR, MOLAR)
"""Forms of the teeth at the places 1 to 8 from the midline."""


@dataclass(frozen=True)
class ToothSolid:
    """One tooth in its canonical frame: outer surface of the enamel with a root stub, and dentin inside."""

    outer: Mesh
    dentin: Mesh
    cervix_mm: float
    """Coordinate z of the cervical line, mm."""


def build_tooth(dimensions: ToothDimensions, enamel_scale: float = 1.0) -> ToothSolid:
    """Build a right upper tooth.

    Args:
        dimensions: dimensions of the tooth.
        enamel_scale: thickness of the enamel relative to the average.
    """
    form, length = FORMS[dimensions.position - 1], dimensions.crown_length_mm
    outer_profile = _outer_profile(form, dimensions)
    dentin_profile = _dentin_profile(form, length, outer_profile, enamel_scale)
    outer = _stack(outer_profile, (-ROOT_STUB_MM, length), (ROOT_ROUNDING_MM, form.rounding_mm), form)
    top = _dentin_top_mm(form, length, dentin_profile, enamel_scale)
    rounding = max(DENTIN_EDGE_MM / 2, DENTIN_ROUNDING * form.rounding_mm)
    dentin = _stack(dentin_profile, (-ROOT_STUB_MM + ROOT_ENAMEL_MM, top), (ROOT_ROUNDING_MM, rounding), form)

    # Shape both by the same maps, then scale them exactly to the crown's diameter and length.
    outer, dentin = (Mesh(_shaped(mesh.vertices_mm, form, dimensions), mesh.faces) for mesh in (outer, dentin))
    stretch = np.array(
        [dimensions.md_crown_mm / np.ptp(outer.vertices_mm[:, 0]), 1.0, length / outer.vertices_mm[:, 2].max()]
    )
    outer, dentin = (_stretched_above_cervix(mesh, stretch) for mesh in (outer, dentin))
    middle = (outer.vertices_mm.min(axis=0) + outer.vertices_mm.max(axis=0)) / 2
    return ToothSolid(
        Mesh(outer.vertices_mm - middle, outer.faces),
        Mesh(dentin.vertices_mm - middle, dentin.faces),
        -float(middle[2]),
    )


def enamel_thickness_mm(
    form: CrownForm, crown_length_mm: float, height_mm: NDArray[np.float64], scale: float
) -> NDArray[np.float64]:
    """Enamel thickness along the normal at heights above the cervical line, mm; it fades to the root's cover below."""
    cervix, tip = form.enamel_mm
    crown = scale * (cervix + (tip - cervix) * np.clip(height_mm / crown_length_mm, 0.0, 1.0))
    fade = np.clip(1.0 + height_mm / 1.0, 0.0, 1.0)
    return ROOT_ENAMEL_MM + (crown - ROOT_ENAMEL_MM) * fade * fade * (3 - 2 * fade)


def _outer_profile(form: CrownForm, d: ToothDimensions) -> Profile:
    # Interpolate monotonically between the given heights, so that no waist appears.
    from scipy.interpolate import PchipInterpolator

    heights = (-ROOT_STUB_MM, 0.0, *(share * d.crown_length_mm for share in form.heights))
    width = (ROOT_TAPER * d.md_cervix_mm, d.md_cervix_mm, *(share * d.md_crown_mm for share in form.mesiodistal))
    depth = (ROOT_TAPER * d.ll_cervix_mm, d.ll_cervix_mm, *(share * d.ll_crown_mm for share in form.labiolingual))
    labial = (ROOT_TAPER * d.ll_cervix_mm / 2, d.ll_cervix_mm / 2, *(share * d.ll_crown_mm for share in form.labial))
    curves = [PchipInterpolator(heights, values) for values in (width, depth, labial)]

    def profile(height_mm: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        width, depth, labial = (curve(height_mm) for curve in curves)
        return width / 2, depth / 2, labial - depth / 2

    return profile


def _dentin_profile(form: CrownForm, crown_length_mm: float, outer: Profile, scale: float) -> Profile:
    # Thickness is a distance along the normal; on an inclined wall the horizontal step is longer by the secant of its
    # slope.
    step = 1e-3

    def profile(height_mm: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        thickness = enamel_thickness_mm(form, crown_length_mm, height_mm, scale)
        width, depth, centre = outer(height_mm)
        width_above, depth_above, centre_above = outer(height_mm + step)

        def inset(wall: NDArray[np.float64], above: NDArray[np.float64]) -> NDArray[np.float64]:
            return wall - thickness * np.sqrt(1 + ((above - wall) / step) ** 2)

        labial = inset(depth + centre, depth_above + centre_above)
        lingual = inset(depth - centre, depth_above - centre_above)
        return inset(width, width_above), (labial + lingual) / 2, (labial - lingual) / 2

    return profile


def _dentin_top_mm(form: CrownForm, crown_length_mm: float, dentin: Profile, scale: float) -> float:
    # Height of the dentin's top: below the tip by the enamel's thickness, and where the walls leave enough room.
    heights = np.linspace(0.0, crown_length_mm, 1000)
    fits = (dentin(heights)[1] >= DENTIN_EDGE_MM) & (
        heights + enamel_thickness_mm(form, crown_length_mm, heights, scale) <= crown_length_mm
    )
    return float(heights[fits].max())


def _stack(profile: Profile, ends_mm: tuple[float, float], rounding_mm: tuple[float, float], form: CrownForm) -> Mesh:
    # List the rows (height, inset, scale): a rounded rim, the wall, and the other rim. Each end has a flat lid; a wide
    # lid has rings of its own.
    rims, thin = [], []
    for end, rounding, sign in ((ends_mm[0], rounding_mm[0], -1.0), (ends_mm[1], rounding_mm[1], 1.0)):
        half_x, half_y, _ = (float(value[0]) for value in profile(np.array([end])))
        thin.append(half_y - rounding < THIN_LID_MM)
        rings_of_lid = (
            1
            if thin[-1]
            else round((half_x + half_y - 2 * rounding) / 2 / (ROOT_LID_STEP_MM if sign < 0 else LID_STEP_MM))
        )
        rim = [(end, rounding, k / rings_of_lid) for k in range(1, rings_of_lid)]
        angle = np.linspace(np.pi / 2, 0, max(3, round(np.pi / 2 * rounding / CROWN_STEP_MM)) + 1)[:-1]
        rim += [(end - sign * rounding * (1 - float(np.sin(a))), rounding * (1 - float(np.cos(a))), 1.0) for a in angle]
        rims.append(rim if sign < 0 else rim[::-1])
    low, high = ends_mm[0] + rounding_mm[0], ends_mm[1] - rounding_mm[1]
    root = np.linspace(low, 0.0, round(-low / ROOT_STEP_MM) + 1)[:-1]
    crown = np.linspace(0.0, high, round(high / CROWN_STEP_MM) + 1)
    sections = rims[0] + [(float(z), 0.0, 1.0) for z in (*root, *crown)] + rims[1]

    rings = []
    for height, inset, scale in sections:
        half_x, half_y, centre = (float(value[0]) for value in profile(np.array([height])))
        cut = min(inset, 0.85 * min(half_x, half_y))
        x, y = superellipse(scale * (half_x - cut), scale * (half_y - cut), form.columns, form.exponent)
        rings.append(np.stack([x, y + centre, np.full(form.columns, height)], axis=-1))
    return cover_rings(np.concatenate(rings), len(rings), form.columns, (thin[0], thin[1]))


def _shaped(vertices_mm: NDArray[np.float64], form: CrownForm, d: ToothDimensions) -> NDArray[np.float64]:
    # Scale the width with the distance from the tongue, and change heights by the cusps, fully at the tip and not at
    # all near the cervix.
    x, y, z = vertices_mm.T
    x = x * (1 + form.lingual_taper * 2 * y / d.ll_crown_mm)
    share = np.clip((z / d.crown_length_mm - CUSP_START) / (1 - CUSP_START), 0.0, 1.0)
    return np.stack([x, y, z + share * share * (3 - 2 * share) * _relief_mm(x, y, form, d)], axis=-1)


def _relief_mm(
    x_mm: NDArray[np.float64], y_mm: NDArray[np.float64], form: CrownForm, d: ToothDimensions
) -> NDArray[np.float64]:
    # Height (N,) of the occlusal relief: soft maximum of cones with rounded tips and of the fossa's floor; 0 at the
    # highest cusp.
    cusps = np.array(form.cusps)
    tips = cusps[:, :2] * [d.md_crown_mm / 2, d.ll_crown_mm / 2]
    x, y = np.append(x_mm, tips[:, 0]), np.append(y_mm, tips[:, 1])
    heights = [np.full_like(x, -form.fossa_mm)]
    for (tip_x, tip_y), lower in zip(tips, cusps[:, 2], strict=True):
        radius = np.hypot(x - tip_x, form.cusp_roundness * (y - tip_y))
        heights.append(-lower - form.cusp_slope * (np.hypot(radius, CUSP_RADIUS_MM) - CUSP_RADIUS_MM))
    relief = CUSP_BLEND_MM * np.logaddexp.reduce(np.stack(heights) / CUSP_BLEND_MM, axis=0)
    return np.asarray(relief[: len(x_mm)] - relief[len(x_mm) :].max())


def _stretched_above_cervix(mesh: Mesh, factors: NDArray[np.float64]) -> Mesh:
    above = np.where(mesh.vertices_mm[:, 2:] > 0, factors, np.array([factors[0], factors[1], 1.0]))
    return Mesh(mesh.vertices_mm * above, mesh.faces)
