"""The canonical tooth frame: x mesial, y buccal, z occlusal, origin at the tooth's centre."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class ToothFrame:
    """Rigid pose of a tooth: ``canonical = rotation @ world + translation_mm``."""

    rotation: NDArray[np.float64]
    translation_mm: NDArray[np.float64]

    @staticmethod
    def identity() -> ToothFrame:
        """For meshes that are in the canonical frame already."""
        return ToothFrame(np.eye(3), np.zeros(3))

    @property
    def axes(self) -> NDArray[np.float64]:
        """(3, 3): rows are the mesial, buccal and occlusal directions in world coordinates."""
        return self.rotation

    def canonical_from_world(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (N, 3) in the canonical frame."""
        return points_mm @ self.rotation.T + self.translation_mm

    def world_from_canonical(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (N, 3) in world coordinates."""
        return (points_mm - self.translation_mm) @ self.rotation
