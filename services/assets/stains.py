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
    """Write ``stain_<channel>.npy``, the fitted a_t, and ``stain_<channel>.png``, the absorbed share 1 - a_t in 16
    bits; return the pictures' paths by channel.
    """
    written = {}
    for channel, stain in stains.textures.items():
        np.save(folder / f"stain_{channel}.npy", stain.transmittance.astype(np.float32))
        written[channel] = folder / f"stain_{channel}.png"
        write_atomic(written[channel], png16_bytes(1 - stain.transmittance))
    return written


def stain_image(outer: Mesh, stains: ToothStains, camera: Camera) -> NDArray[np.float64]:
    """Transmittance a_t at the surface point that each pixel shows, (H, W, C) in the textures' order; NaN off the
    tooth.
    """
    from services.transport.rays import RayScene, pixel_rays

    hits = RayScene(outer).first_hits(*pixel_rays(camera))
    width, height = camera.size
    image = np.full((height * width, len(stains.textures)), np.nan)
    corners = outer.vertices_mm[outer.faces[hits.face[hits.hit]]]

    # Barycentric weights from the areas of the three triangles that a point forms with the edges.
    def doubled_area(a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1))

    points = hits.points_mm[hits.hit]
    weights = np.stack(
        [doubled_area(points, corners[:, (k + 1) % 3], corners[:, (k + 2) % 3]) for k in range(3)], axis=1
    )
    weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-300)
    uv = np.einsum("nc,ncd->nd", weights, stains.corners_uv[hits.face[hits.hit]])
    for k, stain in enumerate(stains.textures.values()):
        image[hits.hit, k] = looked_up(stain.transmittance, uv)
    return image.reshape(height, width, -1)


def looked_up(picture: NDArray[np.float64], uv: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values (N,) of a picture (H, W) at texture coordinates (N, 2), linear between the centres of texels."""
    texels, weights = bilinear_texels(uv, (picture.shape[0], picture.shape[1]))
    return np.asarray((picture.reshape(-1)[texels] * weights).sum(axis=1))
