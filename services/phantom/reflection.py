"""Light that never enters the tooth: glossy reflection by the enamel and diffuse reflection by the gums, for each
camera and point light.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Camera, Light, Mesh
from services.phantom.surface import ENAMEL_ROUGHNESS
from services.transport.optics.ggx_albedo import fresnel_reflectance
from services.transport.rays import RayScene, pixel_rays

SUBPIXELS = 4
"""Number of rays along each side of a pixel."""
GUM_REFLECTANCE = {"red": 0.50, "green": 0.24, "blue": 0.22}
"""Diffuse reflectance of the gums by channel."""
SHADOW_OFFSET_MM = 1e-3
"""Distance along the normal by which shadow rays start above the surface, so that they do not hit it, mm."""


@dataclass(frozen=True)
class Reflection:
    """Reflected radiance in one camera under each light, averaged over each pixel, and the share of enamel in it."""

    highlight: NDArray[np.float64]
    """(L, H, W, C): radiance reflected by the enamel's surface."""
    gums: NDArray[np.float64]
    """(L, H, W, C): radiance reflected by the gums."""
    enamel_share: NDArray[np.float64]
    """(H, W): fraction of the pixel's rays towards the tooth that gums do not hide; 1 where no ray meets the tooth."""
    enamel_pixels: NDArray[np.bool_]
    """(H, W): whether any ray of the pixel meets the tooth, with gums ignored."""


def reflect(
    outer: Mesh,
    gums: Mesh | None,
    camera: Camera,
    lights: tuple[Light, ...],
    channels: tuple[str, ...],
    ior: float,
    roughness: float = ENAMEL_ROUGHNESS,
) -> Reflection:
    """Shade each pixel on a 4 × 4 grid of rays, with shadows of tooth and gums.

    Args:
        outer: the tooth's outer surface.
        gums: surface of the gums; None without gums.
        camera: the camera. lights: point lights. channels: names of the channels.
        ior: refractive index of enamel.
        roughness: GGX roughness of enamel.
    """
    width, height = camera.size
    normals_at = [_SmoothNormals(mesh) for mesh in (outer, gums) if mesh is not None]
    everything = RayScene(outer) if gums is None else RayScene(outer, gums)
    tooth_alone = RayScene(outer)
    shape = (len(lights), height * width, len(channels))
    highlight, diffuse = np.zeros(shape), np.zeros(shape)
    visible, unoccluded = np.zeros(height * width), np.zeros(height * width)
    gum_colour = np.array([GUM_REFLECTANCE[channel] for channel in channels])

    for sub in range(SUBPIXELS**2):
        offset = ((sub % SUBPIXELS + 0.5) / SUBPIXELS, (sub // SUBPIXELS + 0.5) / SUBPIXELS)
        origin, directions = pixel_rays(camera, offset)
        hits = everything.first_hits(origin, directions)
        unoccluded += tooth_alone.first_hits(origin, directions).hit
        visible += hits.mesh == 0
        for part in (0, 1):
            rows = np.flatnonzero(hits.mesh == part)
            if rows.size == 0:
                continue
            points, flat, view = hits.points_mm[rows], hits.normals[rows], -directions[rows]
            normals = normals_at[part](points, hits.face[rows])
            for n, light in enumerate(lights):
                to_light = np.asarray(light.position_mm) - points
                distance = np.linalg.norm(to_light, axis=1)
                to_light /= distance[:, None]
                cosine = (normals * to_light).sum(axis=1)
                lit = (cosine > 0) & ((flat * to_light).sum(axis=1) > 0)
                lit[lit] = ~everything.first_hits(points[lit] + SHADOW_OFFSET_MM * flat[lit], to_light[lit]).hit
                irradiance = np.where(lit, cosine, 0.0)[:, None] / distance[:, None] ** 2 * np.asarray(light.intensity)
                if part == 0:
                    highlight[n, rows] += irradiance * ggx_reflection(normals, to_light, view, roughness, ior)[:, None]
                else:
                    diffuse[n, rows] += irradiance * gum_colour / np.pi

    count, image = SUBPIXELS**2, (len(lights), height, width, len(channels))
    share = np.where(unoccluded > 0, visible / np.maximum(unoccluded, 1), 1.0)
    return Reflection(
        (highlight / count).reshape(image),
        (diffuse / count).reshape(image),
        share.reshape(height, width),
        (unoccluded > 0).reshape(height, width),
    )


def ggx_reflection(
    normal: NDArray[np.float64],
    towards_light: NDArray[np.float64],
    towards_camera: NDArray[np.float64],
    roughness: float,
    ior: float,
) -> NDArray[np.float64]:
    """Reflection BRDF D F G / (4 |n·l| |n·v|) of a rough dielectric (Walter et al. 2007), 1/sr, with values (...).

    Args:
        normal, towards_light, towards_camera: (..., 3), unit directions that point away from the surface.
        roughness: GGX roughness.
        ior: refractive index.
    """
    half = towards_light + towards_camera
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    n_l, n_v, n_h = (np.clip((normal * d).sum(axis=-1), 1e-6, 1.0) for d in (towards_light, towards_camera, half))
    a2 = roughness**2
    distribution = a2 / (np.pi * (n_h**2 * (a2 - 1) + 1) ** 2)
    shadowing = np.prod([2 * c / (c + np.sqrt(a2 + (1 - a2) * c**2)) for c in (n_l, n_v)], axis=0)
    return np.asarray(
        distribution
        * shadowing
        * fresnel_reflectance(np.clip((half * towards_light).sum(axis=-1), 0, 1), ior)
        / (4 * n_l * n_v)
    )


class _SmoothNormals:
    # Interpolates area-weighted vertex normals, because a highlight would show every facet otherwise.
    def __init__(self, mesh: Mesh) -> None:
        self._mesh = mesh
        a, b, c = (mesh.vertices_mm[mesh.faces[:, k]] for k in range(3))
        weighted = np.cross(b - a, c - a)
        self._normals = np.zeros_like(mesh.vertices_mm)
        for k in range(3):
            np.add.at(self._normals, mesh.faces[:, k], weighted)

    def __call__(self, points_mm: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
        from trimesh.triangles import points_to_barycentric

        index = self._mesh.faces[faces]
        weights = np.clip(points_to_barycentric(self._mesh.vertices_mm[index], points_mm), 0, 1)
        mixed = np.einsum("nk,nkx->nx", weights, self._normals[index])
        return np.asarray(mixed / np.linalg.norm(mixed, axis=1, keepdims=True))
