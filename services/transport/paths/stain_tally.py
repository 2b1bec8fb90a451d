"""Sums of the derivatives to the texels of stains."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from services.transport.paths.tally import Tally
from services.transport.scene.stain_textures import FaceCrossing, StainTextures


class StainTally(Tally):
    """Derivatives of sum(cotangent x images) to all texels, (batches, texels).

    Lanes add to shared slots, so the last bits of a sum depend on the order of threads.
    """

    def __init__(self, textures: StainTextures, cotangent: NDArray[np.float64], batches: int) -> None:
        """Take the cotangent (L, N)."""
        super().__init__(batches, textures.count, 0)
        self._textures, self._pixels = textures, cotangent.shape[1]
        self._cotangent = mi.Float(np.ascontiguousarray(cotangent.reshape(-1), dtype=np.float32))
        dr.eval(self._cotangent)

    def weight(self, row: mi.UInt32, light: mi.UInt32, active: mi.Bool) -> mi.Float:
        """Cotangent of a row's pixel under a light."""
        return dr.gather(mi.Float, self._cotangent, light * self._pixels + row % self._pixels, active)

    def credit(self, row: mi.UInt32, crossing: FaceCrossing, value: mi.Float, active: mi.Bool) -> None:
        """Add a contribution's derivative to the texels of its kept face."""
        active = active & (crossing.number > 0)
        for texel, score in self._textures.scores(crossing, active):
            dr.scatter_add(self.sums, mi.Float64(value * score), row // self._pixels * self.slots + texel, active)
