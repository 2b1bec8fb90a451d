"""Images of a slab and their derivatives by blocks of paths. Each block is a pure function of its description, so it
may run anywhere.

A block is one light's paths of one batch. Its sums depend on the seed and the numbers that identify it alone, and sums
are always added in the order of the blocks, so the answer is the same on any number of workers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from services.core.errors import NonFiniteError
from services.slab.cell.dictionary import KNOTS, Material
from services.slab.cell.interface import Interface
from services.slab.cell.kernel_tables import tables_of
from services.slab.cell.rig import Rig, Views
from services.slab.cell.single import single_scattering

Array = NDArray[np.float64]
Floats = NDArray[np.floating]

THICK, THICK_SHARE = 4.0, 0.25
"""Optical thickness above which only ``THICK_SHARE`` of the late vertices are connected to cameras: 1.5 times faster
there, slower below."""


@dataclass(frozen=True)
class PathBlock:
    """Paths of one light; ``seed`` and ``place`` (step, batch) determine its random numbers."""

    rig: Rig
    light: int
    material: Material
    seed: int
    place: tuple[int, ...]
    paths: int
    scores: bool


@dataclass(frozen=True)
class BlockSums:
    """Means over a block's paths, per unit of the beam's power."""

    images: Array
    """(cameras, pixels), scattering orders two and up."""
    rows: Floats
    """Sums of shares and path lengths (cameras, pixels, KNOTS + 1), empty without scores. They are rounded, far below
    the noise of the paths, because they are most of what travels between workers."""
    totals: Array
    """Scattered light that leaves by the light's face, by the other face, and that was cut off (3,)."""


class Blocks(Protocol):
    """A function that runs blocks: ``map`` itself, or the workers of a cluster."""

    def __call__(self, task: Callable[[PathBlock], BlockSums], blocks: Sequence[PathBlock], /) -> Iterable[BlockSums]:
        """Results in the order of the blocks."""


@dataclass(frozen=True)
class Batches:
    """Independent estimates of all scattering orders: images (B, images, pixels) and rows (B, images, pixels, KNOTS +
    1).
    """

    images: Array
    rows: Floats
    """Rounded as those of ``BlockSums``."""
    single_images: Array
    """Light that has scattered once, which is the same in all batches and has no noise (images, pixels)."""
    single_rows: Array
    """Rows of that light (images, pixels, KNOTS + 1)."""

    @property
    def mean(self) -> Array:
        """Mean of the batches' images (images, pixels)."""
        return np.asarray(self.images.mean(axis=0))


def run_block(block: PathBlock) -> BlockSums:
    """Trace one block.

    Raises:
        NonFiniteError: a sum is NaN or infinite.
    """
    from services.slab.cell.streams import block_key
    from services.slab.cell.walk import trace

    rig, views = block.rig, block.rig.lights[block.light]
    images = np.zeros((len(views.images), rig.grid.pixels))
    rows = np.zeros((*images.shape, KNOTS + 1) if block.scores else (0, 0, 0))
    totals = np.zeros(3)
    trace(
        block_key(block.seed, *block.place, block.light), block.paths, tuple(tables_of(block.material)), rig.width_mm,
        _late_share(block), *_arrays(rig.interface, views), _grid(rig), block.scores, images, rows, totals,
    )  # fmt: skip
    if not (np.isfinite(images).all() and np.isfinite(rows).all()):
        raise NonFiniteError(
            f"A slab's images are not finite at {np.count_nonzero(~np.isfinite(images))} pixels; report the parameters."
        )
    return BlockSums(images / block.paths, (rows / block.paths).astype(np.float32), totals / block.paths)


def render(
    rig: Rig, material: Material, *, seed: int, step: int, batches: int, paths: int, scores: bool, blocks: Blocks = map
) -> Batches:
    """Render independent batches of ``paths`` paths per light."""
    lights = range(len(rig.lights))
    tasks = [
        PathBlock(rig, light, material, seed, (step, batch), paths, scores)
        for batch in range(batches)
        for light in lights
    ]
    first_images, first_rows = single_scattering(rig, material, scores=scores)
    images = np.empty((batches, *first_images.shape))
    rows = np.empty((batches, *first_rows.shape), np.float32)
    for block, sums in zip(tasks, blocks(run_block, tasks), strict=True):
        number, own = block.place[-1], rig.lights[block.light].images
        images[number, own] = first_images[own] + sums.images
        if scores:
            rows[number, own] = first_rows[own] + sums.rows
    return Batches(images, rows, first_images, first_rows)


def _late_share(block: PathBlock) -> float:
    """Share of late vertices that are connected to cameras."""
    return THICK_SHARE if block.material.extinction_per_mm * block.rig.width_mm > THICK else 1.0


def _arrays(interface: Interface, views: Views) -> tuple[object, ...]:
    """Arguments of the kernel for the glass, the light, the beam and the cameras."""
    glass = (
        interface.index_outside / interface.index,
        (interface.index_glass or 0.0) / interface.index,
        float(interface.glass_mm),
    )
    reflected = 1 - interface.transmittance(views.sine)
    light = (views.sine, views.transmittance, views.shift_mm, reflected)
    beam = (views.beam.disc, views.beam.x_mm, views.beam.y_mm)
    mirrors = np.array([1 - interface.transmittance(sine) for sine in views.sines])
    cameras = views.far, views.sines, views.scales, views.shifts_mm, mirrors, views.distances_mm
    return glass, light, beam, *cameras


def _grid(rig: Rig) -> tuple[float, float, float, float, int, int, bool]:
    grid = rig.grid
    return grid.x_from_mm, grid.y_from_mm, grid.pitch_x_mm, grid.pitch_y_mm, grid.columns, grid.rows, grid.folded
