"""Light that reaches a surface directly from a point light."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]


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
