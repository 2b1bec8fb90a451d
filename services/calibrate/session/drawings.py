"""Drawings of a calibration's report as SVG: corners and their residuals, uncertainty over the image, lights, charts.

Their colours are classes of the report's style sheet, so they follow its light or dark mode; a chart shows its own
colours.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from services.calibrate.cameras.bundle import BundleFit
from services.calibrate.cameras.projection import image_grid, projection_sigma
from services.core.colour.cie import D50
from services.core.pages.pictures import tone_map

Floats = NDArray[np.float64]
WIDTH = 360.0
ARROW_PX = 12.0
"""Length in the drawing of the arrow of a residual of 3 σ; arrows longer than twice this are shortened to it."""
GRID = (16, 12)
MAX_SHARE = 0.05
"""Standard error in pixels, as a share of the image's width, from which on it is only said that a value is not known:
linear propagation of errors holds for small ones."""
SRGB_FROM_XYZ_D50 = np.array(
    [[3.1338561, -1.6168667, -0.4906146], [-0.9787684, 1.9161415, 0.0334540], [0.0719453, -0.2289914, 1.4052427]]
)
"""Matrix from XYZ under D50 to linear sRGB, with Bradford's chromatic adaptation (Lindbloom)."""


def corners_drawing(fit: BundleFit, camera: int) -> str:
    """Draw the residuals of all corners of a camera as arrows of a common scale; those of outliers are marked."""
    size = fit.rig.lenses[camera].size
    scale = WIDTH / size[0]
    mine = fit.corners.camera == camera
    sigma = float(fit.sigma_px[camera])
    places, off = fit.corners.pixels[mine] * scale, fit.residuals_px[mine] / (3 * sigma) * ARROW_PX
    length = np.linalg.norm(off, axis=1, keepdims=True)
    off = off * np.minimum(1, 2 * ARROW_PX / np.maximum(length, 1e-12))
    shapes = [
        f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{x + dx:.1f}" y2="{y + dy:.1f}"'
        f' class="{"used" if good else "left-out"}"/>'
        for (x, y), (dx, dy), good in zip(places, off, fit.inliers[mine], strict=True)
    ]
    return _svg(shapes, WIDTH, size[1] * scale)


def uncertainty_drawing(fit: BundleFit, camera: int, distance_mm: float) -> tuple[str, float]:
    """Draw the uncertainty of projection over the image.

    Returns:
        The drawing, transparent at 0 and opaque at the largest uncertainty that is known, and this uncertainty in px. A
        cell whose uncertainty is a large part of the image is marked as not known.
    """
    lens = fit.rig.lenses[camera]
    scale = WIDTH / lens.size[0]
    sigma = projection_sigma(fit, camera, image_grid(lens.size, *GRID), distance_mm)
    is_known, (columns, rows) = sigma < MAX_SHARE * lens.size[0], GRID
    largest = float(sigma[is_known].max(initial=0.0))
    width, height = WIDTH / columns, lens.size[1] * scale / rows
    shapes = [
        f'<rect x="{(n % columns) * width:.1f}" y="{(n // columns) * height:.1f}" width="{width:.1f}"'
        f' height="{height:.1f}" class="share" fill-opacity="{value / largest if known else 1:.3f}">'
        f"<title>{f'{value:.3f} px' if known else 'not known'}</title></rect>"
        for n, (value, known) in enumerate(zip(sigma, is_known, strict=True))
    ]
    return _svg(shapes, WIDTH, lens.size[1] * scale), largest


def lights_drawing(lights_mm: Floats, names: Sequence[str], cameras_mm: Floats, errors_mm: Floats | None) -> str:
    """Draw lights and cameras from above (x, z) and from the side (y, z), lights as circles with a radius of 10 σ."""
    reach = np.zeros((len(lights_mm), 1)) if errors_mm is None else 10 * errors_mm[:, None]
    everything = np.concatenate([lights_mm - reach, lights_mm + reach, cameras_mm])
    low, high = everything.min(axis=0), everything.max(axis=0)
    scale = (WIDTH - 40) / max(float((high - low).max()), 1.0)
    shapes = []
    for view, axes in enumerate(((0, 2), (1, 2))):
        left = view * WIDTH + 20
        for number, name in enumerate(names):
            x, y = ((lights_mm[number] - low) * scale)[list(axes)]
            radius = max(float(reach[number, 0]) * scale, 2.5)
            shapes.append(
                f'<circle cx="{left + x:.1f}" cy="{20 + y:.1f}" r="{radius:.1f}"'
                f' class="lamp"><title>{_safe(name)}</title></circle>'
            )
        for camera in cameras_mm:
            x, y = ((camera - low) * scale)[list(axes)]
            shapes.append(f'<rect x="{left + x - 3:.1f}" y="{20 + y - 3:.1f}" width="6" height="6" class="camera"/>')
    return _svg(shapes, 2 * WIDTH, float((high - low)[2]) * scale + 40)


def chart_drawing(reference: Floats, before: Floats, after: Floats) -> str:
    """Draw a chart's patches: the reference as the frame of each patch; inside, on the left the colour as the sensor
    sees it and on the right the corrected colour. All colours are linear sRGB (24, 3).
    """
    side, shapes = 44.0, []
    for patch in range(len(reference)):
        x, y = patch % 6 * side, patch // 6 * side
        parts = [(0.0, 0.0, side, side, reference), (10.0, 10.0, 12.0, 24.0, before), (22.0, 10.0, 12.0, 24.0, after)]
        for dx, dy, width, height, colours in parts:
            if np.isfinite(colours[patch]).all():
                shapes.append(
                    f'<rect x="{x + dx:.0f}" y="{y + dy:.0f}" width="{width:.0f}" height="{height:.0f}"'
                    f' fill="{_hex(colours[patch])}"/>'
                )
    return _svg(shapes, 6 * side, 4 * side)


def srgb(xyz: Floats) -> Floats:
    """Return the linear sRGB (N, 3) of XYZ (N, 3) under D50, with white at 1."""
    return np.asarray(xyz @ SRGB_FROM_XYZ_D50.T / (D50 @ SRGB_FROM_XYZ_D50.T))


def _hex(linear: Floats) -> str:
    return "#" + tone_map(linear[None, None], 1.0).tobytes().hex()


def _safe(text: str) -> str:
    return text.replace("&", "&amp;").replace("<", "&lt;")


def _svg(shapes: Iterable[str], width: float, height: float) -> str:
    return f'<svg viewBox="0 0 {width:.0f} {height:.0f}" width="{width:.0f}" role="img">{"".join(shapes)}</svg>'
