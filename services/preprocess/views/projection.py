"""Surface of the scanned meshes that each pixel of a camera sees, and whether it sees a tooth alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.anatomy.visibility import NOTHING, points_at, visible_surfaces
from services.core.geometry import Camera, Mesh

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class Footprint:
    """Surfaces that one camera sees, by pixel.

    Attributes:
        mesh: (H, W) number of the mesh seen at the pixel's centre, -1 where none is.
        depth_mm: (H, W) depth of the nearest surface along the camera's axis, occluders included; infinite where there
            is none.
        normal: (H, W, 3) unit normal of that surface in world axes; zero where there is none.
        covered: (H, W) whether the pixel's centre and its four corners all see one of the meshes.
    """

    mesh: NDArray[np.int16]
    depth_mm: NDArray[np.float32]
    normal: NDArray[np.float32]
    covered: BoolArray

    def points_mm(self, camera: Camera, rows: slice) -> NDArray[np.float32]:
        """World positions (rows, width, 3) in mm of the visible surface; NaN where no mesh is seen."""
        height, width = self.mesh.shape
        y, x = np.mgrid[0:height, 0:width][:, rows]
        points = self.points_at(camera, y, x)
        points[self.mesh[rows] < 0] = np.nan
        return points.astype(np.float32)

    def points_at(self, camera: Camera, y: NDArray[np.intp], x: NDArray[np.intp]) -> FloatArray:
        """World positions (..., 3) in mm of the surface that the pixels at rows y and columns x (...) see."""
        return points_at(camera, np.where(self.mesh[y, x] >= 0, self.depth_mm[y, x], 0), y, x)


def project(camera: Camera, teeth: Sequence[Mesh], occluders: Sequence[Mesh] = ()) -> Footprint:
    """Project teeth into a camera; ``occluders`` hide them and are not labelled.

    A pixel is ``covered`` where its centre and its four corners see a tooth, so that no light from beside the teeth
    enters it. Triangles with a vertex behind the camera are left out.
    """
    width, height = camera.size
    meshes = (*teeth, *occluders)
    centres = visible_surfaces(camera, meshes, with_normals=True)
    mesh = np.where(centres.mesh < len(teeth), centres.mesh, NOTHING).astype(np.int16)
    corner = visible_surfaces(camera, meshes, samples=(height + 1, width + 1), offset_px=0.0).mesh
    corners = (corner != NOTHING) & (corner < len(teeth))
    covered = corners[:-1, :-1] & corners[:-1, 1:] & corners[1:, :-1] & corners[1:, 1:] & (mesh != NOTHING)
    return Footprint(mesh, centres.depth_mm.astype(np.float32), centres.normal, covered)
