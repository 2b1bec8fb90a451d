"""What each pixel of a camera shows of an asset's surfaces: teeth or an object, gums, and the wall of a mouth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Camera, Mesh, Tooth

Floats = NDArray[np.float64]

SUBPIXELS = 3
"""Rays along each side of a pixel that tell how much of it shows a surface."""


@dataclass(frozen=True)
class Surfaces:
    """The surfaces of an asset."""

    teeth: tuple[Tooth, ...]
    """With the fitted dentin."""
    gums: Mesh | None = None
    cavity: Mesh | None = None
    """The wall of the mouth behind the teeth."""
    neighbours: tuple[Tooth, ...] = ()
    """Teeth around a single one, which the asset does not have."""

    @property
    def parts(self) -> tuple[tuple[Mesh, ...], ...]:
        """Outer surfaces of all teeth, of those around them, of the gums and of the wall, as far as there are any."""
        around = tuple(tooth.outer for tooth in self.neighbours)
        rest = [(mesh,) for mesh in (self.gums, self.cavity) if mesh is not None]
        return tuple(tooth.outer for tooth in self.teeth), *([around] if around else []), *rest


@dataclass(frozen=True)
class Seen:
    """What a camera of (H, W) pixels shows."""

    normals: Floats
    """Mean normals (H, W, 3) of what a pixel shows."""
    covered: Floats
    """Share (H, W) of each pixel that shows any surface."""
    teeth: Floats
    """Share (H, W) of each pixel that shows a tooth or the object."""
    part: NDArray[np.int64]
    """Index (H, W) of the part that fills most of a pixel, in the order of ``Surfaces.parts``; 0 where nothing is."""

    def by_part(self, of: Callable[[Floats, Floats], Floats], image: Floats) -> Floats:
        """Sum over the parts of ``of`` of an image (H, W, C) and of the covered share (H, W), each only where the part
        is: a filter then leaks no gums into a tooth.
        """
        shown = [self.part == number for number in range(int(self.part.max()) + 1)]
        return np.asarray(sum(of(image * own[..., None], self.covered * own) for own in shown))


def seen(camera: Camera, surfaces: Surfaces) -> Seen:
    """What a camera sees of the surfaces."""
    from services.transport.rays import RayScene, pixel_rays

    parts, (width, height) = surfaces.parts, camera.size
    scene = RayScene(*(mesh for meshes in parts for mesh in meshes))
    part_of = np.repeat(np.arange(len(parts)), [len(meshes) for meshes in parts])
    normals, shares = np.zeros((width * height, 3)), np.zeros((width * height, len(parts)))
    for k in range(SUBPIXELS**2):
        offset = (k % SUBPIXELS + 0.5) / SUBPIXELS, (k // SUBPIXELS + 0.5) / SUBPIXELS
        hits = scene.first_hits(*pixel_rays(camera, offset))
        normals[hits.hit] += hits.normals[hits.hit]
        shares[np.flatnonzero(hits.hit), part_of[hits.mesh[hits.hit]]] += 1 / SUBPIXELS**2
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return Seen(
        normals.reshape(height, width, 3),
        shares.sum(axis=1).reshape(height, width),
        shares[:, 0].reshape(height, width),
        shares.argmax(axis=1).reshape(height, width),
    )
