"""Export of fitted stains: stored with the fit, written as textures of the asset, and drawn in a camera's view."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Camera, Mesh
from services.core.pages.pictures import png16_bytes
from services.core.store import write_atomic
from services.transport.scene.stain_uv import ToothStains, bilinear_texels


def write_textures(folder: Path, stains: ToothStains) -> dict[str, Path]:
    """Write ``stain_<channel>.npy``, the fitted a_t, ``stain_<channel>_se.npy``, its standard error where that is
    known, and ``stain_<channel>.png``, the absorbed share 1 - a_t in 16 bits; return the pictures' paths by channel.
    """
    written = {}
    for channel, stain in stains.textures.items():
        np.save(folder / f"stain_{channel}.npy", stain.transmittance.astype(np.float32))
        if stain.se is not None:
            np.save(folder / f"stain_{channel}_se.npy", stain.se.astype(np.float32))
        written[channel] = folder / f"stain_{channel}.png"
        write_atomic(written[channel], png16_bytes(1 - stain.transmittance))
    return written


def stain_images(
    outer: Mesh, stains: ToothStains, camera: Camera
) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Transmittance a_t at the surface point that each pixel shows, (H, W, C) in the textures' order, and its standard
    error: NaN off the tooth and, for the error, in channels where it is not known; None where it is known in none.

    Between texels the error is interpolated too, which is its upper limit: the errors of neighbours then agree.
    """
    from services.transport.rays import RayScene, pixel_rays
    from services.transport.stain_view import surface_uv

    hits = RayScene(outer).first_hits(*pixel_rays(camera))
    width, height = camera.size
    image, errors = (np.full((height * width, len(stains.textures)), np.nan) for _ in range(2))
    uv = surface_uv(outer, stains.corners_uv, hits)
    for k, stain in enumerate(stains.textures.values()):
        image[hits.hit, k] = looked_up(stain.transmittance, uv)
        if stain.se is not None:
            errors[hits.hit, k] = looked_up(stain.se, uv)
    known = any(stain.se is not None for stain in stains.textures.values())
    return image.reshape(height, width, -1), errors.reshape(height, width, -1) if known else None


def looked_up(picture: NDArray[np.float64], uv: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values (N,) of a picture (H, W) at texture coordinates (N, 2), linear between the centres of texels."""
    texels, weights = bilinear_texels(uv, (picture.shape[0], picture.shape[1]))
    return np.asarray((picture.reshape(-1)[texels] * weights).sum(axis=1))
