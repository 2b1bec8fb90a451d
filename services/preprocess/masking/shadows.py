"""Shadows of objects without a scan, such as lips and retractor, found by comparing a camera's lights with each other.

A pixel lies in a light's shadow if it receives less than half of the direct light that would reach it unoccluded. The
unoccluded irradiance follows from the pixel's position and normal, and a tooth's brightness is about proportional to
the irradiance once that is blurred by the spread of light inside the tooth. So a pixel has about the same brightness
per unit irradiance under all lights, and it is shadowed under a light with a clearly lower one. Shadows of known
surfaces are part of the expected irradiance, because the fit renders them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]


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
