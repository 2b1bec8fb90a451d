"""Light on the dentin's border, gathered by photons, and the camera's walks that meet it.

Both score their crossings of the border with weight 1 / |n . w|, and expand directions in spherical harmonics
(``border_series``). Light that has not collided keeps its single direction instead. No path connects to a light or to
another path, so both walks are cheap, and a product of their sums accounts for all pairs of paths.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from services.transport.boundary.model import Boundary
from services.transport.paths.scores import Plan
from services.transport.paths.starts import CameraStart, LightStart
from services.transport.paths.tally import Tally
from services.transport.paths.walk import Walk
from services.transport.paths.walker import Flight, Walker
from services.transport.scene.geometry import Hit
from services.transport.scene.media import Media
from services.transport.scene.mesh_geometry import MeshGeometry

GRAZING_COSINE = 0.2
"""Smallest |n . w| of a crossing that is weighted by 1 / |n . w|, whose second moment diverges logarithmically. Below
it the weight is 2 / this value, the mean of 1 / |n . w| there, which is exact where radiance is constant over those
directions."""
FIXED_POINT = 2.0**36
"""Integer units of the light table per unit of weight: finer than single precision, and sums up to 1e8 do not
overflow."""

Array = NDArray[np.float64]


def harmonics(directions: Array, order: int) -> NDArray[np.float32]:
    """Real spherical harmonics of unit vectors (N, 3): (N, (order + 1)^2)."""
    values = dr.sh_eval(mi.Vector3f(directions.T.astype(np.float32)), order)
    return np.stack([np.broadcast_to(np.array(value), len(directions)) for value in values], axis=1)


def mean_inverse_cosine(cosine: mi.Float) -> mi.Float:
    """1 / |cosine|, or the mean of that over grazing cosines where the cosine is grazing."""
    size = dr.abs(cosine)
    return dr.select(size < GRAZING_COSINE, 2 / GRAZING_COSINE, dr.rcp(dr.maximum(size, GRAZING_COSINE)))


class Texels:
    """Patches of the border over which light is averaged."""

    def __init__(self, of_face: NDArray[np.int64], areas_mm2: Array, tooth: int) -> None:
        """Take the patch number (F,) and the area (F,) of each triangle of a tooth's dentin."""
        self.tooth = tooth
        self.count = int(of_face.max()) + 1
        self.areas_mm2 = np.bincount(of_face, areas_mm2)
        self.of_face = mi.UInt32(of_face.astype(np.uint32))
        dr.eval(self.of_face)


class BorderWalk(Walk, ABC):
    """The walk without connections, which instead scores its crossings of the border."""

    def __init__(
        self,
        geometry: MeshGeometry,
        media: Media,
        start: CameraStart | LightStart,
        texels: Texels,
        order: int,
        boundary: Boundary,
    ) -> None:
        super().__init__(geometry, media, None, start, Plan(), boundary)
        self.mesh, self.texels, self.order = geometry, texels, order
        self.columns = (order + 1) ** 2 + 1
        """Columns of a light table: one per harmonic of the light that has collided, and one for light that has not."""

    def _move(self, walker: Walker, flight: Flight, throughput: mi.Float) -> None:
        crosses = flight.meets & ~flight.reflects & ~flight.hit.outer
        if not self.mesh.single:
            crosses &= flight.hit.surface == self.mesh.teeth + self.texels.tooth
        strength = throughput * mean_inverse_cosine(dr.dot(walker.omega, flight.hit.normal))
        uncollided = self.scores.order(walker.scatterings) == 0

        def count(
            row: mi.UInt32, hit: Hit, omega: mi.Vector3f, strength: mi.Float, uncollided: mi.Bool, crosses: mi.Bool
        ) -> mi.UInt32:
            self._count(row, hit, omega, strength, uncollided, crosses)
            return row

        dr.if_stmt(
            (walker.row, flight.hit, walker.omega, strength, uncollided, crosses),
            crosses,
            count,
            lambda row, *_: row,
            label="border",
        )
        super()._move(walker, flight, throughput)

    @abstractmethod
    def _count(
        self, row: mi.UInt32, hit: Hit, omega: mi.Vector3f, strength: mi.Float, uncollided: mi.Bool, crosses: mi.Bool
    ) -> None:
        """Score crossings of a row's path with ``strength``, its weight over the cosine; ``uncollided`` paths have not
        collided.
        """

    def _texel(self, hit: Hit, active: mi.Bool) -> mi.UInt32:
        return dr.gather(
            mi.UInt32, self.texels.of_face, hit.primitive - self.mesh.first_dentin_face(self.texels.tooth), active
        )


class LightWalk(BorderWalk):
    """Photons from the lights; gathers the light on each texel by direction."""

    def __init__(
        self, geometry: MeshGeometry, media: Media, start: LightStart, texels: Texels, order: int, boundary: Boundary
    ) -> None:
        super().__init__(geometry, media, start, texels, order, boundary)
        self.photons = start
        # Sum whole numbers, so that sums do not depend on the order of threads.
        self.table = dr.zeros(mi.Int64, start.groups * texels.count * self.columns)
        dr.make_opaque(self.table)

    def gather(self, samples: int) -> NDArray[np.float32]:
        """Mean radiance on texels, (L, batches, texels, columns): light that has collided as coefficients of spherical
        harmonics, light that has not as its integral over directions.
        """
        self.trace(samples, Tally(1, 1, 0))
        dr.eval(self.table)
        dr.sync_thread()
        lights = self.photons
        sums = np.array(self.table).reshape(lights.count, lights.batches, -1, self.columns)
        scale = lights.power[:, None] / (FIXED_POINT * lights.rows_per_group * samples * self.texels.areas_mm2)
        return np.asarray(sums * scale[:, None, :, None], dtype=np.float32)

    def _omits_reflection(self, walker: Walker, medium: mi.UInt32) -> mi.Bool:  # noqa: ARG002 - cameras need the medium
        # Transmit light that has not scattered, and reflect none of it, as the straight connections of images do.
        return self.scores.order(walker.scatterings) == 0

    def _count(
        self, row: mi.UInt32, hit: Hit, omega: mi.Vector3f, strength: mi.Float, uncollided: mi.Bool, crosses: mi.Bool
    ) -> None:
        first = (self.photons.group(row) * self.texels.count + self._texel(hit, crosses)) * self.columns
        units = strength * FIXED_POINT
        for k, harmonic in enumerate(dr.sh_eval(omega, self.order)):
            dr.scatter_add(self.table, mi.Int64(units * harmonic), first + k, crosses & ~uncollided)
        dr.scatter_add(self.table, mi.Int64(units), first + self.columns - 1, crosses & uncollided)


class CameraWalk(BorderWalk):
    """Walks from the camera's pixels. At each crossing they multiply by the light there, weighted for their pixel, and
    sum the change with each shape mode.
    """

    def __init__(
        self,
        geometry: MeshGeometry,
        media: Media,
        start: CameraStart,
        texels: Texels,
        boundary: Boundary,
        coefficients: Array,
        light: NDArray[np.float32],
    ) -> None:
        """Take c_j (order + 1,), and light as (N, batches, texels, columns): coefficients of harmonics for crossings
        after a collision, and in the last column the light for crossings before any, which have a single direction.
        """
        super().__init__(geometry, media, start, texels, len(coefficients) - 1, boundary)
        self.pixels, self.light_batches = light.shape[:2]
        self.shape_modes = geometry.modes_of[texels.tooth]
        # Light that reaches the camera travels against the walk, which turns the sign of odd harmonics.
        self.coefficients = [dr.opaque(mi.Float, -c if j % 2 else c) for j, c in enumerate(coefficients.tolist())]
        self.light = mi.Float(light.reshape(-1))
        self.sums = dr.zeros(mi.Float64, start.rows * self.light_batches * self.shape_modes)
        dr.make_opaque(self.light, self.sums)

    def shape_sums(self, samples: int) -> Array:
        """Sums over every row's samples for each of M shape modes, (rows, batches of light, M)."""
        self.trace(samples, Tally(1, 1, 0))
        dr.eval(self.sums)
        dr.sync_thread()
        return np.array(self.sums).reshape(-1, self.light_batches, self.shape_modes)

    def _count(
        self, row: mi.UInt32, hit: Hit, omega: mi.Vector3f, strength: mi.Float, uncollided: mi.Bool, crosses: mi.Bool
    ) -> None:
        texel, speeds = self._texel(hit, crosses), self.mesh.velocity(hit, self.texels.tooth, crosses)
        harmonics = dr.sh_eval(omega, self.order)
        weighted = [harmonics[k] * c for j, c in enumerate(self.coefficients) for k in range(j * j, (j + 1) ** 2)]
        for batch in range(self.light_batches):
            first = ((row % self.pixels * self.light_batches + batch) * self.texels.count + texel) * self.columns
            change = dr.gather(mi.Float, self.light, first + self.columns - 1, crosses & uncollided)
            for k, harmonic in enumerate(weighted):
                change = dr.fma(harmonic, dr.gather(mi.Float, self.light, first + k, crosses & ~uncollided), change)
            for mode, speed in enumerate(speeds):
                slot = (row * self.light_batches + batch) * self.shape_modes + mode
                dr.scatter_add(
                    self.sums, mi.Float64(-strength * speed * change), slot, crosses, mode=dr.ReduceMode.NoConflicts
                )
