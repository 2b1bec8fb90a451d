"""Projection of points by a lens, a pinhole with OpenCV's distortion polynomials, and its derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
MODELS = {"pinhole": 0, "radial-tangential-4": 4, "radial-tangential-5": 5, "rational-8": 8}
"""Number of coefficients of each distortion model, the simplest first. In OpenCV's order they are k1, k2, p1, p2, then
k3, then k4, k5, k6."""
HALF_PIXEL = 0.5
"""Offset in px from OpenCV's pixel coordinates to those of this project: pixel centres lie at half-integers here and at
integers in OpenCV."""
FARTHEST, RADII = 3.0, 1000
"""Largest direction that is followed to find what a lens draws at its image's farthest corner, as a multiple of that
corner's own without distortion, and the number of directions up to it."""
UNDISTORTION_STEPS = 40
UNDISTORTION_PRECISION = 1e-11
"""Largest number of iterations of OpenCV's inversion of the distortion, and the error at which it ends."""


@dataclass(frozen=True)
class Lens:
    """Intrinsics of a camera.

    Attributes:
        size: width and height in pixels.
        values: fx, fy, cx, cy in pixels (pixel centres at half-integers), then the D distortion coefficients (4 + D,).
    """

    size: tuple[int, int]
    values: Floats

    @property
    def matrix(self) -> Floats:
        """The intrinsic matrix K (3, 3) in pixels."""
        fx, fy, cx, cy = self.values[:4]
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])

    @property
    def distortion(self) -> Floats:
        """Distortion coefficients (D,) in OpenCV's order."""
        return self.values[4:]

    @property
    def model(self) -> str:
        """Name of the distortion model."""
        return next(name for name, count in MODELS.items() if count == len(self.values) - 4)

    @property
    def keeps_order(self) -> bool:
        """Whether points farther from the principal point's axis are drawn farther from it, out to the image's farthest
        corner: where a distortion polynomial turns back, it draws two directions at one pixel.
        """
        fx, fy, cx, cy = self.values[:4]
        corners = np.array([[x, y] for x in (0, self.size[0]) for y in (0, self.size[1])])
        reach = float(np.linalg.norm((corners - [cx, cy]) / [fx, fy], axis=1).max())
        coefficients = np.zeros(8)
        coefficients[: len(self.distortion)] = self.distortion
        k1, k2, _, _, k3, k4, k5, k6 = coefficients
        squares = np.linspace(0, FARTHEST * reach, RADII) ** 2
        below = 1 + squares * (k4 + squares * (k5 + squares * k6))
        drawn = np.sqrt(squares) * (1 + squares * (k1 + squares * (k2 + squares * k3))) / below
        beyond = np.flatnonzero(drawn >= reach)
        if len(beyond) == 0:
            return False
        shown = slice(0, beyond[0] + 1)
        return bool((below[shown] > 0).all() and (np.diff(drawn[shown]) > 0).all())

    def project(self, points_mm: Floats) -> Floats:
        """Return the pixels (N, 2) of points (N, 3) in the camera's axes, in mm."""
        return self.project_with_derivatives(points_mm)[0]

    def project_with_derivatives(self, points_mm: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the pixels of points (N, 3) in the camera's axes, in mm, and their derivatives.

        Returns:
            Pixels (N, 2), and their derivatives with respect to the point (N, 2, 3) and to the intrinsic values
            (N, 2, 4 + D).
        """
        import cv2

        points = np.ascontiguousarray(points_mm, dtype=np.float64).reshape(-1, 1, 3)
        coefficients = self.distortion if len(self.distortion) else np.zeros(4)
        still = np.zeros(3)
        pixels, jacobian = cv2.projectPoints(points, still, still, self.matrix, coefficients)
        # With the camera's pose at zero, a change of its translation moves the point, so OpenCV's columns 3 to 5 are
        # the derivative with respect to the point.
        jacobian = np.asarray(jacobian).reshape(len(points), 2, -1)
        own = jacobian[:, :, 6 : 6 + len(self.values)]
        return np.asarray(pixels).reshape(-1, 2), jacobian[:, :, 3:6], own

    def undistort(self, pixels: Floats) -> Floats:
        """Return the directions (N, 3) of pixels (N, 2) in the camera's axes, with z = 1."""
        import cv2

        coefficients = self.distortion if len(self.distortion) else np.zeros(4)
        stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, UNDISTORTION_STEPS, UNDISTORTION_PRECISION)
        points = np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
        flat = np.asarray(cv2.undistortPoints(points, self.matrix, coefficients, criteria=stop)).reshape(-1, 2)
        return np.concatenate([flat, np.ones((len(flat), 1))], axis=1)
