"""Uncertainty of a calibrated camera's projection, all over its image.

Errors of lens and pose compensate each other in part: a lens whose principal point is shifted, with the boards rotated
to fit, projects almost the same pixels. The uncertainty is therefore defined as in mrcal (Kogan, mrcal's documentation
of projection uncertainty, "mean-pcam"): a point that the camera sees is fixed to every solved board. When all
parameters change by an error, each board carries the point along, the mean over the boards is the point's new position
in the camera's axes, and the changed lens projects it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.calibrate.cameras.bundle import BundleFit, derivative_blocks, pose_apply
from services.calibrate.cameras.rotations import inverse_pose
from services.calibrate.cameras.sightings import Corners

Floats = NDArray[np.float64]


def image_grid(size: tuple[int, int], columns: int, rows: int) -> Floats:
    """Return the pixels (rows · columns, 2) at the centres of equal cells of the image, row by row."""
    x, y = (np.arange(columns) + 0.5) * size[0] / columns, (np.arange(rows) + 0.5) * size[1] / rows
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def projection_covariance(fit: BundleFit, camera: int, pixels: Floats, distance_mm: float) -> Floats:
    """Return the covariance (N, 2, 2) in px² of a camera's projection of the points that it sees at pixels (N, 2), at a
    distance in mm from the camera.
    """
    lens, pose = fit.rig.lenses[camera], fit.rig.cameras[camera]
    directions = lens.undistort(pixels)
    points = distance_mm * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    world = pose_apply(inverse_pose(pose), points)
    # Take the mean over the boards that this camera saw.
    places = np.unique(fit.corners.place[fit.inliers & (fit.corners.camera == camera)])
    columns = np.zeros((len(pixels), 2, fit.layout.length))
    for place in places:
        on_board = pose_apply(inverse_pose(fit.rig.places[place]), world)
        count = np.full(len(pixels), 1)
        as_corners = Corners(camera * count, place * count, 0 * count, on_board, pixels)
        _, _, by_lens, by_camera, by_place = derivative_blocks(fit.rig, as_corners, camera)
        if not fit.layout.lenses_fixed:
            columns[:, :, fit.layout.lens_columns(camera)] += by_lens / len(places)
        columns[:, :, fit.layout.camera_columns(camera)] += by_camera / len(places)
        if place > 0:
            columns[:, :, fit.layout.place_columns(place)] += by_place / len(places)
    return np.asarray(np.einsum("nip,pq,njq->nij", columns, fit.covariance, columns, optimize=True))


def projection_sigma(fit: BundleFit, camera: int, pixels: Floats, distance_mm: float) -> Floats:
    """Return the standard deviation (N,) in px, in the worst direction, of a camera's projection of the points that it
    sees at pixels (N, 2), at a distance in mm from the camera.
    """
    covariance = projection_covariance(fit, camera, pixels, distance_mm)
    return np.asarray(np.sqrt(np.linalg.eigvalsh(covariance)[:, -1]))
