"""Enamel thickness: shortest distance from the enamel's outer surface to dentin."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Camera, Mesh
from services.fit.anatomy.distance import SurfaceDistance
from services.fit.anatomy.rays import RayScene, pixel_rays


def enamel_thickness_mm(points_mm: NDArray[np.float64], dentin: Mesh) -> NDArray[np.float64]:
    """Distance (N,) from points on the enamel's outer surface (N, 3) to the dentin surface, mm."""
    return SurfaceDistance(dentin).closest(points_mm)[1]


def thickness_image(outer: Mesh, dentin: Mesh, camera: Camera) -> NDArray[np.float64]:
    """Enamel thickness in mm at the surface point that each pixel sees, (H, W); NaN off the tooth."""
    hits = RayScene(outer).first_hits(*pixel_rays(camera))
    image = np.full(len(hits.hit), np.nan)
    if hits.hit.any():
        image[hits.hit] = enamel_thickness_mm(hits.points_mm[hits.hit], dentin)
    return image.reshape(camera.size[1], camera.size[0])
