"""The pixels of photographs around their highlights, with the geometry by which a rough surface reflects there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.anatomy.shadow_map import is_unoccluded
from services.anatomy.visibility import points_at, visible_surfaces
from services.core.geometry import Camera, Light, Mesh
from services.fit.measurements.levels import finer_camera
from services.fit.measurements.roughness.lobe import reflected

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

RAYS_PER_MM = 1.25
"""Places within a pixel at which normals are averaged, along a millimetre and for a roughness of 1: with them
a highlight's half-width on a surface of 4 mm radius has five."""
MIN_RAYS, MAX_RAYS = 3, 6
"""Least and largest number of these places along each edge of a pixel. With one the grooves of an incisor made
roughnesses of 0.15, at 0.1 mm a pixel, 2 % too large."""
MIN_COSINE = 0.15
"""Smallest cosine of a normal to the camera and to the light. Beyond, the surface's error moves outline and shadow."""
EDGE_PX = 2
"""Pixels along the outline and along shadows that are left out, in which other surfaces may be."""
NEIGHBOURS = np.ones((2 * EDGE_PX + 1,) * 2, dtype=bool)
"""Those within that distance of a pixel."""


@dataclass(frozen=True)
class Photograph:
    """One photograph with its camera and light.

    Attributes:
        camera: the camera, whose pixels are those of the arrays.
        light: the point light.
        radiance, variance: (H, W), radiance over the light's radiant intensity and its variance, 1/mm² sr.
        usable: (H, W), pixels whose value is measured.
        clipped: (H, W), pixels of the subject whose value is saturated.
    """

    camera: Camera
    light: Light
    radiance: Array
    variance: Array
    usable: BoolArray
    clipped: BoolArray


@dataclass(frozen=True)
class Patch:
    """Pixels of one photograph, N of them, that a highlight may brighten.

    Attributes:
        photograph: names of its camera and light.
        value, variance: (N,) radiance and its variance, over the light's intensity.
        points_mm: (N, 3) points on the surface at the pixels' centres.
        normals: (N, S, 3) normals at S places in each pixel.
        to_light, to_camera: (N, 3) unit directions.
        irradiance: (N,) of a surface at right angles to the light, over its intensity, 1/mm².
        tangent: (N,) tangent of the angle between the normal and the half vector.
        clipped: (M,) the same tangent at the saturated pixels.
    """

    photograph: tuple[str, str]
    value: Array
    variance: Array
    points_mm: Array
    normals: Array
    to_light: Array
    to_camera: Array
    irradiance: Array
    tangent: Array
    clipped: Array

    def lobe(self, roughness: float, ior: float, tilt: Array | None = None) -> Array:
        """Radiance (N,) that the surface reflects, over the light's intensity.

        Args:
            roughness: GGX roughness. ior: refractive index.
            tilt: (N, 3) change of the normals, at right angles to them.
        """
        normals = self.normals
        if tilt is not None:
            normals = normals + tilt[:, None]
            normals = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
        seen = reflected(normals, self.to_light[:, None], self.to_camera[:, None], roughness, ior)
        return np.asarray(seen.mean(axis=1) * self.irradiance)


class Views:
    """A surface as a camera sees it, kept from one photograph of the camera to the next.

    Args:
        outer: the surface. occluders: other surfaces, which hide and shade it.
        roughness: the roughness whose highlights pixels are to resolve.
    """

    def __init__(self, outer: Mesh, occluders: Sequence[Mesh], roughness: float) -> None:
        self._outer, self._occluders, self._roughness = outer, tuple(occluders), roughness
        self._camera: Camera | None = None

    def patch(self, photograph: Photograph, widest: float, most: int) -> Patch | None:
        """Pixels where the half vector is within an angle of tangent ``widest`` of the normal; None without any.

        Of more than ``most`` pixels half are those nearest to the mirror direction, and half are spread evenly.
        """
        self._look(photograph.camera)
        light, camera_mm = np.asarray(photograph.light.position_mm), self._camera_mm
        pixels = self._inside & (photograph.usable | photograph.clipped)
        y, x = np.nonzero(pixels)
        points, normal = self._points[y, x], self._normal[y, x].astype(np.float64)
        (to_light, far), (to_camera, _) = (_directions(place - points) for place in (light, camera_mm))
        half, _ = _directions(to_light + to_camera)
        cosine = (half * normal).sum(axis=1)
        tangent = np.sqrt(np.maximum(1 / np.maximum(cosine, 1e-6) ** 2 - 1, 0))
        is_seen = (normal * to_camera).sum(axis=1) > MIN_COSINE
        is_lit = (normal * to_light).sum(axis=1) > MIN_COSINE
        chosen = np.flatnonzero(is_seen & is_lit & (cosine > 0) & (tangent < widest))
        if not len(chosen):
            return None
        lit = self._lit(light)
        chosen = chosen[lit[y[chosen], x[chosen]]]
        clipped = photograph.clipped[y[chosen], x[chosen]]
        kept = chosen[~clipped]
        if not len(kept):
            return None
        kept = kept[_thinned(tangent[kept], most)]
        rows, columns = y[kept], x[kept]
        return Patch(
            (photograph.camera.name, photograph.light.name),
            photograph.radiance[rows, columns].astype(np.float64),
            photograph.variance[rows, columns].astype(np.float64),
            points[kept],
            self._fine_normals(rows, columns),
            to_light[kept],
            to_camera[kept],
            1 / far[kept] ** 2,
            tangent[kept],
            tangent[chosen[clipped]],
        )

    def _look(self, camera: Camera) -> None:
        if self._camera == camera:
            return
        from scipy.ndimage import binary_erosion

        self._camera = camera
        meshes = (self._outer, *self._occluders)
        seen = visible_surfaces(camera, meshes, with_normals=True)
        self._normal = seen.normal
        inside = seen.mesh == 0
        self._inside = binary_erosion(inside, NEIGHBOURS, border_value=1)
        pose = np.asarray(camera.camera_from_world)
        self._camera_mm = -pose[:3, :3].T @ pose[:3, 3]
        self._points = points_at(camera, np.where(inside, seen.depth_mm, 0.0), *np.indices(inside.shape))
        centre_mm = self._outer.vertices_mm.mean(axis=0)
        self._rays = int(
            np.clip(np.ceil(camera.pixel_mm(centre_mm) * RAYS_PER_MM / self._roughness), MIN_RAYS, MAX_RAYS)
        )
        self._fine = visible_surfaces(finer_camera(camera, self._rays), meshes, with_normals=True)

    def _fine_normals(self, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> Array:
        """Normals (N, S, 3) at places in pixels; the pixel's own where another surface is seen."""
        steps = np.arange(self._rays)
        fine_rows = (rows[:, None, None] * self._rays + steps[:, None]) + 0 * steps
        fine_columns = (columns[:, None, None] * self._rays + steps) + 0 * steps[:, None]
        normals = self._fine.normal[fine_rows, fine_columns].astype(np.float64)
        own = self._fine.mesh[fine_rows, fine_columns] == 0
        whole = np.where(own[..., None], normals, self._normal[rows, columns][:, None, None])
        return np.asarray(whole.reshape(len(rows), -1, 3))

    def _lit(self, light_mm: Array) -> BoolArray:
        """Pixels (H, W) that the light reaches, apart from the edges of shadows."""
        from scipy.ndimage import binary_dilation

        place = (float(light_mm[0]), float(light_mm[1]), float(light_mm[2]))
        meshes = (self._outer, *self._occluders)
        lit = is_unoccluded(self._points.astype(np.float32), self._normal, place, meshes)
        return np.asarray(~binary_dilation(self._inside & ~lit, NEIGHBOURS))


def _thinned(tangent: Array, most: int) -> NDArray[np.intp]:
    """Indices of at most ``most`` of the pixels (N,), in their order."""
    if len(tangent) <= most:
        return np.arange(len(tangent))
    order = np.argsort(tangent, kind="stable")
    near, far = order[: most // 2], np.sort(order[most // 2 :])
    even = np.unique(np.linspace(0, len(far) - 1, most - len(near)).astype(np.intp))
    return np.sort(np.concatenate([near, far[even]]))


def _directions(vectors: Array) -> tuple[Array, Array]:
    """Unit vectors (N, 3) and lengths (N,) of vectors."""
    length = np.linalg.norm(vectors, axis=1)
    return vectors / length[:, None], length
