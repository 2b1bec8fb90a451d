"""Pictures of linear radiance for people: tone mapping, signed residuals, sequential maps, PNG bytes."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

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
"""Blue to orange through near-white: distinct for all common colour-vision deficiencies; in grey the ends are darker
than the centre."""
SEQUENTIAL = (
    (0.0, (68, 1, 84)),
    (0.25, (59, 82, 139)),
    (0.5, (33, 145, 140)),
    (0.75, (94, 201, 98)),
    (1.0, (253, 231, 37)),
)
"""Viridis at five stops (van der Walt and Smith 2015): perceptually uniform, safe for colour-vision deficiencies."""
RESIDUAL_OF_WHITE = 0.25
"""Fraction of the picture's white at which the colours of residuals end, on either side."""
MASKED = (128, 128, 128)
"""Colour (sRGB bytes) of pixels that were not compared."""

ColourStops = tuple[tuple[float, tuple[int, int, int]], ...]


PICTURES = "pictures.npz"
"""File of the final pictures, in the fit's folder."""


@dataclass(frozen=True)
class Picture:
    """One photograph of the capture and the fit's render of it, linear radiance (H, W, C)."""

    camera: str
    light: str
    held_out: bool
    photo: NDArray[np.floating]
    render: NDArray[np.floating]
    valid: NDArray[np.bool_]
    """Mask (H, W) of the compared pixels."""

    @property
    def residual(self) -> NDArray[np.float64]:
        """Render minus photograph (H, W, C), 0 where not valid."""
        difference = np.asarray(self.render, dtype=np.float64) - np.asarray(self.photo, dtype=np.float64)
        return np.where(self.valid[..., None], difference, 0.0)


def white_level(radiance: NDArray[np.floating], valid: NDArray[np.bool_], percentile: float = 99.0) -> float:
    """Radiance that is shown as white: a high percentile of the valid pixels, so that a single hot pixel does not
    darken the picture.
    """
    values = np.asarray(radiance)[valid]
    values = values[np.isfinite(values)]
    level = float(np.percentile(values, percentile)) if values.size else 0.0
    return level if level > 0 else 1.0


def tone_map(radiance: NDArray[np.floating], white: float) -> Image8:
    """Bytes (H, W, 3) in sRGB (IEC 61966-2-1) of linear radiance (H, W) or (H, W, C); one channel becomes grey, values
    above ``white`` clip.
    """
    linear = np.clip(np.nan_to_num(np.asarray(radiance, dtype=np.float64)) / white, 0.0, 1.0)
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)
    return as_rgb(np.round(255 * srgb).astype(np.uint8))


def as_rgb(image: Image8) -> Image8:
    """RGB bytes (H, W, 3) of an image with one, two or three channels; a missing third channel is black."""
    channels = image[..., None] if image.ndim == 2 else image
    if channels.shape[-1] == 1:
        return np.repeat(channels, 3, axis=-1)
    padding = np.zeros((*channels.shape[:-1], 3 - channels.shape[-1]), dtype=np.uint8)
    return np.concatenate([channels, padding], axis=-1)


def colour_map(fraction: NDArray[np.floating], stops: ColourStops) -> Image8:
    """Bytes (..., 3) of fractions 0 to 1 (clipped), by linear interpolation between colour stops."""
    positions = [position for position, _ in stops]
    planes = [np.interp(np.nan_to_num(fraction), positions, [colour[k] for _, colour in stops]) for k in range(3)]
    return np.round(np.stack(planes, axis=-1)).astype(np.uint8)


def signed_map(residual: NDArray[np.floating], limit: float, valid: NDArray[np.bool_]) -> Image8:
    """Picture of a residual (H, W), or of the channel mean of (H, W, C), from -limit (blue) to +limit (orange); grey
    where not valid.
    """
    values = np.asarray(residual, dtype=np.float64)
    values = values.mean(axis=-1) if values.ndim == 3 else values
    picture = colour_map(0.5 + 0.5 * values / limit, DIVERGING)
    picture[~valid] = MASKED
    return picture


def scalar_map(values: NDArray[np.floating], limits: tuple[float, float]) -> Image8:
    """Picture of a quantity (H, W) between two limits; grey where it is not finite."""
    picture = colour_map((np.asarray(values) - limits[0]) / (limits[1] - limits[0]), SEQUENTIAL)
    picture[~np.isfinite(values)] = MASKED
    return picture


def enlarge(image: Image8, least_px: int = 240) -> Image8:
    """Repeat pixels by a whole factor until the larger side has at least ``least_px``, so that the pixels
    stay sharp.
    """
    factor = max(1, -(-least_px // max(image.shape[:2])))
    return image.repeat(factor, axis=0).repeat(factor, axis=1)


def png_bytes(image: Image8) -> bytes:
    """PNG file of bytes (H, W, 3)."""
    from PIL import Image

    stream = io.BytesIO()
    # The best compression takes some twelve times as long and saves a few hundredths of a photograph's bytes.
    Image.fromarray(np.ascontiguousarray(image)).save(stream, format="PNG", compress_level=3)
    return stream.getvalue()


def data_uri(image: Image8) -> str:
    """``data:`` address of bytes (H, W, 3), for a page without other files."""
    return "data:image/png;base64," + base64.b64encode(png_bytes(image)).decode()


def png16_bytes(values: NDArray[np.floating]) -> bytes:
    """Grey PNG file of 16 bits from linear values (H, W) of 0 to 1."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(np.rint(65535 * np.clip(values, 0, 1)).astype(np.uint16)).save(stream, format="PNG")
    return stream.getvalue()


def store_pictures(path: Path, pictures: Sequence[Picture]) -> None:
    """Store pictures in a file."""
    arrays: dict[str, NDArray[np.generic]] = {}
    for k, picture in enumerate(pictures):
        arrays |= {
            f"{k}.name": np.array([picture.camera, picture.light]),
            f"{k}.held_out": np.array(picture.held_out),
            f"{k}.photo": picture.photo.astype(np.float32),
            f"{k}.render": picture.render.astype(np.float32),
            f"{k}.valid": picture.valid,
        }
    np.savez_compressed(path, allow_pickle=False, **arrays)


def read_pictures(path: Path) -> tuple[Picture, ...]:
    """Pictures that ``store_pictures`` wrote."""
    with np.load(path, allow_pickle=False) as stored:
        count = sum(name.endswith(".name") for name in stored.files)
        names = [[str(part) for part in stored[f"{k}.name"]] for k in range(count)]
        return tuple(
            Picture(
                camera,
                light,
                bool(stored[f"{k}.held_out"]),
                stored[f"{k}.photo"],
                stored[f"{k}.render"],
                stored[f"{k}.valid"],
            )
            for k, (camera, light) in enumerate(names)
        )
