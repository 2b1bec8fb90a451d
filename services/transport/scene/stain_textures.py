"""Stains: a texture a_t on a tooth's outer surface that attenuates light on its way in and out (teeth 2018 Eq. 1, 10),
and the derivative to its texels.

A path that crosses stained faces k carries the factor prod a_t(k), so its derivative to a texel is its contribution
times the texel's bilinear weight over a_t at each of these faces, including those on the connection to the light.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from services.transport.optics.parameters import Stain
from services.transport.scene.geometry import Hit


@dataclass
class FaceCrossing:
    """One of the stained faces that a path crossed, each kept with equal probability."""

    primitive: mi.UInt32
    uv: mi.Point2f
    tooth: mi.UInt32
    number: mi.Float
    """Number of stained faces crossed; 0 when there was none."""
    u: mi.Float
    """Remainder of a uniform random number, which decides the next choice."""

    @staticmethod
    def none(u: mi.Float) -> FaceCrossing:
        """An empty reservoir."""
        return FaceCrossing(mi.UInt32(0), mi.Point2f(0), mi.UInt32(0), mi.Float(0), u)

    def offer(self, hit: Hit, active: mi.Bool) -> FaceCrossing:
        """The reservoir after one more face was offered where ``active``."""
        number = self.number + dr.select(active, 1.0, 0.0)
        chosen = self.u * number < 1
        take = active & chosen
        rest = dr.select(chosen, self.u * number, (self.u * number - 1) / dr.maximum(number - 1, 1))
        return FaceCrossing(
            dr.select(take, hit.primitive, self.primitive),
            dr.select(take, hit.uv, self.uv),
            dr.select(take, hit.surface, self.tooth),
            number,
            dr.select(active, dr.clip(rest, 0, 0.99999994), self.u),
        )


class StainTextures:
    """The textures of all stained teeth, and the texture coordinates of their faces."""

    def __init__(self, corners_uv: list[NDArray[np.float64]], stains: tuple[Stain | None, ...]) -> None:
        """Take texture coordinates (F, 3, 2) of every tooth's outer faces, in the order of the scene's faces, and every
        tooth's texture.
        """
        sizes = [(1, 1) if stain is None else stain.transmittance.shape for stain in stains]
        first = np.cumsum([0] + [height * width for height, width in sizes])
        self.ranges = tuple(
            None if stain is None else (int(a), stain.transmittance.shape)
            for a, stain in zip(first, stains, strict=False)
        )
        self.count = int(first[-1])
        values = [np.ones(1) if stain is None else stain.transmittance.reshape(-1) for stain in stains]
        self._values = mi.Float(np.concatenate(values).astype(np.float32))
        self._corners = mi.Float(np.concatenate(corners_uv).reshape(-1).astype(np.float32))
        self._layout = mi.UInt32(
            np.array([(a, *size) for a, size in zip(first, sizes, strict=False)], dtype=np.uint32).reshape(-1)
        )
        dr.eval(self._values, self._corners, self._layout)

    def split_by_tooth(self, texels: NDArray[np.float64]) -> tuple[NDArray[np.float64] | None, ...]:
        """Split values of all texels into every tooth's (H, W); None for a tooth without stains."""
        return tuple(
            None if place is None else texels[place[0] : place[0] + place[1][0] * place[1][1]].reshape(place[1])
            for place in self.ranges
        )

    def transmittance(self, hit: Hit, active: mi.Bool) -> mi.Float:
        """a_t at a hit of a tooth's outer surface; 1 in lanes that are not active."""
        value = mi.Float(0)
        for texel, weight in self._texels(hit.primitive, hit.uv, hit.surface, active):
            value = dr.fma(weight, dr.gather(mi.Float, self._values, texel, active), value)
        return dr.select(active, value, 1)

    def scores(self, crossing: FaceCrossing, active: mi.Bool) -> list[tuple[mi.UInt32, mi.Float]]:
        """Texels of a kept face, and d ln(path) / d(texel), scaled so that this face stands for all faces of the
        path.
        """
        texels = self._texels(crossing.primitive, crossing.uv, crossing.tooth, active)
        a_t = mi.Float(0)
        for texel, weight in texels:
            a_t = dr.fma(weight, dr.gather(mi.Float, self._values, texel, active), a_t)
        return [(texel, weight * crossing.number / a_t) for texel, weight in texels]

    def _texels(
        self, primitive: mi.UInt32, uv: mi.Point2f, tooth: mi.UInt32, active: mi.Bool
    ) -> list[tuple[mi.UInt32, mi.Float]]:
        # Texel centres lie at half-integers; outside the outermost ones the texture is constant.
        weights = (1 - uv.x - uv.y, uv.x, uv.y)
        place = mi.Point2f(0)
        for corner, weight in enumerate(weights):
            place += weight * dr.gather(mi.Point2f, self._corners, primitive * 3 + corner, active)
        first, height, width = (dr.gather(mi.UInt32, self._layout, tooth * 3 + k, active) for k in range(3))
        x = dr.clip(place.x * width - 0.5, 0, mi.Float(width) - 1)
        y = dr.clip(place.y * height - 0.5, 0, mi.Float(height) - 1)
        column, row = mi.UInt32(x), mi.UInt32(y)
        u, v = x - column, y - row
        next_column, next_row = dr.minimum(column + 1, width - 1), dr.minimum(row + 1, height - 1)
        return [
            (first + row * width + column, (1 - u) * (1 - v)),
            (first + row * width + next_column, u * (1 - v)),
            (first + next_row * width + column, (1 - u) * v),
            (first + next_row * width + next_column, u * v),
        ]
