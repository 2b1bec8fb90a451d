"""Shadows of objects without a scan, such as lips and retractor, found by comparing a camera's lights with each other.

A pixel lies in a light's shadow if it receives less than half of the direct light that would reach it unoccluded. The
unoccluded irradiance follows from the pixel's position and normal, and a tooth's brightness is about proportional to
the irradiance once that is blurred by the spread of light inside the tooth. So a pixel has about the same brightness
per unit irradiance under all lights, and it is shadowed under a light with a clearly lower one. Shadows of known
surfaces are part of the expected irradiance, because the fit renders them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Camera, Mesh
from services.preprocess.projection import project

Image = NDArray[np.float32]
SHADOW_PIXEL_MM = 0.25
"""Pixel size, mm on the surface, of the depth map seen from a light. It is the accuracy of a shadow's edge, a quarter
of the distance that light spreads inside a tooth."""
DEPTH_BIAS_MM = 0.3
"""Smallest distance in mm by which a surface must be nearer to the light to shade a point. A smaller difference may be
the point's own surface, because scans are rough by this much."""
MIN_COSINE = 0.05
"""Smallest cosine between light and normal that is used for a surface's slant, 87 degrees; smaller ones are raised to
it."""


@dataclass(frozen=True)
class ShadowRule:
    """Parameters that decide when a pixel counts as shadowed.

    Lengths are millimetres on the tooth. Ratios are relative to the brightness expected from the other lights.
    """

    spread_mm: float = 1.6
    """Standard deviation of the distance between the points where light enters and leaves enamel; a shadow's edge is as
    soft."""
    spread_share: float = 0.75
    """Fraction of a tooth's light that has spread by this distance; the rest leaves where it entered."""
    smooth_mm: float = 0.5
    """Standard deviation of the Gaussian that smooths brightness before the comparison, so that one pixel's noise
    decides nothing. It is finer than the spread of light."""
    min_relative_irradiance: float = 0.25
    """Smallest irradiance, as a fraction of that of the pixel's best light, of a light that counts for the pixel's
    unshadowed brightness. Grazing lights are left out because their irradiance is the least certain."""
    min_cosine: float = 0.03
    """Cosine of incidence below which a pixel is lit mainly by light from its neighbourhood and is not judged."""
    bright_quantile: float = 0.65
    """Quantile of a pixel's ratios under all lights that is taken as the unshadowed one. Most lights are not shadowed,
    and a maximum would be chosen by noise."""
    certain: float = 0.47
    """Ratio below which a pixel is shadowed wherever it lies, a little below the one half that defines a shadow."""
    possible: float = 0.5
    """Ratio below which a pixel is shadowed if it is connected to a certain one: the one half that defines a shadow."""
    model_error: float = 0.12
    """Relative error of the expected brightness: view-dependent reflection and light that leaves far from where it
    entered."""


def expected_irradiance(
    points_mm: Image, normal: Image, position_mm: tuple[float, float, float], unoccluded: NDArray[np.bool_] | None
) -> Image:
    """Irradiance (H, W) of a point light of unit intensity, 1/mm².

    It is 0 where the surface faces away, where known surfaces shade it, and where there is no surface.

    Args:
        points_mm: (H, W, 3) world positions of the surface.
        normal: (H, W, 3) unit normals.
        position_mm: position of the light.
        unoccluded: (H, W) points that the light reaches; None if it reaches all.
    """
    to_light = np.asarray(position_mm, dtype=np.float32) - points_mm
    squared = (to_light * to_light).sum(axis=-1)
    facing = (to_light * normal).sum(axis=-1)
    irradiance = np.where(np.isfinite(squared) & (facing > 0), facing / np.maximum(squared, 1e-12) ** 1.5, 0)
    if unoccluded is not None:
        irradiance = np.where(unoccluded, irradiance, 0)
    return np.asarray(irradiance, dtype=np.float32)


def is_unoccluded(
    points_mm: Image, normal: Image, position_mm: tuple[float, float, float], meshes: Sequence[Mesh]
) -> NDArray[np.bool_]:
    """Whether a point light reaches each point (H, W) past known surfaces, by a shadow map rendered from the light."""
    light_camera = _camera_at(position_mm, meshes)
    nearest = project(light_camera, meshes)
    height, width = points_mm.shape[:2]
    pixels, depth = light_camera.project(points_mm.reshape(-1, 3).astype(np.float64))
    column, row = (np.floor(np.nan_to_num(pixels[:, k], nan=-1.0)).astype(np.int64) for k in range(2))
    inside = (column >= 0) & (row >= 0) & (column < light_camera.size[0]) & (row < light_camera.size[1])
    first = nearest.depth_mm[np.where(inside, row, 0), np.where(inside, column, 0)]
    # Allow for the slant: across one pixel of the map a surface's depth varies by the pixel size times the tangent of
    # the angle of incidence.
    to_light = np.asarray(position_mm) - points_mm
    cosine = np.clip((to_light * normal).sum(axis=-1) / np.linalg.norm(to_light, axis=-1), MIN_COSINE, 1).ravel()
    slant_mm = SHADOW_PIXEL_MM * np.sqrt(1 / cosine**2 - 1)
    blocked = inside & (first < depth - DEPTH_BIAS_MM - slant_mm)
    return np.asarray(~blocked.reshape(height, width))


def _camera_at(position_mm: tuple[float, float, float], meshes: Sequence[Mesh]) -> Camera:
    """Camera at a light's position that frames the meshes with pixels of ``SHADOW_PIXEL_MM`` at their centre."""
    vertices = np.concatenate([mesh.vertices_mm for mesh in meshes])
    centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    forward = centre - np.asarray(position_mm)
    distance = float(np.linalg.norm(forward))
    forward /= distance
    right = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    focal = distance / SHADOW_PIXEL_MM
    local = (vertices - np.asarray(position_mm)) @ rotation.T
    image = focal * local[:, :2] / local[:, 2:]
    low = np.floor(image.min(axis=0)) - 1
    width, height = (int(extent) for extent in np.ceil(image.max(axis=0)) + 1 - low)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ np.asarray(position_mm)
    K = ((focal, 0.0, float(-low[0])), (0.0, focal, float(-low[1])), (0.0, 0.0, 1.0))
    camera_from_world = tuple(tuple(float(value) for value in row) for row in pose)
    return Camera(name="light", size=(width, height), K=K, camera_from_world=camera_from_world)  # type: ignore[arg-type]


def shadow_confidence(
    radiance: Image,
    variance: Image,
    irradiance: Image,
    facing: Image,
    visible: NDArray[np.bool_],
    pixel_mm: float,
) -> Image:
    """Probability (L, H, W) that each pixel lies in each light's shadow; 0 where it cannot be judged.

    Args:
        radiance, variance: (L, H, W), of one channel or their sum; pixels without a value have infinite variance.
        irradiance: (L, H, W), expected without unknown occluders.
        facing: (L, H, W), cosine of the angle between normal and light.
        visible: (H, W), pixels that show a tooth.
        pixel_mm: size of a pixel on the tooth.
    """
    from scipy.stats import norm

    rule = ShadowRule()
    # Expect brightness in proportion to the irradiance, a part of it blurred by the spread of light inside the tooth;
    # smooth it and the image alike
    inside = np.stack([_spread(layer, visible, rule.spread_mm / pixel_mm) for layer in irradiance])
    known = visible & np.isfinite(variance)
    smooth_px = rule.smooth_mm / pixel_mm
    expected = (1 - rule.spread_share) * irradiance + rule.spread_share * inside
    expected, radiance = (
        np.stack([_spread(layer, mask, smooth_px) for layer, mask in zip(stack, known, strict=True)])
        for stack in (expected, radiance)
    )
    # Take a high quantile of a pixel's brightness per irradiance over its well-lit images as the unshadowed one
    is_judged = known & (facing > rule.min_cosine) & (expected > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        response = np.where(is_judged, radiance / expected, np.nan)
    bright = expected >= rule.min_relative_irradiance * np.where(is_judged, expected, 0).max(axis=0)
    brightness = _high_quantile(np.where(bright, response, np.nan), rule.bright_quantile)
    # Compare each image with it; a value of infinite error gets the probability one half
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        ratio = response / brightness
        error = np.sqrt(variance) / (expected * brightness)
        ratio, error = np.where(is_judged, ratio, np.nan), np.where(is_judged, error, np.nan)
        total = np.sqrt(rule.model_error**2 + error**2)
    # Raise the threshold of likely pixels that are connected to a certain one
    certain = ratio < rule.certain
    likely = ratio < rule.possible
    is_connected = np.stack([_connected(seeds, grown) for seeds, grown in zip(certain, likely, strict=True)])
    limit = np.where(is_connected, rule.possible, rule.certain)
    with np.errstate(invalid="ignore"):
        probability = norm.cdf((limit - ratio) / total)
    return np.where(is_judged, probability, 0).astype(np.float32)


def _spread(layer: Image, visible: NDArray[np.bool_], sigma_px: float) -> Image:
    """Gaussian-weighted mean around each pixel over the pixels ``visible``; 0 elsewhere."""
    import cv2

    weight = cv2.GaussianBlur(visible.astype(np.float32), (0, 0), max(sigma_px, 0.1))
    blurred = cv2.GaussianBlur(np.where(visible, layer, 0).astype(np.float32), (0, 0), max(sigma_px, 0.1))
    return np.asarray(np.where(visible, blurred / np.maximum(weight, 1e-6), 0), dtype=np.float32)


def _high_quantile(response: Image, quantile: float) -> Image:
    """Quantile (H, W) over the lights of a stack (L, H, W), NaN values left out; NaN where all are NaN."""
    ordered = np.sort(response, axis=0)  # NaN comes last
    count = np.isfinite(response).sum(axis=0)
    rank = np.clip(np.rint(quantile * (count - 1)), 0, None).astype(np.int64)
    return np.asarray(np.take_along_axis(ordered, rank[None], axis=0)[0], dtype=np.float32)


def _connected(seeds: NDArray[np.bool_], grown: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Connected components of ``grown`` that contain a seed."""
    import cv2

    _, labels = cv2.connectedComponents(grown.astype(np.uint8), connectivity=8)
    kept = np.unique(labels[seeds & grown])
    return np.isin(labels, kept[kept > 0])
