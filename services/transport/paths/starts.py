"""Starting points of walks, and their streams of random numbers.

A camera's streams depend on seed, camera, pixel and sample alone, never on block, batch or worker, so a result does not
depend on how the work was cut.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from services.transport.boundary.model import FlatBoundary
from services.transport.lighting.light_maps import aligned
from services.transport.scene.recipe import View

NEAR_MARGIN_MM = 1.0
"""Distance in mm from the sphere about the origin that holds the scene to the start of rays outside it."""


def stream(seed: mi.UInt32, pixel: mi.UInt32, sample: mi.UInt32) -> mi.PCG32:
    """Counter-based generator: two calls of the tiny encryption algorithm choose the state and stream of a PCG32
    generator.
    """
    a, b = mi.sample_tea_32(seed, pixel)
    c, d = mi.sample_tea_32(a ^ sample, b)
    rng = mi.PCG32()
    rng.state = (mi.UInt64(c) << 32) | mi.UInt64(d)
    rng.inc = (mi.UInt64(b) << 33) | (mi.UInt64(a) << 1) | 1
    return rng


def no_stream() -> mi.PCG32:
    """The generator of a lane that has no path yet."""
    rng = mi.PCG32()
    rng.state, rng.inc = mi.UInt64(0), mi.UInt64(1)
    return rng


@dataclass
class PathStart:
    """State of a fresh path."""

    rng: mi.PCG32
    origin: mi.Point3f
    omega: mi.Vector3f
    """Unit propagation direction."""
    enclosure: mi.UInt32
    """Solids or slab layer that the origin lies in; see ``geometry``."""
    weight: mi.Float
    """Throughput at the start."""


class CameraStart:
    """Walks that start at random points of a view's pixels (box filter); every batch leaves out its first ``skipped``
    samples.

    Every camera has streams of its own, because its name enters the seed.
    """

    fixed_lanes = False

    def __init__(self, view: View, batches: int, seed: int, radius_mm: float, skipped: int = 0) -> None:
        camera = view.camera
        width, _ = camera.size
        x, y = view.pixels[:, 0].astype(np.uint32), view.pixels[:, 1].astype(np.uint32)
        self.rows = batches * len(view)
        self._pixels = np.tile(y * width + x, batches)
        self._batch = np.repeat(np.arange(batches, dtype=np.uint32) + np.uint32(skipped * batches), len(view))
        self.pixel = aligned(mi.UInt32(self._pixels.astype(np.uint32)))
        self.batch = aligned(mi.UInt32(self._batch))
        self.width = dr.opaque(mi.UInt32, width)
        self.seed = dr.opaque(mi.UInt32, seed ^ zlib.crc32(camera.name.encode()))
        self.batches = batches
        pose = np.asarray(camera.camera_from_world)
        camera_centre = -pose[:3, :3].T @ pose[:3, 3]
        inverse = pose[:3, :3].T @ np.linalg.inv(np.asarray(camera.K))
        self._camera_centre = dr.opaque(mi.Point3f, camera_centre.tolist())
        self._columns = [dr.opaque(mi.Vector3f, inverse[:, k].tolist()) for k in range(3)]
        self._start_distance_mm = dr.opaque(
            mi.Float, max(float(np.linalg.norm(camera_centre)) - radius_mm - NEAR_MARGIN_MM, 0.0)
        )

    def begin(self, row: mi.UInt32, sample: mi.UInt32, active: mi.Bool) -> PathStart:
        """A path through a random point of the row's pixel; ``sample`` counts within the batch, from the first that is
        not skipped.
        """
        pixel = dr.gather(mi.UInt32, self.pixel, row, active)
        batch = dr.gather(mi.UInt32, self.batch, row, active)
        rng = stream(self.seed, pixel, sample * self.batches + batch)
        x = (pixel % self.width) + rng.next_float32()
        y = (pixel // self.width) + rng.next_float32()
        omega = dr.normalize(self._columns[0] * x + self._columns[1] * y + self._columns[2])
        return PathStart(
            rng, dr.fma(omega, self._start_distance_mm, self._camera_centre), omega, mi.UInt32(0), mi.Float(1)
        )


class LightStart:
    """Photons from every light, uniform over a rectangle that encloses the tooth as seen from that light, in batches of
    their own.

    Weights are near 1; ``power`` is the quantity that a weight of 1 represents. A group is one batch of one light;
    rows are ordered by light, then by batch.
    """

    fixed_lanes = False

    def __init__(
        self,
        positions_mm: NDArray[np.float64],
        intensities: NDArray[np.float64],
        outer_mm: NDArray[np.float64],
        batches: int,
        rows_per_group: int,
        seed: int,
    ) -> None:
        """Take the lights' positions (L, 3) and intensities (L,), and all vertices of the tooth (V, 3)."""
        self.count, self.batches, self.rows_per_group = len(positions_mm), batches, rows_per_group
        self.groups = self.count * batches
        self.rows = self.groups * rows_per_group
        distance = np.linalg.norm(positions_mm, axis=1)
        forward = -positions_mm / distance[:, None]
        helper = np.where(np.abs(forward[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
        right = np.cross(forward, helper)
        right /= np.linalg.norm(right, axis=1, keepdims=True)
        up = np.cross(forward, right)

        # Project the tooth through each light onto the plane across the origin.
        scale = distance[:, None] / (forward @ outer_mm.T + distance[:, None])
        across = np.stack([right @ outer_mm.T, up @ outer_mm.T]) * scale
        low, size = across.min(axis=2), np.ptp(across, axis=2)
        corner = right * low[0, :, None] + up * low[1, :, None]
        self.power = intensities * size[0] * size[1] / distance**2
        """Radiant intensity times the solid angle of each rectangle seen face on, (L,)."""
        before = np.minimum(np.linalg.norm(outer_mm, axis=1).max() + NEAR_MARGIN_MM, distance)
        columns = [forward, right * size[0, :, None], up * size[1, :, None], corner, distance[:, None], before[:, None]]
        self._frames = mi.Float(np.concatenate(columns, axis=1).astype(np.float32).reshape(-1))
        self._rows_per_group = dr.opaque(mi.UInt32, rows_per_group)
        self._batches = dr.opaque(mi.UInt32, batches)
        self.seed = dr.opaque(mi.UInt32, seed)
        dr.eval(self._frames)

    def group(self, row: mi.UInt32) -> mi.UInt32:
        """Group of a row: light x batches + batch."""
        return row // self._rows_per_group

    def begin(self, row: mi.UInt32, sample: mi.UInt32, active: mi.Bool) -> PathStart:
        """A photon on its way to a random point of its light's rectangle."""
        rng, first = stream(self.seed, row, sample), self.group(row) // self._batches * 14
        forward, right, up, corner = (
            mi.Vector3f(*(dr.gather(mi.Float, self._frames, first + 3 * k + axis, active) for axis in range(3)))
            for k in range(4)
        )
        distance, before = (dr.gather(mi.Float, self._frames, first + k, active) for k in (12, 13))
        across = corner + right * rng.next_float32() + up * rng.next_float32()
        squared = dr.squared_norm(across)
        inverse = dr.rsqrt(squared + dr.square(distance))
        omega = (across + forward * distance) * inverse
        # Start where the ray is as far from the light as the near plane, without the difference of two long distances.
        back = before + squared / (dr.rcp(inverse) + distance)
        cosine = distance * inverse
        return PathStart(rng, mi.Point3f(across - omega * back), omega, mi.UInt32(0), cosine * cosine * cosine)


class SlabStart:
    """Walks that enter a slab's lit face at its origin, z = 0: collimated at a cosine to the normal, or Lambertian."""

    fixed_lanes = True

    def __init__(self, rows: int, seed: int, *, diffuse: bool, boundary: FlatBoundary, cosine: float = 1.0) -> None:
        self.rows, self.diffuse, self.boundary = rows, diffuse, boundary
        self.cosine = mi.Float(1) if cosine == 1 else dr.opaque(mi.Float, cosine)
        self.seed = dr.opaque(mi.UInt32, seed)

    def begin(self, row: mi.UInt32, sample: mi.UInt32, active: mi.Bool) -> PathStart:  # noqa: ARG002 - views need the mask
        """A path just inside the lit face, weighted by the share of light that enters."""
        rng = stream(self.seed, row, sample)
        cosine = dr.sqrt(1 - rng.next_float32()) if self.diffuse else self.cosine
        weight, inside = self.boundary.enter(cosine)
        omega = mi.Vector3f(dr.sqrt(dr.maximum(1 - dr.square(inside), 0)), 0, inside)
        return PathStart(rng, mi.Point3f(0), omega, mi.UInt32(1), weight)
