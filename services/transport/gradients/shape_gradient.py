"""The gradient of a weighted sum of images with respect to the dentin's shape: light on the border times importance,
summed over the border.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.transport.boundary.model import Boundary
from services.transport.gradients.border_fields import CameraWalk, LightWalk, Texels, harmonics
from services.transport.gradients.border_series import BorderSeries, patches
from services.transport.optics.parameters import Tissue
from services.transport.paths.starts import CameraStart, LightStart
from services.transport.scene.media import Media
from services.transport.scene.mesh_geometry import MeshGeometry
from services.transport.scene.recipe import ShapeGradient, View

Array = NDArray[np.float64]
TEXELS = 130
"""Number of patches of the border: with more of them each holds more noise, with fewer each mixes light that
differs."""
LIGHT_BATCHES = 4
CAMERA_BATCHES = 16
TABLE_BUDGET = 48_000_000
"""Largest number of entries in a table of light by pixel, about 200 MB; more pixels are processed in slices."""
MAX_ROWS_PER_GROUP = 64


class ShapeGradients:
    """Shape gradients of one tooth in one scene; texels are made once."""

    def __init__(self, geometry: MeshGeometry, tooth: int, boundary: Boundary, radius_mm: float) -> None:
        dentin = geometry.recipe.teeth[tooth].dentin
        assert dentin is not None
        self.geometry, self.tooth, self.recipe, self.boundary, self.radius_mm = (
            geometry,
            tooth,
            geometry.recipe,
            boundary,
            radius_mm,
        )
        self._patches = patches(dentin.base, TEXELS)

    def __call__(
        self,
        tissue: Tissue,
        media: Media,
        view: View,
        cotangent: Array,
        *,
        seed: int,
        samples: int,
        photons: int,
        order: int,
    ) -> ShapeGradient:
        """See ``Engine.shape_gradient``; all arguments must be checked before, and the geometry must have the tissue's
        shape.
        """
        light_seed, camera_seed = (int(number) for number in np.random.SeedSequence(seed).generate_state(2))
        series, texels = (
            BorderSeries(tissue.enamel, tissue.dentin),
            Texels(self._patches, self.geometry.dentin_areas_mm2(self.tooth), self.tooth),
        )
        chosen = list(range(len(self.recipe.light_positions_mm)) if view.lights is None else view.lights)
        table = self._light(media, texels, chosen, photons, order, light_seed)
        lights = self.recipe.light_positions_mm[chosen]
        light_directions = -lights / np.linalg.norm(lights, axis=1, keepdims=True)

        per_batch = -(-samples // CAMERA_BATCHES)
        slice_size = max(1, TABLE_BUDGET // (LIGHT_BATCHES * texels.count * table.shape[-1]))
        crossed = np.zeros((CAMERA_BATCHES, LIGHT_BATCHES, self.geometry.modes_of[self.tooth]))
        for first in range(0, len(view), slice_size):
            piece = View(view.camera, view.pixels[first : first + slice_size])
            light = self._light_of_pixels(
                table, series, order, piece, light_directions, cotangent[chosen, first : first + slice_size]
            )
            start = CameraStart(piece, CAMERA_BATCHES, camera_seed, self.radius_mm)
            sums = CameraWalk(
                self.geometry, media, start, texels, self.boundary, series.coefficients(order), light
            ).shape_sums(per_batch)
            crossed += sums.reshape(CAMERA_BATCHES, len(piece), LIGHT_BATCHES, -1).sum(axis=1) / per_batch
        return ShapeGradient(*crossed_mean(crossed), samples=per_batch * CAMERA_BATCHES)

    def _light(
        self, media: Media, texels: Texels, chosen: list[int], photons: int, order: int, seed: int
    ) -> NDArray[np.float32]:
        per_group = -(-photons // LIGHT_BATCHES)
        rows = min(MAX_ROWS_PER_GROUP, per_group)
        positions, intensities = self.recipe.light_positions_mm[chosen], self.recipe.light_intensities[chosen]
        start = LightStart(positions, intensities, self.recipe.vertices_mm(), LIGHT_BATCHES, rows, seed)
        return LightWalk(self.geometry, media, start, texels, order, self.boundary).gather(-(-per_group // rows))

    def _light_of_pixels(
        self,
        table: NDArray[np.float32],
        series: BorderSeries,
        order: int,
        view: View,
        light_directions: Array,
        weights: Array,
    ) -> NDArray[np.float32]:
        """Light weighted by the cotangent ``weights`` (L, N), in the form that ``CameraWalk`` takes: (N, batches,
        texels, columns).

        ``light_directions`` are directions of uncollided light, (L, 3), all taken as at the tooth's middle; a pixel's
        own direction is that through its middle.
        """
        view_directions, weighting, uncollided = -_pixel_directions(view), weights.T.astype(np.float32), table[..., -1]
        light = np.tensordot(weighting, table, axes=1)

        # Light for a pixel's uncollided walk: collided light by the series, uncollided light by the phase function.
        factors = np.repeat(series.coefficients(order), 2 * np.arange(order + 1) + 1)
        exact = weights * series.uncollided(light_directions @ view_directions.T)
        light[..., -1] = np.einsum("nbtk,nk->nbt", light[..., :-1], harmonics(view_directions, order) * factors)
        light[..., -1] += np.tensordot(exact.T.astype(np.float32), uncollided, axes=1)

        # Light for collided walks: here uncollided light is expanded in the series too.
        for k, column in enumerate(harmonics(light_directions, order).T):
            light[..., k] += np.tensordot(weighting * column, uncollided, axes=1)
        return light


def _pixel_directions(view: View) -> Array:
    """Unit directions from the camera through the pixels' middles, (N, 3)."""
    rotation = np.asarray(view.camera.camera_from_world)[:3, :3]
    middles = np.concatenate([view.pixels + 0.5, np.ones((len(view), 1))], axis=1)
    along = middles @ np.linalg.inv(np.asarray(view.camera.K)).T @ rotation
    return np.asarray(along / np.linalg.norm(along, axis=1, keepdims=True))


def crossed_mean(crossed: Array) -> tuple[Array, Array]:
    """Mean (M,) of A x B crossed batches (A, B, M), and the variance of that mean (M,).

    Each entry has the noise of its row, of its column and of the two together. With the mean squares of rows, columns
    and the rest, (rows + columns - rest) / (A B) is the mean's variance without bias; here rows and columns count at
    least as much as the rest.
    """
    a, b = crossed.shape[:2]
    mean, of_rows, of_columns = crossed.mean(axis=(0, 1)), crossed.mean(axis=1), crossed.mean(axis=0)
    rows, columns = b * of_rows.var(axis=0, ddof=1), a * of_columns.var(axis=0, ddof=1)
    rest = ((crossed - of_rows[:, None] - of_columns + mean) ** 2).sum(axis=(0, 1)) / ((a - 1) * (b - 1))
    return mean, (np.maximum(rows, rest) + np.maximum(columns, rest) - rest) / (a * b)
