"""How a lens draws points: a pinhole and OpenCV's distortion polynomials, with derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
MODELS = {"pinhole": 0, "radial-tangential-4": 4, "radial-tangential-5": 5, "rational-8": 8}
"""Distortion models by their number of coefficients, from the simplest: k1, k2, p1, p2; k3; k4, k5, k6 (OpenCV's
order)."""
HALF_PIXEL = 0.5
"""Pixel centres lie at half-integers here and at integers in OpenCV."""
UNDISTORTION_STEPS = 40
UNDISTORTION_PRECISION = 1e-11


@dataclass(frozen=True)
class Lens:
    """Intrinsics of a camera.

    Attributes:
        size: width and height in pixels.
        values: fx, fy, cx, cy in pixels (centres at half-integers), then the distortion's coefficients, (4 + D,).
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
        """Coefficients in OpenCV's order, (D,)."""
        return self.values[4:]

    @property
    def model(self) -> str:
        """Name of the distortion model."""
        return next(name for name, count in MODELS.items() if count == len(self.values) - 4)

    def project(self, points_mm: Floats) -> Floats:
        """Pixels (N, 2) of points (N, 3) in the camera's axes, in mm."""
        return self.project_with_derivatives(points_mm)[0]

    def project_with_derivatives(self, points_mm: Floats) -> tuple[Floats, Floats, Floats]:
        """Pixels (N, 2) of points (N, 3) in the camera's axes, and their derivatives.

        Returns:
            Pixels, their derivative to the point (N, 2, 3), and to the intrinsic values (N, 2, 4 + D).
        """
        import cv2

        points = np.ascontiguousarray(points_mm, dtype=np.float64).reshape(-1, 1, 3)
        coefficients = self.distortion if len(self.distortion) else np.zeros(4)
        still = np.zeros(3)
        pixels, jacobian = cv2.projectPoints(points, still, still, self.matrix, coefficients)
        # With the camera at rest a translation is a move of the point: OpenCV's columns 3 to 5.
        jacobian = np.asarray(jacobian).reshape(len(points), 2, -1)
        own = jacobian[:, :, 6 : 6 + len(self.values)]
        return np.asarray(pixels).reshape(-1, 2), jacobian[:, :, 3:6], own

    def undistort(self, pixels: Floats) -> Floats:
        """Directions (N, 3) with z = 1, in the camera's axes, of pixels (N, 2)."""
        import cv2

        coefficients = self.distortion if len(self.distortion) else np.zeros(4)
        stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, UNDISTORTION_STEPS, UNDISTORTION_PRECISION)
        points = np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
        flat = np.asarray(cv2.undistortPoints(points, self.matrix, coefficients, criteria=stop)).reshape(-1, 2)
        return np.concatenate([flat, np.ones((len(flat), 1))], axis=1)
