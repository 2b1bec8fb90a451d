"""Linear radiance to pictures that people judge: tone mapping, signed residuals, sequential maps, PNG bytes."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Image8 = NDArray[np.uint8]

DIVERGING = (
    (0.0, (8, 69, 148)),
    (0.25, (66, 146, 198)),
    (0.5, (247, 247, 247)),
    (0.75, (230, 130, 40)),
    (1.0, (140, 45, 4)),
)
"""Blue to orange through near-white: distinct for all common colour-vision deficiencies and in grey by its ends'
darkness."""
SEQUENTIAL = (
    (0.0, (68, 1, 84)),
    (0.25, (59, 82, 139)),
    (0.5, (33, 145, 140)),
    (0.75, (94, 201, 98)),
    (1.0, (253, 231, 37)),
)
"""Viridis at five stops (van der Walt and Smith 2015): perceptually uniform, safe for colour-vision deficiencies."""
RESIDUAL_OF_WHITE = 0.25
"""Residuals are drawn from minus to plus this fraction of the picture's white."""
MASKED = (128, 128, 128)

ColourStops = tuple[tuple[float, tuple[int, int, int]], ...]


@dataclass(frozen=True)
class Picture:
    """One photo of the capture beside the fit's render of it, linear radiance (H, W, C)."""

    camera: str
    light: str
    held_out: bool
    photo: NDArray[np.floating]
    render: NDArray[np.floating]
    valid: NDArray[np.bool_]
    """(H, W), True where the pixel was compared."""

    @property
    def residual(self) -> NDArray[np.float64]:
        """Render minus photo, (H, W, C), 0 where not valid."""
        difference = np.asarray(self.render, dtype=np.float64) - np.asarray(self.photo, dtype=np.float64)
        return np.where(self.valid[..., None], difference, 0.0)


def white_level(radiance: NDArray[np.floating], valid: NDArray[np.bool_], percentile: float = 99.0) -> float:
    """Radiance that is shown as white: a high percentile of the valid pixels, so that one hot pixel does not darken the
    picture.
    """
    values = np.asarray(radiance)[valid]
    values = values[np.isfinite(values)]
    level = float(np.percentile(values, percentile)) if values.size else 0.0
    return level if level > 0 else 1.0


def tone_map(radiance: NDArray[np.floating], white: float) -> Image8:
    """Linear radiance (H, W) or (H, W, C) to sRGB bytes (H, W, 3), IEC 61966-2-1; one channel becomes grey, values
    above ``white`` clip.
    """
    linear = np.clip(np.nan_to_num(np.asarray(radiance, dtype=np.float64)) / white, 0.0, 1.0)
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)
    return as_rgb(np.round(255 * srgb).astype(np.uint8))


def as_rgb(image: Image8) -> Image8:
    """Bytes with one, two or three channels as (H, W, 3); a missing third channel is black."""
    channels = image[..., None] if image.ndim == 2 else image
    if channels.shape[-1] == 1:
        return np.repeat(channels, 3, axis=-1)
    padding = np.zeros((*channels.shape[:-1], 3 - channels.shape[-1]), dtype=np.uint8)
    return np.concatenate([channels, padding], axis=-1)


def colour_map(fraction: NDArray[np.floating], stops: ColourStops) -> Image8:
    """Fractions 0 to 1 (clipped) to bytes by linear interpolation between colour stops."""
    positions = [position for position, _ in stops]
    planes = [np.interp(np.nan_to_num(fraction), positions, [colour[k] for _, colour in stops]) for k in range(3)]
    return np.round(np.stack(planes, axis=-1)).astype(np.uint8)


def signed_map(residual: NDArray[np.floating], limit: float, valid: NDArray[np.bool_]) -> Image8:
    """Residual (H, W) or (H, W, C; its channel mean) in -limit (blue) to +limit (orange); grey where not valid."""
    values = np.asarray(residual, dtype=np.float64)
    values = values.mean(axis=-1) if values.ndim == 3 else values
    picture = colour_map(0.5 + 0.5 * values / limit, DIVERGING)
    picture[~valid] = MASKED
    return picture


def scalar_map(values: NDArray[np.floating], limits: tuple[float, float]) -> Image8:
    """A quantity (H, W) between two limits; grey where not finite."""
    picture = colour_map((np.asarray(values) - limits[0]) / (limits[1] - limits[0]), SEQUENTIAL)
    picture[~np.isfinite(values)] = MASKED
    return picture


def enlarge(image: Image8, least_px: int = 240) -> Image8:
    """Repeat pixels by a whole factor until the larger side has at least ``least_px``, so that pixels stay pixels."""
    factor = max(1, -(-least_px // max(image.shape[:2])))
    return image.repeat(factor, axis=0).repeat(factor, axis=1)


def png_bytes(image: Image8) -> bytes:
    """Bytes (H, W, 3) as a PNG file."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image)).save(stream, format="PNG", optimize=True)
    return stream.getvalue()


def data_uri(image: Image8) -> str:
    """Bytes (H, W, 3) as a ``data:`` address for a page that opens alone."""
    return "data:image/png;base64," + base64.b64encode(png_bytes(image)).decode()


def png16_bytes(values: NDArray[np.floating]) -> bytes:
    """A grey PNG of 16 bits from values (H, W) of 0 to 1, linear."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(np.rint(65535 * np.clip(values, 0, 1)).astype(np.uint16)).save(stream, format="PNG")
    return stream.getvalue()
