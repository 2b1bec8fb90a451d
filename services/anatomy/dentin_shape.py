"""The dentin surface as a record: a base mesh and the modes that move it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.anatomy.frame import ToothFrame
from services.core.geometry import Mesh


@dataclass(frozen=True)
class DentinShape:
    """The dentin surface as a blend shape V = B0 + sum_m c_m modes_m (teeth 2018 Eq. 5); a known one has no modes."""

    base: Mesh
    """Surface B0 at zero weights."""
    modes_mm: NDArray[np.float64]
    """Displacements B_m - B0, (M, V, 3); M = 0 for a known surface."""
    frame: ToothFrame | None = None
    """Canonical frame of the tooth, along whose axes the modes point; None where they do not."""

    @staticmethod
    def known(surface: Mesh) -> DentinShape:
        """Make a shape of a known surface that does not move."""
        return DentinShape(surface, np.zeros((0, len(surface.vertices_mm), 3)))

    def vertices_mm(self, shape: tuple[float, ...]) -> NDArray[np.float64]:
        """Vertices (V, 3) in mm for blend weights c (M,)."""
        return self.base.vertices_mm + np.tensordot(np.asarray(shape, dtype=np.float64), self.modes_mm, axes=1)
