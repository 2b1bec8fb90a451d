"""Single scattering by quadrature along the beam, with its scores: exact except for the light of three and more
reflections.

A view has one scattering angle per number of reflections of the beam before, and of the light after, the scattering.
The depth is cut into cells; within a cell the exit point moves evenly, so that the beam's cross-section is averaged in
closed form.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from services.slab.cell.dictionary import KNOTS, SPACING_RAD, Material
from services.slab.cell.interface import Interface
from services.slab.cell.perspective import leaving_direction
from services.slab.cell.rig import Beam, Grid, Rig, Views

Array = NDArray[np.float64]

DEPTH_CELLS = 96
"""Number of depth cells: an image at sigma_t w = 10 changes by less than 1e-4 when this number is doubled."""
DISC_NODES = 48
MAX_REFLECTIONS = 2
"""Largest number of reflections of beam and scattered light together; near the normal three carry some 1e-5 of the
light."""


def single_scattering(rig: Rig, material: Material, *, scores: bool) -> tuple[Array, Array]:
    """Images (images, pixels) and rows (images, pixels, KNOTS + 1) of order one; rows are empty without ``scores``."""
    images = np.zeros(rig.shape)
    rows = np.zeros((*rig.shape, KNOTS + 1) if scores else (0,))
    for views in rig.lights:
        for camera, image in enumerate(views.images):
            if math.isfinite(views.distances_mm[camera]):
                add_perspective_view(rig, material, views, camera, images[image], rows[image] if scores else None)
                continue
            for cosine, lengths, shares in _routes(rig, material, views, camera):
                # Interpolate f at the route's one angle from its two knots.
                place = math.acos(min(max(cosine, -1.0), 1.0)) / SPACING_RAD
                knot = min(int(place), KNOTS - 2)
                lower = (knot + 1 - place) * material.scattering[knot]
                upper = (place - knot) * material.scattering[knot + 1]
                values = shares * (lower + upper)
                images[image] += values.sum(axis=0)
                if scores:
                    rows[image, :, knot] += shares.sum(axis=0) * lower
                    rows[image, :, knot + 1] += shares.sum(axis=0) * upper
                    rows[image, :, KNOTS] += lengths @ values
    return images, rows


def _routes(rig: Rig, material: Material, views: Views, camera: int) -> Iterator[tuple[float, Array, Array]]:
    """Scattering cosine, path length (cells,) and radiance per unit of f (cells, pixels) of every route from beam to
    camera.
    """
    width, sine, lateral = rig.width_mm, views.sine, float(views.sines[camera])
    inward, outward = math.sqrt(1 - sine**2), math.sqrt(1 - lateral**2)
    strength = views.transmittance * float(views.scales[camera]) * (width / DEPTH_CELLS / inward)
    for passes in _all_passes(bool(views.far[camera])):
        cosine = sine * lateral + passes.sign * inward * outward
        length_in, length_out = passes.lengths(width, inward, outward)
        density, mean_lengths = _attenuated(material.extinction_per_mm, length_in + length_out)
        exits = length_in * sine + length_out * lateral + views.shift_mm + float(views.shifts_mm[camera])
        for share, shift in _reflections(rig.interface, sine, passes.before, lateral, passes.after):
            spread = _spread(rig.grid, views.beam, exits[:-1] + shift, exits[1:] + shift)
            if share > 0:
                yield cosine, mean_lengths, (strength * share * density)[:, None] * spread


@dataclass(frozen=True)
class _Passes:
    """How often light crosses the cell before and after it scatters."""

    before: int
    """Reflections of the beam."""
    after: int
    """Reflections of the scattered light."""
    towards_far: bool
    """Whether the scattered light sets out for the face opposite the light."""

    @property
    def is_forward(self) -> bool:
        """Whether the beam travels away from its face where it scatters."""
        return self.before % 2 == 0

    @property
    def sign(self) -> int:
        """Sign of the product of both directions along z."""
        return 1 if self.is_forward == self.towards_far else -1

    def lengths(self, width: float, inward: float, outward: float | Array) -> tuple[Array, Array]:
        """Lengths of the path to and from the edges of the cells of depth (cells + 1, ...); ``inward`` and ``outward``
        are cosines, the latter for each pixel or one for all.
        """
        travelled = np.linspace(0, width, DEPTH_CELLS + 1).reshape(-1, *np.ones(np.ndim(outward), dtype=int))
        depth = travelled if self.is_forward else width - travelled
        length_in = (self.before * width + travelled) / inward
        return length_in, (self.after * width + (width - depth if self.towards_far else depth)) / outward


def _all_passes(is_far: bool) -> Iterator[_Passes]:
    """Every way with few reflections to a camera; ``is_far`` is whether it looks at the face opposite the light."""
    for before, after in itertools.product(range(MAX_REFLECTIONS + 1), repeat=2):
        if before + after <= MAX_REFLECTIONS:
            yield _Passes(before, after, towards_far=is_far != (after % 2 == 1))


def _attenuated(extinction_per_mm: float, lengths: Array) -> tuple[Array, Array]:
    """Mean of exp(-sigma_t path length) over each cell, which is exact, and the mean path length that it weighs."""
    step = lengths[1:] - lengths[:-1]
    middle = (lengths[1:] + lengths[:-1]) / 2
    half = extinction_per_mm * step / 2
    return np.exp(-extinction_per_mm * middle) * _sinhc(half), middle - _langevin(half) * step / 2


def _reflections(
    interface: Interface, sine: float, before: int, lateral: float, after: int
) -> Iterator[tuple[float, float]]:
    """Share and displacement for every way to be reflected ``before`` times before and ``after`` times after the
    scattering.
    """
    reflections = [interface.reflections(sine)] * before + [interface.reflections(lateral)] * after
    for chosen in itertools.product(*reflections):
        yield math.prod(one.share for one in chosen), sum(one.shift_mm for one in chosen)


def _sinhc(x: Array) -> Array:
    """sinh(x)/x."""
    small = np.abs(x) < 1e-4
    safe = np.where(small, 1.0, x)
    return np.where(small, 1 + x * x / 6, np.sinh(safe) / safe)


def _langevin(x: Array) -> Array:
    """coth(x) - 1/x."""
    small = np.abs(x) < 1e-3
    safe = np.where(small, 1.0, x)
    return np.where(small, x / 3, 1 / np.tanh(safe) - 1 / safe)


def add_perspective_view(
    rig: Rig, material: Material, views: Views, camera: int, image: Array, rows: Array | None
) -> None:
    """Add the light of a perspective camera: that of a pixel has the direction in which light leaves its middle, and
    what a pixel sees of the beam grows with depth. Reflectances of light that comes back are those of the camera's
    central direction.
    """
    interface, grid, width, sine = rig.interface, rig.grid, rig.width_mm, views.sine
    inward, central, distance = math.sqrt(1 - sine**2), float(views.sines[camera]), float(views.distances_mm[camera])
    x, y = (middles.ravel() for middles in np.meshgrid(_middles(_edges_x(grid)), _middles(_edges_y(grid))))
    outside = interface.index_outside / interface.index
    lateral_x, lateral_y, cosine_outside = leaving_direction(x, y, central, distance, outside)
    lateral = np.hypot(lateral_x, lateral_y)
    outward = np.sqrt(1 - lateral**2)
    passed = np.array([interface.transmittance(one) for one in lateral]) / interface.transmittance(central)
    scale = float(views.scales[camera]) * passed * math.sqrt(1 - central**2) / outward
    strength = views.transmittance * scale * (width / DEPTH_CELLS / inward)
    shift = np.array([interface.glass_shift_mm(one) for one in lateral]) / np.maximum(lateral, 1e-12)
    pixels = np.arange(grid.pixels)
    for passes in _all_passes(bool(views.far[camera])):
        cosines = sine * lateral_x + passes.sign * inward * outward
        places = np.arccos(np.clip(cosines, -1, 1)) / SPACING_RAD
        knots = np.minimum(places.astype(int), KNOTS - 2)
        lower = (knots + 1 - places) * material.scattering[knots]
        upper = (places - knots) * material.scattering[knots + 1]
        length_in, length_out = passes.lengths(width, inward, outward)
        density, mean_lengths = _attenuated(material.extinction_per_mm, length_in + length_out)
        growth = _middles(length_out) * outside / distance
        for share, reflected in _reflections(interface, sine, passes.before, central, passes.after):
            if share <= 0:
                continue
            from_axis_x = x - length_in * sine - (length_out + shift) * lateral_x - views.shift_mm - reflected
            from_axis_y = y - (length_out + shift) * lateral_y
            spread = _spread_over_own(
                grid, views.beam, from_axis_x, from_axis_y, 1 + growth * (cosine_outside / outward) ** 2, 1 + growth
            )
            shares = strength * share * density * spread
            values = shares * (lower + upper)
            image += values.sum(axis=0)
            if rows is not None:
                rows[pixels, knots] += shares.sum(axis=0) * lower
                rows[pixels, knots + 1] += shares.sum(axis=0) * upper
                rows[:, KNOTS] += (mean_lengths * values).sum(axis=0)


def _spread_over_own(grid: Grid, beam: Beam, x: Array, y: Array, growth_x: Array, growth_y: Array) -> Array:
    """Share of a cell's light that reaches its pixel (cells, pixels).

    Args:
        x, y: position of the pixel's middle in the beam, at the edges of cells (cells + 1, pixels).
        growth_x, growth_y: size of what the pixel sees of the beam, in units of the pixel's (cells, pixels).
    """
    halves = 2 if grid.folded else 1
    half_x, half_y = growth_x * grid.pitch_x_mm / 2, growth_y * grid.pitch_y_mm / 2
    middle_x, middle_y = _middles(x), _middles(y)
    if not beam.disc:
        along = ndtr((middle_x + half_x) / beam.x_mm) - ndtr((middle_x - half_x) / beam.x_mm)
        across = ndtr((middle_y + half_y) / beam.y_mm) - ndtr((middle_y - half_y) / beam.y_mm)
        return np.asarray(halves * along * across / (growth_x * growth_y))
    total = np.zeros(half_x.shape)
    sweep = np.maximum(np.abs(x[1:] - x[:-1]), 1e-9)
    for angle in _chord_angles():
        offset, chord = beam.x_mm * math.sin(angle), beam.y_mm * math.cos(angle)
        along = _clipped_ramp(middle_x + half_x - offset, sweep) - _clipped_ramp(middle_x - half_x - offset, sweep)
        across = _clipped_ramp(middle_y + half_y, 2 * chord) - _clipped_ramp(middle_y - half_y, 2 * chord)
        total += along * across * math.cos(angle) ** 2
    return np.asarray(2 * halves / DISC_NODES * total / (growth_x * growth_y))


def _clipped_ramp(x: Array, width: Array | float) -> Array:
    """Share of an interval about zero that lies below x."""
    return np.clip(x / width + 0.5, 0, 1)


def _middles(edges: Array) -> Array:
    return np.asarray((edges[1:] + edges[:-1]) / 2)


def _edges_x(grid: Grid) -> Array:
    return np.asarray(grid.x_from_mm + grid.pitch_x_mm * np.arange(grid.columns + 1))


def _edges_y(grid: Grid) -> Array:
    return np.asarray(grid.y_from_mm + grid.pitch_y_mm * np.arange(grid.rows + 1))


def _chord_angles() -> Array:
    """A disc is a sum of chords: at x offset r sin(t) of weight cos^2(t), y is even within +- r cos(t)."""
    return np.asarray((np.arange(DISC_NODES) + 0.5) / DISC_NODES * math.pi - math.pi / 2)


def _spread(grid: Grid, beam: Beam, starts: Array, ends: Array) -> Array:
    """Share of a cell's light that reaches each pixel (cells, pixels), exit points between ``starts`` and ``ends`` on y
    = 0.
    """
    edges_x, edges_y = _edges_x(grid), _edges_y(grid)
    halves = 2 if grid.folded else 1
    if not beam.disc:
        along: Array = np.diff(ndtr((edges_x - (starts + ends)[:, None] / 2) / beam.x_mm), axis=1)
        across: Array = halves * np.diff(ndtr(edges_y / beam.y_mm))
        return np.asarray((along[:, :, None] * across).transpose(0, 2, 1).reshape(len(starts), -1))
    total = np.zeros((len(starts), grid.rows, grid.columns))
    for angle in _chord_angles():
        offset, chord = beam.x_mm * math.sin(angle), beam.y_mm * math.cos(angle)
        along = _overlap(edges_x, starts + offset, ends + offset)
        across = np.diff(np.clip((edges_y + chord) / (2 * chord), 0, 1))
        total += along[:, None, :] * (halves * across * 2 * math.cos(angle) ** 2 / DISC_NODES)[:, None]
    return total.reshape(len(starts), -1)


def _overlap(edges: NDArray[np.floating], starts: Array, ends: Array) -> Array:
    """Share of the interval between each start and end that lies between consecutive edges (cells, columns)."""
    low, high = np.minimum(starts, ends)[:, None], np.maximum(starts, ends)[:, None]
    length = np.maximum(high - low, 1e-9)
    return np.diff(np.clip((edges - low) / length, 0, 1), axis=1)
