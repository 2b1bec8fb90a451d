"""Shadows of what no scan shows, lips and retractor, found by comparing a light with the camera's other lights.

A pixel lies in a light's shadow where less than half of the direct light that would reach it unoccluded does. What
reaches a pixel of known normal is known but for the shadow, and a tooth's brightness is about proportional to it once
the light has spread inside. So a pixel's images under all lights share one factor, its brightness under unit
irradiance, and a shadow is an image that falls short of it. Known surfaces' shadows are in the expected irradiance, as
the fit renders them.
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
"""Pixel of what a light sees: a shadow's edge is known to so much, a quarter of what light spreads inside a tooth."""
DEPTH_BIAS_MM = 0.3
"""A surface this much nearer to a light shades what lies behind it; less may be the surface itself: scans are rough by
so much."""
MIN_COSINE = 0.05
"""Of the angle between light and normal below which a surface's slant is taken for this one's, 87 degrees."""


@dataclass(frozen=True)
class ShadowRule:
    """When a pixel counts as shadowed.

    Lengths are millimetres on the tooth, ratios are of the brightness that other lights let expect.
    """

    spread_mm: float = 1.6
    """Light enters enamel and leaves again about so far away (standard deviation); a shadow's edge is as soft."""
    spread_share: float = 0.75
    """Of a tooth's light that has spread so; the rest leaves where it entered."""
    smooth_mm: float = 0.5
    """Brightness is compared over about so much (standard deviation), finer than light spreads, so that one pixel's
    noise decides nothing."""
    telling: float = 0.4
    """A light tells of a pixel's brightness if it gives this much of the irradiance of the pixel's best light; grazing
    ones are known worst."""
    facing: float = 0.03
    """Cosine of the light's angle below which a pixel glows mainly by light from beside it and says nothing."""
    bright_quantile: float = 0.65
    """Of a pixel's ratios under all lights, taken for unshadowed: most lights are not shadowed, and noise must not
    choose."""
    certain: float = 0.47
    """A ratio below it is a shadow by definition."""
    possible: float = 0.57
    """A ratio below it is a shadow where it touches a certain one: light that has spread inside brightens a shadow's
    rim."""
    model_error: float = 0.12
    """Relative error of the expected brightness: view-dependent reflection and light that leaves far from where it
    entered."""


def expected_irradiance(
    points_mm: Image, normal: Image, position_mm: tuple[float, float, float], unoccluded: NDArray[np.bool_] | None
) -> Image:
    """Irradiance (H, W) of a unit point light, 1/mm²; 0 where the surface turns away, where known surfaces shade it, or
    nothing is seen.
    """
    way = np.asarray(position_mm, dtype=np.float32) - points_mm
    squared = (way * way).sum(axis=-1)
    facing = (way * normal).sum(axis=-1)
    irradiance = np.where(np.isfinite(squared) & (facing > 0), facing / np.maximum(squared, 1e-12) ** 1.5, 0)
    if unoccluded is not None:
        irradiance = np.where(unoccluded, irradiance, 0)
    return np.asarray(irradiance, dtype=np.float32)


def reached_by(
    points_mm: Image, normal: Image, position_mm: tuple[float, float, float], meshes: Sequence[Mesh]
) -> NDArray[np.bool_]:
    """Whether known surfaces let a point light through to each point (H, W), by what the light itself would see of
    them.
    """
    eye = _camera_at(position_mm, meshes)
    nearest = project(eye, meshes)
    height, width = points_mm.shape[:2]
    pixels, depth = eye.project(points_mm.reshape(-1, 3).astype(np.float64))
    column, row = (np.floor(np.nan_to_num(pixels[:, k], nan=-1.0)).astype(np.int64) for k in range(2))
    inside = (column >= 0) & (row >= 0) & (column < eye.size[0]) & (row < eye.size[1])
    first = nearest.depth_mm[np.where(inside, row, 0), np.where(inside, column, 0)]
    # A surface seen at a slant is nearer across one of the light's pixels by the pixel times the tangent of the angle.
    way = np.asarray(position_mm) - points_mm
    cosine = np.clip((way * normal).sum(axis=-1) / np.linalg.norm(way, axis=-1), MIN_COSINE, 1).ravel()
    slant_mm = SHADOW_PIXEL_MM * np.sqrt(1 / cosine**2 - 1)
    blocked = inside & (first < depth - DEPTH_BIAS_MM - slant_mm)
    return np.asarray(~blocked.reshape(height, width))


def _camera_at(position_mm: tuple[float, float, float], meshes: Sequence[Mesh]) -> Camera:
    """A camera in a light's place that frames the meshes, with pixels of ``SHADOW_PIXEL_MM`` on them."""
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
    seen: NDArray[np.bool_],
    pixel_mm: float,
    rule: ShadowRule | None = None,
) -> Image:
    """Probability (L, H, W) that each pixel lies in each light's shadow; 0 where nothing can be said.

    Args:
        radiance, variance: (L, H, W), of one channel or their sum; pixels without a value have infinite variance.
        irradiance: (L, H, W), expected without unknown occluders.
        facing: (L, H, W), cosine of the angle between normal and light.
        seen: (H, W), pixels that show a tooth.
        pixel_mm: size of a pixel on the tooth.
    """
    from scipy.stats import norm

    rule = rule or ShadowRule()
    inside = np.stack([_spread(layer, seen, rule.spread_mm / pixel_mm) for layer in irradiance])
    known = seen & np.isfinite(variance)
    smooth_px = rule.smooth_mm / pixel_mm
    expected = (1 - rule.spread_share) * irradiance + rule.spread_share * inside
    expected, radiance = (
        np.stack([_spread(layer, told, smooth_px) for layer, told in zip(stack, known, strict=True)])
        for stack in (expected, radiance)
    )
    tells = known & (facing > rule.facing) & (expected > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        response = np.where(tells, radiance / expected, np.nan)
    bright = expected >= rule.telling * np.where(tells, expected, 0).max(axis=0)
    brightness = _upper(np.where(bright, response, np.nan), rule.bright_quantile)
    # A value without any certainty has an infinite error, and its probability is one half
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        ratio = response / brightness
        error = np.sqrt(variance) / (expected * brightness)
        ratio, error = np.where(tells, ratio, np.nan), np.where(tells, error, np.nan)
        total = np.sqrt(rule.model_error**2 + error**2)
    certain = ratio < rule.certain
    likely = ratio < rule.possible
    touched = np.stack([_touching(seeds, grown) for seeds, grown in zip(certain, likely, strict=True)])
    limit = np.where(touched, rule.possible, rule.certain)
    with np.errstate(invalid="ignore"):
        probability = norm.cdf((limit - ratio) / total)
    return np.where(tells, probability, 0).astype(np.float32)


def _spread(layer: Image, seen: NDArray[np.bool_], sigma_px: float) -> Image:
    """Mean of what surrounds each pixel on the tooth, by a Gaussian weight."""
    import cv2

    weight = cv2.GaussianBlur(seen.astype(np.float32), (0, 0), max(sigma_px, 0.1))
    blurred = cv2.GaussianBlur(np.where(seen, layer, 0).astype(np.float32), (0, 0), max(sigma_px, 0.1))
    return np.asarray(np.where(seen, blurred / np.maximum(weight, 1e-6), 0), dtype=np.float32)


def _upper(response: Image, quantile: float) -> Image:
    """A quantile (H, W) over lights of a stack (L, H, W) with gaps; NaN where all are gaps."""
    ordered = np.sort(response, axis=0)  # NaN comes last
    count = np.isfinite(response).sum(axis=0)
    place = np.clip(np.rint(quantile * (count - 1)), 0, None).astype(np.int64)
    return np.asarray(np.take_along_axis(ordered, place[None], axis=0)[0], dtype=np.float32)


def _touching(seeds: NDArray[np.bool_], grown: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The connected parts of ``grown`` that hold a seed."""
    import cv2

    _, labels = cv2.connectedComponents(grown.astype(np.uint8), connectivity=8)
    kept = np.unique(labels[seeds & grown])
    return np.isin(labels, kept[kept > 0])
