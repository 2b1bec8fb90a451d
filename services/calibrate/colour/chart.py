"""A chart of 24 patches: its reference colours, and the means of its patches in a photograph."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.errors import CaptureInputError
from services.core.files.tables import read_rows

Floats = NDArray[np.float64]
COLUMNS, ROWS = 6, 4
NEUTRALS = slice(18, 24)
"""The neutral patches 19 to 24, from white to black, whose reflectance is equal in all channels to a few per cent."""
WHITE_Y = (82.0, 97.0)
"""Least and largest Y of the white patch 19 of any chart, new or old, where a perfect diffuser has 100."""
LIGHT_NEUTRALS = 4
"""Number of neutral patches, from the white one, by which the light is judged; the darker ones are less neutral."""
D50_XY, D65_XY = (0.3457, 0.3585), (0.3127, 0.3290)
"""Chromaticities of the CIE illuminants (CIE 15:2018)."""
MAX_FROM_D50 = 0.012
"""Largest distance of the neutrals' mean chromaticity from D50; D55 lies 0.017 off."""
MAX_UNLIKE = 0.015
"""Largest distance of a neutral patch's chromaticity from the neutrals' mean."""
MAX_FRACTION = 1.5
"""Largest Y of a reference that is told as a fraction of 1; the darkest patch of a chart has 3 of 100."""
PATCH_SHARE = 0.25
"""Half width of the averaged square of a patch, as a fraction of the distance between patch centres: the square spans
half of it."""
SAMPLES = 15
"""Number of samples across the averaged square, in each direction."""
LARGEST_SATURATED_SHARE = 0.01
"""Largest fraction of saturated samples in a usable patch."""


@dataclass(frozen=True)
class Patches:
    """Means (24, C) of a chart's patches, and whether each patch is usable (24,)."""

    means: Floats
    usable: NDArray[np.bool_]


def read_reference(path: Path, chart: str) -> Floats:
    """Read the XYZ (24, 3) of a chart's patches under D50, Y = 1 for a perfect diffuser, from a table with columns X, Y
    and Z in which it has Y = 100.

    Raises:
        CaptureInputError: the table has no columns X, Y and Z, not 24 rows, or a cell that is no number.
    """
    what = f"Reference {path.name} of chart {chart}"
    rows = read_rows(path, what)
    header = [cell.upper() for cell in rows[0].cells] if rows else []
    if not {"X", "Y", "Z"} <= set(header):
        raise CaptureInputError(
            f"Reference {path.name} of chart {chart} has no columns X, Y and Z; give XYZ under D50 with Y = 100 for"
            " white."
        )
    try:
        table = np.array([[float(row.cells[header.index(axis)]) for axis in "XYZ"] for row in rows[1:]]) / 100
    except (ValueError, IndexError) as problem:
        raise CaptureInputError(
            f"Reference {path.name} of chart {chart} holds what is no number ({problem}); correct it."
        ) from problem
    if table.shape != (COLUMNS * ROWS, 3):
        raise CaptureInputError(f"Reference {path.name} of chart {chart} has {len(table)} patches; 24 are needed.")
    _require_neutrals(table, what)
    return np.asarray(table)


def _require_neutrals(xyz: Floats, what: str) -> None:
    """Refuse a reference of another scale or light, judged by its neutral patches.

    A chart of other patches, whose patches 19 to 22 are not of one chromaticity, is judged by its scale alone.

    Raises:
        CaptureInputError: Y is told as a fraction, or white is not as bright as that of a chart, the neutrals do not
            darken from patch 19 to 24, or they are not grey under D50.
    """
    if not np.isfinite(xyz).all() or (xyz < 0).any():
        raise CaptureInputError(f"{what} has a value that is negative or not finite; correct it.")
    if 100 * xyz[:, 1].max() <= MAX_FRACTION:
        raise CaptureInputError(f"{what} gives Y as a fraction of 1; give Y = 100 for a perfect diffuser.")
    light = xyz[NEUTRALS][:LIGHT_NEUTRALS]
    chromaticities = light[:, :2] / np.maximum(light.sum(axis=1, keepdims=True), 1e-12)
    x, y = (float(one) for one in chromaticities.mean(axis=0))
    if np.hypot(*(chromaticities - (x, y)).T).max() > MAX_UNLIKE:
        return
    white = 100 * light[0, 1]
    if not WHITE_Y[0] <= white <= WHITE_Y[1]:
        raise CaptureInputError(
            f"{what} has Y = {white:g} for its white patch 19, and a chart's white has about 90 of a perfect diffuser's"
            " 100; correct the scale, or list the patches row by row from the dark skin."
        )
    if not (np.diff(xyz[NEUTRALS, 1]) < 0).all():
        raise CaptureInputError(
            f"{what} has neutral patches 19 to 24 that do not darken one by one; list the patches row by row from the"
            " dark skin."
        )
    if np.hypot(x - D50_XY[0], y - D50_XY[1]) > MAX_FROM_D50:
        named = " (those of D65)" if np.hypot(x - D65_XY[0], y - D65_XY[1]) <= MAX_FROM_D50 else ""
        raise CaptureInputError(
            f"{what} has neutral patches of chromaticity {x:.3f}, {y:.3f}{named}, and D50 has {D50_XY[0]:.3f},"
            f" {D50_XY[1]:.3f}; give XYZ under D50."
        )


def patch_means(values: NDArray[np.float32], saturated: NDArray[np.bool_], corners: Floats) -> Patches:
    """Average the middle of every patch.

    Args:
        values: an image (h, w, C).
        saturated: mask of its saturated pixels (h, w).
        corners: centres (4, 2) of patches 1, 6, 24, 19 in pixels of this image, pixel centres at half-integers.

    Returns:
        Means and usability of the patches. A patch that leaves the image has NaN as mean and is not usable.
    """
    import cv2

    on_chart = np.array([[0, 0], [COLUMNS - 1, 0], [COLUMNS - 1, ROWS - 1], [0, ROWS - 1]], dtype=np.float32)
    homography = cv2.getPerspectiveTransform(on_chart, corners.astype(np.float32))
    shift = np.linspace(-PATCH_SHARE, PATCH_SHARE, SAMPLES)
    means, usable = [], []
    for patch in range(COLUMNS * ROWS):
        x, y = np.meshgrid(patch % COLUMNS + shift, patch // COLUMNS + shift)
        points = np.stack([x, y, np.ones_like(x)], axis=-1) @ homography.T
        columns, rows = (np.floor(points[..., k] / points[..., 2]).astype(int) for k in (0, 1))
        inside = (rows >= 0) & (rows < values.shape[0]) & (columns >= 0) & (columns < values.shape[1])
        if not inside.all():
            means.append(np.full(values.shape[2], np.nan))
            usable.append(False)
            continue
        means.append(values[rows, columns].mean(axis=(0, 1)).astype(np.float64))
        usable.append(bool(saturated[rows, columns].mean() <= LARGEST_SATURATED_SHARE))
    return Patches(np.array(means), np.array(usable))


def find_corners(eight_bit: NDArray[np.uint8]) -> Floats | None:
    """Find the centres (4, 2) in pixels of patches 1, 6, 24, 19 in a photograph (H, W, 3) with channels blue, green,
    red; None where no chart is found.
    """
    import cv2

    detector = cv2.mcc.CCheckerDetector.create()
    if not detector.process(eight_bit, cv2.mcc.MCC24):
        return None
    found = np.asarray(detector.getBestColorChecker().getColorCharts(), dtype=np.float64).reshape(24, 4, 2).mean(axis=1)
    return np.asarray(found[[0, 5, 23, 18]] + 0.5)


def over_white(patches: Patches, xyz: Floats, camera: str) -> Floats:
    """Return the patch means (24, C) divided by those of a perfect diffuser in the same light.

    The diffuser's means are estimated from the neutral patches and their reference luminances.

    Raises:
        CaptureInputError: fewer than three neutral patches are usable.
    """
    good = np.zeros(24, dtype=bool)
    good[NEUTRALS] = patches.usable[NEUTRALS]
    if np.count_nonzero(good) < 3:
        raise CaptureInputError(
            f"Camera {camera} shows fewer than three of the chart's grey patches below saturation; expose the chart"
            " less."
        )
    luminance = xyz[good, 1:2]
    # Fit the means of the neutral patches as white times luminance, by least squares through the origin.
    white = (patches.means[good] * luminance).sum(axis=0) / (luminance**2).sum()
    return np.asarray(patches.means / white)
