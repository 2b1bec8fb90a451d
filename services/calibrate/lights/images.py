"""Detection of spheres in photographs: their outlines and the highlights on them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.calibrate.lights.mirror import PosedCamera, outline_errors, sphere_from_outline
from services.core.robust import robust_sigma

Floats = NDArray[np.float64]
Image = NDArray[np.float32]
SEARCH_WIDTH = 640
"""Width in pixels of the reduced image in which a sphere is searched; its outline is then measured in the full
image."""
RADII = (0.5, 2.0)
"""Smallest and largest radius of a sphere's image, as multiples of the radius that it has at the expected distance."""
CIRCLE_QUALITY = (0.85, 0.6, 0.35)
"""Thresholds of OpenCV's circle search, from nearly perfect outlines to half hidden ones; the first with which any
circle is found is used."""
RAYS = 180
"""Number of rays from the middle along which the edge is searched."""
BANDS = (0.12, 0.04, 0.02)
"""Half widths of the bands in which the edge is searched around the last outline, as fractions of the radius."""
MIN_BAND_PX = 4.0
"""Smallest half width of a band."""
SMOOTHING_PX = 1.0
"""Width of the Gaussian that smooths the image before edges are searched."""
OUTLIER_SIGMAS = 3.5
"""Distance from the fitted outline, in robust standard deviations, beyond which an edge point is an outlier."""
MIN_EDGES = RAYS // 3
"""Smallest number of edge points of an outline: a third of the outline determines the sphere."""
INSIDE = 0.97
"""Fraction of the radius within which highlights are searched: closer to the outline they are elongated to lines."""
HALF = 0.5
"""Fraction of the peak above which a pixel belongs to the highlight."""
MIN_CONTRAST = 8.0
"""Smallest height of a highlight's peak above the sphere's median, in units of the robust standard deviation of the
sphere's pixels."""


@dataclass(frozen=True)
class Outline:
    """Edge points (E, 2) of a sphere in pixels, and their rms distance from the fitted outline."""

    points_px: Floats
    rms_px: float


@dataclass(frozen=True)
class Logs:
    """Logarithms of the pixel values in a part of an image.

    Attributes:
        values: logarithms (h, w).
        first_px: column and row (2,) of the part's first pixel in the whole image.
        size: width and height of the whole image.
    """

    values: Image
    first_px: NDArray[np.int64]
    size: tuple[int, int]


def about_outline(outline_px: Floats, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Return the rows and columns of an image (H, W) that contain a sphere's outline; both begin and end at even
    numbers, so that the crop keeps the colour mosaic's pattern.
    """
    low = np.maximum(np.floor(outline_px.min(axis=0)).astype(int) - 2, 0) // 2 * 2
    high = np.minimum(np.ceil(outline_px.max(axis=0)).astype(int) + 4, shape[1::-1]) // 2 * 2
    return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))


def find_outline(grey: Image, camera: PosedCamera, radius_mm: float, distance_mm: float) -> Outline | None:
    """Find the outline of a sphere of known radius at about the given distance; None where none is found.

    A circle search in a reduced image comes first. Then the steepest change of brightness along rays from the middle is
    located to a fraction of a pixel, each time in a narrower band about the outline of the sphere that fits the last
    points.
    """
    import cv2

    height, width = grey.shape
    shrink = max(width / SEARCH_WIDTH, 1.0)
    small = cv2.resize(grey, (round(width / shrink), round(height / shrink)), interpolation=cv2.INTER_AREA)
    # Clip at four times the 60th percentile, because highlights are much brighter than any outline.
    top = 4 * float(np.percentile(small, 60)) + 1e-12
    eight = np.clip(small / top * 255, 0, 255).astype(np.uint8)
    expected = float(camera.lens.values[0]) * radius_mm / distance_mm / shrink
    circle = _circle(cv2.GaussianBlur(eight, (0, 0), 1.0), expected)
    if circle is None:
        return None
    points = circle[:2] * shrink + circle[2] * shrink * _unit_circle()
    # Search edges in the logarithm, where an edge of a given ratio is equally steep in dark and in bright parts.
    floor = 0.02 * top
    # Crop to the surroundings of the circle, which contain the widest band.
    reach = circle[2] * shrink * (1 + 2 * BANDS[0]) + 2 * MIN_BAND_PX
    low = np.maximum(np.floor(circle[:2] * shrink - reach).astype(int), 0)
    high = np.minimum(np.ceil(circle[:2] * shrink + reach).astype(int), [width, height])
    part = np.maximum(grey[low[1] : high[1], low[0] : high[0]], 0)
    near = cv2.GaussianBlur(np.log(part + np.float32(floor)).astype(np.float32), (0, 0), SMOOTHING_PX)
    logs = Logs(near, low, (width, height))
    for band in BANDS:
        sphere = sphere_from_outline(camera, points, radius_mm)
        found = _edges(logs, camera, sphere, radius_mm, band)
        points = _without_outliers(found, camera, radius_mm)
        if len(points) < MIN_EDGES:
            return None
    off = outline_errors(camera, points, sphere_from_outline(camera, points, radius_mm), radius_mm)
    return Outline(points, float(np.sqrt(np.mean(off**2))))


def find_highlight(grey: Image, outline_px: Floats) -> Floats | None:
    """Find the centre (2,) in pixels of the brightest highlight within a sphere's outline; None where there is none.

    The centre is the centroid of the connected region that contains the peak and exceeds half of it, weighted by the
    brightness above a quarter of the peak; brightness counts from the sphere's median.
    """
    import cv2

    middle = outline_px.mean(axis=0)
    reach = np.linalg.norm(outline_px - middle, axis=1).mean() * INSIDE
    x0, y0 = np.maximum(np.floor(middle - reach).astype(int), 0)
    x1, y1 = np.minimum(np.ceil(middle + reach).astype(int) + 1, grey.shape[::-1])
    part = grey[y0:y1, x0:x1].astype(np.float32)
    y, x = np.mgrid[y0:y1, x0:x1]
    inside = (x + 0.5 - middle[0]) ** 2 + (y + 0.5 - middle[1]) ** 2 < reach**2
    # Search the peak in the image smoothed by one pixel, so that a single hot pixel is not taken for it.
    smooth = np.where(inside, cv2.GaussianBlur(part, (0, 0), 1.0), -np.inf)
    row, column = np.unravel_index(int(np.argmax(smooth)), smooth.shape)
    level = float(np.median(part[inside]))
    scatter = robust_sigma(part[inside] - level)
    peak = float(smooth[row, column]) - level
    if peak <= MIN_CONTRAST * max(scatter, 1e-12):
        return None
    bright = (inside & (smooth - level > HALF * peak)).astype(np.uint8)
    _, labels = cv2.connectedComponents(bright)
    in_highlight = labels == labels[row, column]
    weights = np.where(in_highlight, part - level - HALF * peak * 0.5, 0)
    weights = np.maximum(weights, 0)
    total = float(weights.sum())
    return np.array([(weights * (x + 0.5)).sum() / total, (weights * (y + 0.5)).sum() / total])


def _unit_circle() -> Floats:
    angle = np.linspace(0, 2 * np.pi, RAYS, endpoint=False)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _circle(image: NDArray[np.uint8], expected_px: float) -> Floats | None:
    """Return the centre and radius (3,) in pixels of the clearest circle of about the expected radius, or None."""
    import cv2

    least, most = (max(round(expected_px * part), 4) for part in RADII)
    for quality in CIRCLE_QUALITY:
        found = cv2.HoughCircles(
            image,
            cv2.HOUGH_GRADIENT_ALT,
            1.5,
            max(least, 10),
            param1=60,
            param2=quality,
            minRadius=least,
            maxRadius=most,
        )
        if found is not None:
            return np.asarray(found, dtype=np.float64).reshape(-1, found.shape[-1])[0, :3]
    return None


def _edges(logs: Logs, camera: PosedCamera, sphere_mm: Floats, radius_mm: float, band: float) -> Floats:
    """Return the points (E, 2) of steepest change across the outline of a sphere, within a band about it."""
    import cv2

    middle = camera.project(sphere_mm[None])[0]
    towards = sphere_mm - camera.centre_mm
    distance = float(np.linalg.norm(towards))
    axis, sine = towards / distance, radius_mm / distance
    one = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    one /= np.linalg.norm(one)
    circle = _unit_circle()
    across = circle[:, :1] * one + circle[:, 1:] * np.cross(axis, one)
    edge = camera.project(camera.centre_mm + distance * (np.sqrt(1 - sine**2) * axis + sine * across))
    outward = (edge - middle) / np.linalg.norm(edge - middle, axis=1, keepdims=True)
    half = max(band * float(np.linalg.norm(edge - middle, axis=1).mean()), MIN_BAND_PX)
    offsets = np.arange(-half, half + 0.25, 0.25)
    places = edge[:, None] + offsets[None, :, None] * outward[:, None]
    maps = (places - 0.5 - logs.first_px).astype(np.float32)
    profile = cv2.remap(logs.values, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    steep = np.abs(np.gradient(profile.astype(np.float64), axis=1))
    best = np.clip(steep.argmax(axis=1), 1, len(offsets) - 2)
    rows = np.arange(len(edge))
    left, top, right = (steep[rows, best + shift] for shift in (-1, 0, 1))
    bend = left - 2 * top + right
    shift = np.where(np.abs(bend) > 0, (left - right) / np.where(bend == 0, 1, 2 * bend), 0.0)
    found = edge + ((best + np.clip(shift, -1, 1)) * 0.25 - half)[:, None] * outward
    width, height = logs.size
    inside = ((found > 2) & (found < np.array([width - 2, height - 2]))).all(axis=1)
    return np.asarray(found[inside & (top > 0)])


def _without_outliers(points: Floats, camera: PosedCamera, radius_mm: float) -> Floats:
    """Return the points (E, 2) without outliers from the outline of one sphere, which is fitted again three times."""
    for _ in range(3):
        if len(points) < MIN_EDGES:
            return points
        off = outline_errors(camera, points, sphere_from_outline(camera, points, radius_mm), radius_mm)
        scale = max(robust_sigma(off - np.median(off)), 0.02)
        points = points[np.abs(off - np.median(off)) < OUTLIER_SIGMAS * scale]
    return points
