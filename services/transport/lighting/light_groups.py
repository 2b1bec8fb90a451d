"""Groups of lights. A connection looks up one light of every group, because few of many lights matter to one vertex.

A vertex scatters most of its light into a lobe, so that most lights contribute little through it. Each group holds
lights from all around the tooth, and one of them is chosen in proportion to its contribution at full transmittance,
which costs a fraction of a look-up for each light.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from services.transport.lighting.light_maps import aligned


class LightGroups:
    """All lights of a rig, in about as many groups as there are lights in each."""

    def __init__(self, positions_mm: NDArray[np.float64], intensities: NDArray[np.float64]) -> None:
        """Take positions (L, 3) and intensities (L,)."""
        lights = len(positions_mm)
        self.count = -(-lights // math.ceil(math.sqrt(lights)))
        self.size = -(-lights // self.count)

        # Write neighbouring lights into rows, so that a column, which is a group, has one light of every part of the
        # dome; dark copies fill the last row.
        slots = np.arange(self.size * self.count).reshape(self.size, self.count).T.reshape(-1)
        members = spatial_order(positions_mm)[slots % lights]
        columns = np.concatenate([positions_mm, intensities[:, None]], axis=1)[members]
        columns[slots >= lights, 3] = 0
        self._lights = aligned(mi.Float(columns.astype(np.float32).reshape(-1)))
        self._members = mi.UInt32(members.astype(np.uint32))
        dr.eval(self._members)

    def choose(
        self, group: mi.UInt32, point: mi.Point3f, importance: Callable[[mi.Vector3f], mi.Float], u: mi.Float
    ) -> tuple[mi.UInt32, mi.Float]:
        """Choose one light of a group in proportion to importance(direction) x intensity / distance^2.

        Returns:
            Index of the light, and the sum of those products over the group, which equals the chosen light's product
            over its probability.
        """
        first, total, sums = group * self.size, mi.Float(0), []
        for member in range(self.size):
            light = dr.gather(mi.Vector4f, self._lights, first + member)
            towards = mi.Vector3f(light.x, light.y, light.z) - mi.Vector3f(point)
            inverse = dr.rsqrt(dr.squared_norm(towards))
            total = dr.fma(importance(towards * inverse), light.w * dr.square(inverse), total)
            sums.append(total)
        threshold, chosen = u * total, first
        for partial_sum in sums[:-1]:
            chosen = chosen + dr.select(partial_sum <= threshold, mi.UInt32(1), mi.UInt32(0))
        return dr.gather(mi.UInt32, self._members, chosen), total


def spatial_order(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Indices (N,) of points (N, 3), ordered by repeated halving along the widest axis, so that points close in space
    are close in the list.
    """

    def halve(chosen: NDArray[np.int64]) -> list[int]:
        if len(chosen) == 1:
            return [int(chosen[0])]
        axis = np.argmax(np.ptp(points[chosen], axis=0))
        ordered = chosen[np.argsort(points[chosen, axis], kind="stable")]
        return [*halve(ordered[: len(ordered) // 2]), *halve(ordered[len(ordered) // 2 :])]

    return np.array(halve(np.arange(len(points))))
