"""Layout of a stain texture: a chart of a tooth's outer surface in a coarse texture, made by xatlas, and the pairs of
texels that are neighbours on the surface.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Mesh
from services.transport.optics.parameters import Stain

Array = NDArray[np.float64]

TEXEL_MM = (0.5, 1.0)
"""Least and greatest edge of a texel, in mm."""
TEXEL_PIXELS = 1.5
"""Edge of a texel in pixels of the capture: one pixel does not determine two texels."""
NEIGHBOUR_DISTANCE = 1.6
"""Largest distance between neighbouring texels, in edges: it covers the eight around a texel and those across
a seam."""
MIN_NORMAL_COSINE = 0.3
"""Least cosine between the normals of neighbours, so that texels on the two sides of an incisal edge are not
neighbours."""
SAMPLES_PER_TEXEL = 4
"""Samples per texel edge that are used to find the texels that a face touches."""


@dataclass(frozen=True)
class StainLayout:
    """Layout of a texture on a surface of F faces, which touches T of its texels."""

    corners_uv: Array
    """Texture coordinates (F, 3, 2) of the faces' corners, 0 to 1."""
    index: NDArray[np.int64]
    """Index (H, W) of each texel among the T touched ones, -1 for untouched ones."""
    points_mm: Array
    """Mean point (T, 3) of the surface that a texel colours."""
    area_mm2: Array
    """Area (T,) of the surface that a texel colours, by its bilinear weights."""
    neighbours: NDArray[np.int64]
    """Pairs (E, 2) of texels that are next to each other on the surface."""
    outer: Mesh
    """The surface."""

    def texture(self, optical_depth: Array, errors: Array | None = None) -> Stain:
        """Stain texture of optical depths d (T,), a_t = exp(-d), with the standard error of a_t to first order in those
        of d (T,), and 0 where no surface is.
        """
        values = np.append(np.exp(-np.asarray(optical_depth, dtype=np.float64)), 1.0)
        own = None if errors is None else (values * np.append(errors, 0.0))[self.index]
        return Stain(values[self.index], own)

    def depths(self, stain: Stain) -> Array:
        """Optical depths (T,) of a stain."""
        return np.asarray(-np.log(stain.transmittance[self.index >= 0]))


@dataclass(frozen=True)
class ToothStains:
    """Stain textures of a tooth, for the channels that have one, and their layout on its outer faces."""

    corners_uv: Array
    """Texture coordinates (F, 3, 2) of the faces' corners, 0 to 1."""
    textures: Mapping[str, Stain]


def texel_edge_mm(pixel_mm: float) -> float:
    """Edge of a texel, in mm, for a capture with pixels of this size at the tooth."""
    return float(np.clip(TEXEL_PIXELS * pixel_mm, *TEXEL_MM))


def stain_layout(outer: Mesh, texel_mm: float) -> StainLayout:
    """Layout of a surface; the same mesh and texel size give the same layout.

    Args:
        outer: the tooth's outer surface.
        texel_mm: edge of a texel on the surface.
    """
    import xatlas

    # Keep a distance between charts, so that no bilinear look-up in one chart reads a texel of another.
    atlas, packing = xatlas.Atlas(), xatlas.PackOptions()
    atlas.add_mesh(outer.vertices_mm.astype(np.float32), outer.faces.astype(np.uint32))
    packing.padding, packing.bilinear, packing.texels_per_unit = 2, True, 1.0 / texel_mm
    atlas.generate(pack_options=packing)
    _, corners, uv = atlas[0]
    corners_uv = np.asarray(uv, dtype=np.float64)[np.asarray(corners)]
    height, width = int(atlas.height), int(atlas.width)

    # Distribute samples of the surface to the texels that a look-up at the sample reads.
    faces, weights, shares = _surface_samples(outer, texel_mm / SAMPLES_PER_TEXEL)
    texels, bilinear = bilinear_texels(np.einsum("sc,scd->sd", weights, corners_uv[faces]), (height, width))
    carried = (bilinear * shares[:, None]).reshape(-1)
    area = np.bincount(texels.reshape(-1), carried, height * width)
    touched = area > 1e-9 * texel_mm**2
    positions: Array = np.einsum("sc,scd->sd", weights, outer.vertices_mm[outer.faces[faces]])

    def mean(values: Array) -> Array:
        sums = [
            np.bincount(texels.reshape(-1), carried * np.repeat(values[:, k], 4), height * width)[touched]
            for k in range(3)
        ]
        return np.asarray(np.stack(sums, axis=-1) / area[touched, None])

    normals = mean(_normals(outer)[faces])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    points = mean(positions)
    index = np.where(touched, np.cumsum(touched) - 1, -1).reshape(height, width)
    return StainLayout(
        corners_uv,
        index,
        points,
        np.asarray(area[touched], dtype=np.float64),
        _neighbours(points, normals, NEIGHBOUR_DISTANCE * texel_mm),
        outer,
    )


def bilinear_texels(uv: Array, size: tuple[int, int]) -> tuple[NDArray[np.int64], Array]:
    """Texels (N, 4), numbered row by row, and weights (N, 4) of a bilinear look-up at uv (N, 2). Texel centres lie at
    half-integers; look-ups are clamped at the edges.
    """
    height, width = size
    x, y = (np.clip(uv[:, k] * n - 0.5, 0, n - 1) for k, n in ((0, width), (1, height)))
    column, row = x.astype(np.int64), y.astype(np.int64)
    u, v = x - column, y - row
    right, below = np.minimum(column + 1, width - 1), np.minimum(row + 1, height - 1)
    texels = np.stack(
        [row * width + column, row * width + right, below * width + column, below * width + right], axis=-1
    )
    return texels, np.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v], axis=-1)


def _surface_samples(mesh: Mesh, spacing_mm: float) -> tuple[NDArray[np.int64], Array, Array]:
    """Faces (S,), barycentric weights (S, 3) and areas (S,) in mm² of a lattice of points on every face, its corners
    included.
    """
    corners = mesh.vertices_mm[mesh.faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    cuts = np.maximum(np.ceil(longest / spacing_mm).astype(int), 1)
    areas = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    parts = []
    for n in np.unique(cuts):
        chosen = np.flatnonzero(cuts == n)
        i, j = (index.reshape(-1) for index in np.mgrid[: n + 1, : n + 1])
        lattice = np.stack([i, j, n - i - j], axis=-1)[i + j <= n] / n
        count = len(lattice)
        parts.append(
            (np.repeat(chosen, count), np.tile(lattice, (len(chosen), 1)), np.repeat(areas[chosen] / count, count))
        )
    faces, weights, shares = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return faces, weights, shares


def _normals(mesh: Mesh) -> Array:
    a, b, c = (mesh.vertices_mm[mesh.faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30))


def _neighbours(points_mm: Array, normals: Array, reach_mm: float) -> NDArray[np.int64]:
    from scipy.spatial import cKDTree

    pairs = cKDTree(points_mm).query_pairs(reach_mm, output_type="ndarray").astype(np.int64)
    facing = np.einsum("ec,ec->e", normals[pairs[:, 0]], normals[pairs[:, 1]]) > MIN_NORMAL_COSINE
    found: NDArray[np.int64] = pairs[facing][np.lexsort(pairs[facing].T[::-1])]
    return found


STAINS = "stains.npz"
"""File of the stain textures, in the fit's folder."""


def store_stains(folder: Path, stains: ToothStains) -> None:
    """Store stain textures in a fit's folder."""
    arrays = {f"texture.{channel}": stain.transmittance for channel, stain in stains.textures.items()}
    arrays |= {f"se.{channel}": stain.se for channel, stain in stains.textures.items() if stain.se is not None}
    np.savez_compressed(folder / STAINS, allow_pickle=False, corners_uv=stains.corners_uv, **arrays)


def read_stains(folder: Path) -> ToothStains | None:
    """Stain textures that ``store_stains`` wrote; None where there are none."""
    if not (folder / STAINS).is_file():
        return None
    with np.load(folder / STAINS, allow_pickle=False) as stored:
        textures = {
            channel: Stain(
                stored[f"texture.{channel}"].astype(float),
                stored[f"se.{channel}"].astype(float) if f"se.{channel}" in stored.files else None,
            )
            for kind, _, channel in (name.partition(".") for name in stored.files)
            if kind == "texture"
        }
        return ToothStains(stored["corners_uv"].astype(float), textures)
