"""Which pixels show a surface reflection instead of light that was inside the tooth.

Mallick et al. 2005 rotate RGB so that one axis, S, is the light's colour; a reflection adds to S alone. Teeth are nearly
light-coloured, so ‖UV‖ is small and noisy: here S against UV becomes one linear functional per pixel with its variance, and is
joined by what the scan knows, how far each normal is from the mirror direction.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Camera, Light
from services.preprocess.projection import Footprint

Image = NDArray[np.float32]
BoolArray = NDArray[np.bool_]
FITTED_PIXELS = 100_000


@dataclass(frozen=True)
class HighlightOptions:
    """Thresholds. Fractions are of the pixel's brightness along the light's colour."""

    tolerated: float = 0.02  # reflection left in the data; below twice the sensor noise of 1 %
    strong: float = 0.10  # starts a highlight
    weak: float = 0.03  # continues it
    strong_sigma: float = 5.0  # 6e-7 false alarms per pixel
    weak_sigma: float = 2.5
    cone_deg: float = 40.0  # widest half-angle at which a wet tooth still reflects visibly, scan error included
    lobe_deg: float = 25.0  # outside this half-angle the diffuse colour and shading are learned
    colour_error: float = 0.05  # how far a tooth's chroma strays from its neighbourhood's
    shading_error: float = 0.15  # how far shading strays from a quadratic in the normal


def half_angles(camera: Camera, light: Light, footprint: Footprint, band_rows: int = 512) -> Image:
    """Angle (H, W) in rad between the surface normal and the half vector of light and view; π where no surface is."""
    pose = np.asarray(camera.camera_from_world)
    eye = -pose[:3, :3].T @ pose[:3, 3]
    angles = np.full(footprint.mesh.shape, np.pi, dtype=np.float32)
    for top in range(0, len(angles), band_rows):
        rows = slice(top, top + band_rows)
        points = footprint.points_mm(camera, rows)
        to_light, to_eye = np.asarray(light.position_mm) - points, eye - points
        half = to_light / np.linalg.norm(to_light, axis=-1, keepdims=True) + to_eye / np.linalg.norm(
            to_eye, axis=-1, keepdims=True
        )
        cosine = (half * footprint.normal[rows]).sum(axis=-1) / np.maximum(np.linalg.norm(half, axis=-1), 1e-12)
        angles[rows] = np.where(footprint.mesh[rows] >= 0, np.arccos(np.clip(cosine, -1, 1)), np.pi)
    return angles


def highlight_mask(
    radiance: Image,
    variance: Image,
    usable: BoolArray,
    saturated: BoolArray,
    angles: Image,
    normal: Image,
    light_colour: tuple[float, ...],
    options: HighlightOptions | None = None,
) -> BoolArray:
    """Mask (H, W) of pixels that a surface reflection brightens by more than ``options.tolerated``.

    Args:
        radiance, variance: (H, W, C), linear, and its variance.
        usable: (H, W), pixels whose whole footprint is tooth and whose value is good.
        saturated: (H, W), tooth pixels without a value because too bright; near the mirror direction they are a highlight's core.
        angles: (H, W) from ``half_angles``.
        normal: (H, W, 3), outward.
        light_colour: the light's intensity per channel.
    """
    import cv2

    o = options or HighlightOptions()
    near = usable & (angles < np.radians(o.cone_deg))
    burnt = saturated & (angles < np.radians(o.cone_deg))
    if not (near | burnt).any():
        return np.zeros(usable.shape, dtype=bool)
    axis = np.asarray(light_colour, dtype=np.float64)
    axis /= np.linalg.norm(axis)
    brightness = (radiance @ axis.astype(np.float32)).astype(np.float32)
    far = usable & (angles > np.radians(o.lobe_deg)) & (brightness > 0)

    # Combine both estimates of the reflected part by their inverse variances
    estimate, weight = _by_shading(brightness, variance @ (axis**2).astype(np.float32), usable, far, normal, o)
    if radiance.shape[-1] >= 3:
        by_colour, colour_weight = _by_colour(radiance, variance, brightness, usable, far, axis, o)
        estimate = (estimate * weight + by_colour * colour_weight) / np.maximum(weight + colour_weight, 1e-30)
        weight = weight + colour_weight
    sigma = 1 / np.sqrt(np.maximum(weight, 1e-30))
    fraction = estimate / np.maximum(brightness, 1e-30)

    # Hysteresis: a strong core, continued through weak neighbours, and one pixel of bloom
    weak = near & (fraction > o.weak) & (estimate > o.weak_sigma * sigma)
    strong = weak & (fraction > o.strong) & (estimate > o.strong_sigma * sigma)
    weak, strong = weak | burnt, strong | burnt
    labels = cv2.connectedComponents(weak.astype(np.uint8), connectivity=8)[1]
    core = np.isin(labels, np.unique(labels[strong])) & weak
    bloom = cv2.dilate(core.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0

    lobe = angles < _lobe_angle(estimate, weight, brightness, usable, angles, o)
    return (usable | saturated) & (bloom | lobe) if core.any() else np.zeros(usable.shape, dtype=bool)


def _by_shading(
    brightness: Image, variance: Image, usable: BoolArray, far: BoolArray, normal: Image, o: HighlightOptions
) -> tuple[Image, Image]:
    """Reflected part and inverse variance, taking diffuse shading as a quadratic in the normal (nine coefficients)."""
    lit = far & (brightness > 0.1 * np.quantile(brightness[far], 0.95)) if far.any() else far
    chosen = np.flatnonzero(lit)
    if len(chosen) < 90:
        return np.zeros_like(brightness), np.zeros_like(brightness)
    # Nine coefficients need no more than evenly strided pixels
    chosen = chosen[:: -(-len(chosen) // FITTED_PIXELS)]
    terms = np.stack(tuple(_quadratic(normal.reshape(-1, 3)[chosen].astype(np.float64))), axis=-1)
    level = brightness.ravel()[chosen].astype(np.float64)
    # A small ridge keeps directions that the visible normals do not span at zero
    matrix = terms.T @ terms
    coefficients = np.linalg.solve(matrix + 1e-4 * np.trace(matrix) / 9 * np.eye(9), terms.T @ level)
    shading = np.zeros_like(brightness)
    for coefficient, term in zip(coefficients, _quadratic(normal), strict=True):
        shading += np.float32(coefficient) * term
    # The fit's own misfit says how far to trust it
    misfit = max(o.shading_error, float(np.sqrt(np.mean((level - terms @ coefficients) ** 2)) / level.mean()))
    weight = usable / np.maximum(variance + (misfit * shading) ** 2, 1e-30)
    return brightness - shading, weight.astype(np.float32)


def _quadratic(normal: NDArray[Any]) -> Iterator[NDArray[Any]]:
    """The nine monomials of a normal (..., 3) up to degree two, as spherical harmonics up to scale."""
    x, y, z = (normal[..., k] for k in range(3))
    yield np.ones_like(x)
    yield from (x, y, z)
    yield x * y
    yield y * z
    yield z * x
    yield x * x - y * y
    yield 3 * z * z - 1


def _wide_blur(image: Image, sigma_px: float) -> Image:
    """Gaussian blur; a wide one is made on a reduced image, which it cannot tell apart."""
    import cv2

    factor = max(1, int(sigma_px / 6))
    height, width = image.shape
    small = (
        image
        if factor == 1
        else cv2.resize(image, (max(1, width // factor), max(1, height // factor)), interpolation=cv2.INTER_AREA)
    )
    blurred = cv2.GaussianBlur(small, (0, 0), sigma_px / factor)
    return np.asarray(
        blurred if factor == 1 else cv2.resize(blurred, (width, height), interpolation=cv2.INTER_LINEAR),
        dtype=np.float32,
    )


def _by_colour(
    radiance: Image,
    variance: Image,
    brightness: Image,
    usable: BoolArray,
    far: BoolArray,
    axis: NDArray[np.float64],
    o: HighlightOptions,
) -> tuple[Image, Image]:
    """Reflected part and inverse variance from S against UV.

    With v = UV·d along the tooth's own chroma d and ρ = v/S of diffuse light, S − v/ρ is the reflection; its variance grows as 1/ρ².
    """
    if np.count_nonzero(far) < 20:
        return np.zeros_like(brightness), np.zeros_like(brightness)
    chroma = radiance[far].sum(axis=0, dtype=np.float64)
    chroma -= (chroma @ axis) * axis
    length = float(np.linalg.norm(chroma))
    if length <= 0:
        return np.zeros_like(brightness), np.zeros_like(brightness)
    direction = chroma / length
    # Diffuse ratio in the neighbourhood, falling back to the image's where no diffuse pixel is near
    along = (radiance @ direction.astype(np.float32)).astype(np.float32)
    reach = max(2.0, 0.15 * float(np.sqrt(np.count_nonzero(usable))))
    mean_along, mean_brightness = float(along[far].mean()), float(brightness[far].mean())
    known = _wide_blur(far.astype(np.float32), reach) + 0.05
    local_along = (_wide_blur(along * far, reach) + 0.05 * mean_along) / known
    local_brightness = (_wide_blur(brightness * far, reach) + 0.05 * mean_brightness) / known
    ratio = np.maximum(local_along / np.maximum(local_brightness, 1e-30), 0.1 * mean_along / mean_brightness)
    estimate = brightness - along / ratio
    spread = np.zeros_like(brightness)
    for c in range(radiance.shape[-1]):
        spread += ((axis[c] - direction[c] / ratio) ** 2 * variance[..., c]).astype(np.float32)
    weight = usable / np.maximum(spread + (o.colour_error * brightness) ** 2, 1e-30)
    return estimate.astype(np.float32), weight.astype(np.float32)


def _lobe_angle(
    estimate: Image, weight: Image, brightness: Image, usable: BoolArray, angles: Image, o: HighlightOptions
) -> float:
    """Half-angle in rad within which the mean reflected fraction exceeds ``tolerated``: averaging sees tails that single pixels hide."""
    degrees = np.degrees(angles[usable])
    bins = np.minimum(degrees.astype(np.int64), 179)
    total = np.bincount(bins, brightness[usable], minlength=180)
    reflected = np.bincount(bins, estimate[usable], minlength=180)
    noise = np.sqrt(np.bincount(bins, 1 / np.maximum(weight[usable], 1e-30), minlength=180))
    # What remains outside the lobe is the method's own bias
    outside = slice(int(o.lobe_deg), int(o.cone_deg))
    bias = reflected[outside].sum() / max(total[outside].sum(), 1e-30)
    cone = 0
    for degree in np.flatnonzero(total[: int(o.cone_deg)] > 0):
        if reflected[degree] - bias * total[degree] < max(o.tolerated * total[degree], 2 * noise[degree]):
            break
        cone = int(degree) + 1
    return float(np.radians(cone))
