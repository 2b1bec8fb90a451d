"""Mask of the pixels that show a surface reflection instead of light that was inside the tooth.

Mallick et al. 2005 rotate RGB so that one axis, S, is the light's colour; a reflection adds to S alone. Teeth have
nearly the light's colour, so ‖UV‖ is small and noisy. Here the comparison of S with UV is one linear functional per
pixel with a known variance. It is combined with the scan's geometry: the angle of each normal from the mirror
direction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Camera, Light
from services.preprocess.masking.lobe import PROFILE_DEG, LobeProfile
from services.preprocess.masking.shading import Shading, fit_shading, lit_pixels, lobe_explains_light
from services.preprocess.views.projection import Footprint
from services.preprocess.views.window import bands

Image = NDArray[np.float32]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class HighlightOptions:
    """Thresholds of the highlight mask. Fractions are relative to a pixel's brightness along the light's colour."""

    tolerated: float = 0.02  # largest reflected fraction left in the data; below twice the sensor noise of 1 %
    strong: float = 0.10  # reflected fraction that starts a highlight
    weak: float = 0.03  # reflected fraction that continues a highlight
    strong_sigma: float = 5.0  # standard errors that start a highlight; 6e-7 false alarms per pixel
    weak_sigma: float = 2.5  # standard errors that continue a highlight
    cone_deg: float = 40.0  # widest half-angle at which a wet tooth still reflects visibly, scan error included
    lobe_deg: float = 25.0  # outside this half-angle the diffuse colour and shading are estimated
    colour_error: float = 0.05  # relative deviation of a tooth's chroma from that of its neighbourhood
    shading_error: float = 0.15  # relative deviation of shading from a quadratic in the normal


def half_cosines(camera: Camera, light: Light, footprint: Footprint) -> Image:
    """Cosine (H, W) of the angle between the surface normal and the half vector of light and view; -1 without surface.

    The ray of pixel (x, y) is a + b x + c y from the camera's centre, so the computation needs only products of the
    normal with a few fixed vectors and polynomials of the pixel's position.
    """
    pose, inverse_K = np.asarray(camera.camera_from_world), np.linalg.inv(np.asarray(camera.K))
    camera_centre = -pose[:3, :3].T @ pose[:3, 3]
    # Find the world directions of pixel (0, 0), of a step in x and of a step in y, each for unit depth along the
    # camera's axis
    start, step_x, step_y = (
        pose[:3, :3].T @ inverse_K @ vector
        for vector in (np.array([0.5, 0.5, 1]), np.array([1, 0, 0]), np.array([0, 1, 0]))
    )
    to_light = np.asarray(light.position_mm) - camera_centre
    vectors = np.stack([start, step_x, step_y, to_light], axis=1).astype(np.float32)
    height, width = footprint.mesh.shape
    x, y = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)[:, None]
    ray_row = (start + step_y * np.arange(height)[:, None]).astype(np.float32)
    ray_squared = np.stack(
        [
            (ray_row**2).sum(axis=1),
            2 * ray_row @ step_x.astype(np.float32),
            np.full(height, step_x @ step_x, np.float32),
        ],
        axis=1,
    ).astype(np.float32)
    powers = np.stack([np.ones_like(x), x, x * x])
    towards = np.stack([ray_row @ to_light.astype(np.float32), np.full(height, step_x @ to_light)], axis=1).astype(
        np.float32
    )
    cosines = np.full(footprint.mesh.shape, -1, dtype=np.float32)
    for rows in bands(footprint.mesh.shape):
        visible = footprint.mesh[rows] >= 0
        if not visible.any():
            continue
        first, last = (int(one) for one in np.flatnonzero(visible.any(axis=0))[[0, -1]])
        columns = slice(first, last + 1)
        visible = visible[:, columns]
        depth = np.where(visible, footprint.depth_mm[rows, columns], np.float32(1))
        by_normal = footprint.normal[rows, columns].reshape(-1, 3) @ vectors
        at_start, by_x, by_y, light_cosine = (by_normal[:, k].reshape(depth.shape) for k in range(4))
        ray_cosine = at_start + by_x * x[columns]
        ray_cosine += by_y * y[rows]
        # Compute the ray's length at unit depth, and the distance from the surface to the light
        ray_length = np.sqrt(ray_squared[rows] @ powers[:, columns])
        along = towards[rows] @ powers[:2, columns]
        depth_squared = depth * ray_length
        depth_squared *= depth_squared
        dot = depth_squared - depth * along
        distance = np.sqrt(np.maximum(dot - depth * along + np.float32(to_light @ to_light), np.float32(1e-12)))
        light_cosine = (light_cosine - depth * ray_cosine) / distance
        ray_cosine /= ray_length
        # Take the cosine with the half vector (l + v) / |l + v|, where |l + v|² = 2 + 2 l·v
        between = dot / (distance * depth * ray_length)
        half = np.sqrt(np.maximum(2 + 2 * between, np.float32(1e-12)))
        np.copyto(cosines[rows, columns], (light_cosine - ray_cosine) / half, where=visible)
    return cosines


def highlight_mask(
    radiance: Image,
    variance: Image,
    usable: BoolArray,
    saturated: BoolArray,
    cosines: Image,
    normal: Image,
    light_colour: tuple[float, ...],
) -> BoolArray:
    """Mask (H, W) of pixels that a surface reflection brightens by more than ``HighlightOptions.tolerated``.

    Args:
        radiance, variance: (H, W, C), linear radiance and its variance.
        usable: (H, W), pixels whose whole footprint is tooth and whose value is valid.
        saturated: (H, W), saturated tooth pixels; near the mirror direction they belong to a highlight's core.
        cosines: (H, W) from ``half_cosines``.
        normal: (H, W, 3), outward.
        light_colour: the light's intensity per channel (C,).
    """
    import cv2

    o = HighlightOptions()
    cone = np.float32(np.cos(np.radians(o.cone_deg)))
    is_near = cosines > cone
    near, saturated_near = usable & is_near, saturated & is_near
    mask = np.zeros(usable.shape, dtype=bool)
    if not (near | saturated_near).any():
        return mask
    around = usable & (cosines > np.float32(np.cos(np.radians(PROFILE_DEG))))
    axis = np.asarray(light_colour, dtype=np.float64)
    axis /= np.linalg.norm(axis)
    brightness = along_axis(radiance, axis)
    far = usable & (cosines < np.float32(np.cos(np.radians(o.lobe_deg)))) & (brightness > 0)
    shading = fit_shading(brightness, far, normal, o.shading_error)
    colour = _fit_colour(radiance, variance, brightness, usable, far, axis, o) if radiance.shape[-1] >= 3 else None

    # Estimate the reflected part of each pixel and test it against the thresholds, a few rows at a time
    weak, strong = saturated_near.astype(np.uint8), saturated_near
    profile = LobeProfile()
    for rows in bands(usable.shape):
        own = around[rows]
        if not own.any():
            continue
        estimate, weight = _reflected(
            radiance[rows], variance[rows], brightness[rows], normal[rows], rows, axis, shading, colour
        )
        bright = brightness[rows]
        fraction = estimate / np.maximum(bright, np.float32(1e-30))
        significance = estimate * np.sqrt(weight)
        is_weak = near[rows] & (fraction > np.float32(o.weak)) & (significance > np.float32(o.weak_sigma))
        weak[rows] |= is_weak
        strong[rows] |= is_weak & (fraction > np.float32(o.strong)) & (significance > np.float32(o.strong_sigma))
        profile.add(cosines[rows][own], bright[own], estimate[own], weight[own])
    found = profile.lobe(o.tolerated, o.cone_deg)
    if found is not None and not lobe_explains_light(found, brightness, usable, normal, cosines):
        found = None
    if found is None and not strong.any():
        return mask

    # Apply hysteresis: keep connected weak pixels that contain a strong one, and add one pixel of bloom around them
    count, labels = cv2.connectedComponents(weak, connectivity=8)
    of_core = np.zeros(count, dtype=np.uint8)
    of_core[labels[strong]] = 1
    of_core[0] = 0
    core = of_core[labels]
    bloom = cv2.dilate(core, np.ones((3, 3), np.uint8)) > 0
    masked = bloom if found is None else bloom | (cosines > np.float32(np.cos(found.half_angle)))
    return np.asarray((usable | saturated) & masked)


def along_axis(image: Image, axis: NDArray[np.float64]) -> Image:
    """Scalar product (H, W) of every pixel of an image (H, W, C) with a vector (C,)."""
    return np.asarray(image.reshape(-1, image.shape[-1]) @ axis.astype(np.float32), dtype=np.float32).reshape(
        image.shape[:2]
    )


@dataclass(frozen=True)
class _Colour:
    """Diffuse chroma of an image.

    Attributes:
        direction: (C,) unit vector of the chroma, perpendicular to the light's colour.
        inverse_ratio: (H, W) brightness over chroma of diffuse light in each pixel's neighbourhood.
        misfit: relative standard deviation of the residual beyond the sensor's noise, at least ``colour_error``.
    """

    direction: NDArray[np.float64]
    inverse_ratio: Image
    misfit: float


def _reflected(
    radiance: Image,
    variance: Image,
    brightness: Image,
    normal: Image,
    rows: slice,
    axis: NDArray[np.float64],
    shading: Shading | None,
    colour: _Colour | None,
) -> tuple[Image, Image]:
    """Estimate the reflected part of the brightness (h, w) and its inverse variance (h, w), 0 where unknown.

    The estimates from shading and from colour are combined by inverse variance. Colour: with v = UV·d along the tooth's
    own chroma d, and ρ = v/S of diffuse light, the reflection is S − v/ρ; its variance grows as 1/ρ².
    """
    tiny = np.float32(1e-30)
    flat = variance.reshape(-1, variance.shape[-1])
    total, weight = np.zeros_like(brightness), np.zeros_like(brightness)
    if shading is not None:
        expected = shading.at(normal)
        spread = (flat @ (axis**2).astype(np.float32)).reshape(brightness.shape)
        own = 1 / np.maximum(spread + (np.float32(shading.misfit) * expected) ** 2, tiny)
        total += own * (brightness - expected)
        weight += own
    if colour is not None:
        estimate, spread = _by_colour(
            radiance, variance, brightness, axis, colour.direction, colour.inverse_ratio[rows]
        )
        own = 1 / np.maximum(spread + (np.float32(colour.misfit) * brightness) ** 2, tiny)
        total += own * estimate
        weight += own
    return np.divide(total, np.maximum(weight, tiny), out=total), weight


def _by_colour(
    radiance: Image,
    variance: Image,
    brightness: Image,
    axis: NDArray[np.float64],
    direction: NDArray[np.float64],
    inverse_ratio: Image,
) -> tuple[Image, Image]:
    """Reflected part S − v/ρ (...) of pixels (..., C) by their colour, and its variance (...) from the noise alone."""
    estimate = brightness - radiance @ direction.astype(np.float32) * inverse_ratio
    spread = np.zeros_like(brightness)
    for c in range(radiance.shape[-1]):
        factor = np.float32(axis[c]) - np.float32(direction[c]) * inverse_ratio
        factor *= factor
        factor *= variance[..., c]
        spread += factor
    return estimate, spread


def _fit_colour(
    radiance: Image,
    variance: Image,
    brightness: Image,
    usable: BoolArray,
    far: BoolArray,
    axis: NDArray[np.float64],
    o: HighlightOptions,
) -> _Colour | None:
    """Estimate the diffuse chroma from the pixels ``far``; None if they are too few or have none."""
    import cv2

    if np.count_nonzero(far) < 20:
        return None
    far_map = far.astype(np.float32)
    chroma = np.zeros(len(axis))
    for rows in bands(far.shape):
        chroma += far_map[rows].ravel() @ radiance[rows].reshape(-1, len(axis))
    chroma -= (chroma @ axis) * axis
    length = float(np.linalg.norm(chroma))
    if length <= 0:
        return None
    direction = chroma / length
    # Average the ratio of chroma to brightness over each neighbourhood; where no diffuse pixel is near, it falls back
    # to the image's mean
    along = along_axis(radiance, direction)
    mean_along, mean_brightness = (float(cv2.mean(image, far.astype(np.uint8))[0]) for image in (along, brightness))
    reach = max(2.0, 0.15 * float(np.sqrt(np.count_nonzero(usable))))
    along *= far_map
    factor = max(1, int(reach / 6))
    # Blur a reduced image, because a wide blur removes the detail that the reduction loses
    known = _wide_blur(far_map, reach, factor) + 0.05
    local_along = (_wide_blur(along, reach, factor) + 0.05 * mean_along) / known
    np.multiply(brightness, far_map, out=far_map)
    local_brightness = (_wide_blur(far_map, reach, factor) + 0.05 * mean_brightness) / known
    ratio = np.maximum(local_along / np.maximum(local_brightness, 1e-30), 0.1 * mean_along / mean_brightness)
    inverse = (1 / ratio).astype(np.float32)
    if factor > 1:
        inverse = np.asarray(cv2.resize(inverse, usable.shape[::-1], interpolation=cv2.INTER_LINEAR), dtype=np.float32)
    # Take the residual of diffuse pixels, less their noise, as the model's error: light that has travelled far through
    # a tooth is more yellow than light that has not
    chosen = lit_pixels(brightness, far)
    level = brightness.ravel()[chosen]
    values, noise = (image.reshape(-1, len(axis))[chosen] for image in (radiance, variance))
    residual, spread = _by_colour(values, noise, level, axis, direction, inverse.ravel()[chosen])
    excess = max(float(np.mean(residual**2) - np.mean(spread)), 0.0)
    return _Colour(direction, inverse, max(o.colour_error, float(np.sqrt(excess) / level.mean())))


def _wide_blur(image: Image, sigma_px: float, factor: int) -> Image:
    """Reduce an image (H, W) by ``factor`` and blur it by a Gaussian of ``sigma_px`` pixels of the full image."""
    import cv2

    height, width = image.shape
    if factor > 1:
        image = cv2.resize(image, (max(1, width // factor), max(1, height // factor)), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px / factor), dtype=np.float32)
