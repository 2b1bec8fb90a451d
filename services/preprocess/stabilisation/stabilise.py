"""Motion of the subject between two frames of a camera, and a frame resampled as if the subject had not moved.

Only tooth pixels are used, and the teeth of one jaw are one rigid body of known shape. Its image moves by a smooth
field: a shift, a linear and a quadratic part, and a parallax in proportion to the scan's relief. Direct alignment
(Lucas & Kanade 1981, with the parametric warps of Baker & Matthews 2004, section 2, and Irani & Anandan's plane plus
parallax, 1996) finds these few coefficients from all pixels at once. Dense flow, which has two unknowns per pixel,
follows shading and reflections instead of the tooth; docs/measured/preparation.md has the comparison.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.robust import robust_sigma
from services.preprocess.views.projection import Footprint
from services.preprocess.views.scratch import cached_array
from services.preprocess.views.window import bands

Image = NDArray[np.float32]
BoolArray = NDArray[np.bool_]
FloatArray = NDArray[np.float64]

# Number of terms of a displacement field: 1, x, y, relief, x², xy, y²
TERMS = 7
# Prior standard deviations of the terms after the shift, as fractions of the body's shorter side; the shift has no
# prior. A nod or turn by a few degrees moves a tooth's outline by this much.
PRIOR_SHARE = (0.02, 0.02, 0.02, 0.007, 0.007, 0.007)
# Number of pixels that count as one observation. Features are made with Gaussians of 2 px, so that residuals of about
# 4π 2² pixels are correlated
CORRELATED_PX = 50.0
# Largest number of pixels of a frame that is reduced for matching: those of 20 megapixels at the fit's 1/5 resolution
SOLVE_PIXELS = 800_000
# Largest number of evenly strided pixels that are matched at each level: a few coefficients need no more
MATCHED_PIXELS = 200_000
# Width in pixels of the band beside a body's outline in which its relief is continued and pixels are matched
BAND_PX = 6


class SurfaceFlow:
    """Displacement fields that one rigid body can have in one camera's image.

    Args:
        footprint: surfaces that the camera sees at the reference time.
        meshes: numbers of the body's meshes in the footprint.
        cache: file of the relief, read if it exists and else written; None to compute the relief and write nothing.
    """

    def __init__(self, footprint: Footprint, meshes: Sequence[int], cache: Path | None = None) -> None:
        visible = np.isin(footprint.mesh, list(meshes))
        self.visible = visible
        if not visible.any():
            return
        rows, columns = np.flatnonzero(visible.any(axis=1)), np.flatnonzero(visible.any(axis=0))
        self._centre_px = np.array([columns.mean(), rows.mean()])
        self._scale_px = max(1.0, 0.5 * max(np.ptp(columns), np.ptp(rows)))
        self._relief = cached_array(cache, lambda: _relief(footprint.depth_mm, visible))
        self.extent_px = float(min(np.ptp(columns), np.ptp(rows)) + 1)

    def terms(self, relief: Image, x_px: Image, y_px: Image) -> Image:
        """Basis values (..., TERMS) at pixel indices x, y (...) with the given relief (...)."""
        x, y = ((v - c) / self._scale_px for v, c in zip((x_px, y_px), self._centre_px, strict=True))
        return np.stack([np.ones_like(relief), x, y, relief, x * x, x * y, y * y], axis=-1).astype(np.float32)

    def field(self, coefficients: FloatArray, rows: slice = slice(None), columns: slice = slice(None)) -> Image:
        """Displacement (rows, columns, 2) in pixels from the reference to the frame."""
        return np.moveaxis(self._planes(coefficients, rows, columns, moved=0), 0, -1)

    def positions(self, coefficients: FloatArray, rows: slice, columns: slice) -> Image:
        """Positions of the reference's pixels in the frame: x and y (2, rows, columns) in pixels."""
        return self._planes(coefficients, rows, columns, moved=1)

    def _planes(self, coefficients: FloatArray, rows: slice, columns: slice, moved: int) -> Image:
        # Compute displacements (2, rows, columns), plus ``moved`` times the pixel's own position. The polynomial is a
        # product of (rows, 3) and (3, columns).
        relief = self._relief[rows, columns]
        y_px, x_px = (np.arange(n)[cut] for n, cut in zip(self._relief.shape, (rows, columns), strict=True))
        x, y = ((v - c) / self._scale_px for v, c in zip((x_px, y_px), self._centre_px, strict=True))
        planes = np.empty((2, *relief.shape), dtype=np.float32)
        for plane, c, own_x, own_y in zip(
            planes, coefficients.T, (moved * x_px, 0 * x_px), (0 * y_px, moved * y_px), strict=True
        ):
            of_row = np.stack([c[0] + c[2] * y + c[6] * y * y + own_y, c[1] + c[5] * y, np.ones_like(y)], axis=1)
            of_column = np.stack([np.ones_like(x), x, c[4] * x * x + own_x])
            np.matmul(of_row.astype(np.float32), of_column.astype(np.float32), out=plane)
            np.add(plane, np.float32(c[3]) * relief, out=plane)
        return planes

    def reduced(self, factor: int) -> tuple[BoolArray, Image]:
        """Region (h, w) used for matching, and basis values (h, w, TERMS), both reduced by ``factor``."""
        import cv2

        size = (max(1, self._relief.shape[1] // factor), max(1, self._relief.shape[0] // factor))
        whole = np.s_[: size[1] * factor, : size[0] * factor]
        relief, visible = self._relief[whole], self.visible[whole].astype(np.uint8)
        if factor > 1:
            relief = cv2.resize(relief, size, interpolation=cv2.INTER_AREA)
            visible = cv2.resize(visible, size, interpolation=cv2.INTER_NEAREST)
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * BAND_PX + 1, 2 * BAND_PX + 1))
        region = cv2.dilate(visible, disc) > 0
        y, x = np.mgrid[0 : size[1], 0 : size[0]].astype(np.float32)
        return region, self.terms(relief, (x + 0.5) * factor - 0.5, (y + 0.5) * factor - 0.5)


def _relief(depth_mm: Image, visible: BoolArray) -> Image:
    """Relief (H, W): depth minus its mean, in standard deviations.

    It is continued beyond the outline, so that the outline itself can be matched.
    """
    import cv2

    depth = np.where(visible, depth_mm, 0).astype(np.float32)
    mean, spread = float(depth_mm[visible].mean()), max(float(depth_mm[visible].std()), 1e-6)
    weight = cv2.GaussianBlur(visible.astype(np.float32), (0, 0), BAND_PX)
    beyond = cv2.GaussianBlur(depth, (0, 0), BAND_PX) / np.maximum(weight, 1e-6)
    beyond = np.where(weight > 1e-3, beyond, mean)
    return np.asarray((np.where(visible, depth, beyond) - mean) / spread, dtype=np.float32)


@dataclass(frozen=True)
class _Level:
    """One level of the reference frame's pyramid.

    Attributes:
        feature: (h, w) features of the reference.
        matched: flat indices (N,) of the pixels that are matched.
        terms: (h, w, TERMS) basis values.
        pixel_px: size of the level's pixels, pixels of the frame.
    """

    feature: Image
    matched: NDArray[np.intp]
    terms: Image
    pixel_px: float


class Aligner:
    """Alignment of one camera's frames with its reference frame, for one body.

    Args:
        flow: the body's possible displacements.
        reference: (H, W) or (H, W, C), the reference frame, linear in light, under the light of all frames.
        level: value of a pixel without light.
    """

    def __init__(self, flow: SurfaceFlow, reference: NDArray[np.generic], level: float = 0.0) -> None:
        self._zero = level
        self._extent_px = flow.extent_px
        self._factor = int(np.ceil(np.sqrt(reference.shape[0] * reference.shape[1] / SOLVE_PIXELS)))
        region, terms = flow.reduced(self._factor)
        self._levels = []
        for number, image in enumerate(_pyramid(reduce_grey(reference, self._factor, level))):
            if number:
                region, terms = (
                    _halve(region.astype(np.float32)) > 0.5,
                    np.stack([_halve(terms[..., k]) for k in range(TERMS)], axis=-1),
                )
            inside = np.flatnonzero(region)
            matched = inside[:: -(-len(inside) // MATCHED_PIXELS) or 1]
            self._levels.append(_Level(image, matched, terms, float(self._factor * 2**number)))

    def solve(self, frame: NDArray[np.generic], iterations: int = 30) -> FloatArray:
        """Solve for the coefficients (TERMS, 2) of the displacement from the reference to the frame, coarse to fine.

        Args:
            frame: (H, W) or (H, W, C), linear in light.
            iterations: largest number of Gauss-Newton steps at each level; a third of them at the finest level.
        """
        import cv2

        coefficients = np.zeros((TERMS, 2))
        grey = reduce_grey(frame, self._factor, self._zero)
        for level, moving in reversed(list(zip(self._levels, _pyramid(grey), strict=True))):
            y, x = np.mgrid[0 : moving.shape[0], 0 : moving.shape[1]].astype(np.float32)
            basis = level.terms.reshape(-1, TERMS)[level.matched] / level.pixel_px
            fixed_x, fixed_y = _gradient(level.feature)
            # Take fewer steps at the finest level, which only refines the motion found at the coarser levels
            for _ in range(iterations if level is not self._levels[0] else iterations // 3):
                # Sample the frame at the displaced pixels; use the mean of both images' gradients
                shift = level.terms @ coefficients.astype(np.float32) / level.pixel_px
                warped = cv2.remap(
                    moving, x + shift[..., 0], y + shift[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
                )
                moved_x, moved_y = _gradient(warped)
                slope = 0.5 * np.stack([fixed_x + moved_x, fixed_y + moved_y], axis=-1).reshape(-1, 2)[level.matched]
                residual = (warped - level.feature).ravel()[level.matched]
                # Weight residuals by Geman-McClure at one robust standard deviation, so that reflections and lips have
                # little influence
                scale = robust_sigma(residual) + 1e-6
                weight = 1 / (1 + (residual / scale) ** 2) ** 2
                jacobian = np.concatenate([slope[:, :1] * basis, slope[:, 1:] * basis], axis=1).astype(np.float64)
                hessian = (jacobian * weight[:, None]).T @ jacobian
                damping = self._damping(scale)
                gradient = (jacobian * weight[:, None]).T @ residual + damping * coefficients.T.ravel()
                update = -np.linalg.solve(hessian + np.diag(damping), gradient).reshape(2, TERMS).T
                coefficients = coefficients + update
                if np.abs(update).max() < 2e-3 * level.pixel_px:
                    break
        return coefficients

    def _damping(self, scale: float) -> FloatArray:
        """Diagonal (2 TERMS,) added to the cost's Hessian, which pulls each term towards zero, in ``scale``² per px².

        The result is the maximum a posteriori estimate: residuals have the standard deviation ``scale``, and terms that
        the image does not determine stay near zero.
        """
        precision = np.concatenate([[0], (self._extent_px * np.asarray(PRIOR_SHARE)) ** -2.0])
        return np.asarray(CORRELATED_PX * scale**2 * np.tile(precision, 2) + 1e-12)


def interpolate(times: FloatArray, values: FloatArray, time: float) -> tuple[FloatArray, FloatArray]:
    """Interpolate values at ``time`` by the cubic through the four nearest knots, and estimate the error.

    The error estimate is the difference to the parabola through the three nearest knots, which is larger than the
    cubic's own error where motion is smooth. With fewer knots both curves are of a lower degree, and for a single knot
    the error is zero.

    Args:
        times: (K,) distinct knots. values: (K, ...). time: time of the result.

    Returns:
        Values (...) and their estimated error (...).
    """
    nearest = np.argsort(np.abs(times - time), kind="stable")[:4]
    full = _lagrange(times[nearest], values[nearest], time)
    if len(nearest) < 2:
        return full, np.zeros_like(full)
    return full, np.abs(full - _lagrange(times[nearest[:-1]], values[nearest[:-1]], time))


def _lagrange(times: FloatArray, values: FloatArray, time: float) -> FloatArray:
    total: FloatArray = np.zeros_like(values[0])
    for k, knot in enumerate(times):
        others = np.delete(times, k)
        total = total + values[k] * np.prod((time - others) / (knot - others))
    return total


def warp(image: NDArray[np.generic], displacement: Image) -> Image:
    """Sample an image (H, W) or (H, W, C) at each pixel plus its displacement, linearly; zero beyond the border."""
    import cv2

    height, width = displacement.shape[:2]
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    x += displacement[..., 0]
    y += displacement[..., 1]
    return np.asarray(
        cv2.remap(np.asarray(image, dtype=np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    ).reshape(image.shape)


def _features(image: Image) -> Image:
    """Features (H, W) of an image: local mean and contrast are removed, so that slow shading has little weight, and
    outlines and stains have equal weight.
    """
    import cv2

    peak = float(image.max()) or 1.0
    detail = image - cv2.GaussianBlur(image, (0, 0), 2)
    contrast = np.sqrt(cv2.GaussianBlur(detail * detail, (0, 0), 2) + (0.02 * peak) ** 2)
    return np.asarray(detail / contrast, dtype=np.float32)


def reduce_grey(image: NDArray[np.generic], factor: int, level: float = 0.0) -> Image:
    """Average an image (H, W) or (H, W, C) over channels and squares of ``factor`` pixels, and subtract ``level``.

    Incomplete squares at the right and lower edges are dropped.
    """
    import cv2

    height, width = (max(1, n // factor) for n in image.shape[:2])
    grey = np.empty((height, width), dtype=np.float32)
    # Convert some rows at a time, so that the whole image is never held in floating point
    for band in bands((height, width * factor * factor)):
        rows = image[band.start * factor : band.stop * factor, : width * factor].astype(np.float32)
        small = rows if factor == 1 else cv2.resize(rows, (width, band.stop - band.start), interpolation=cv2.INTER_AREA)
        grey[band] = small.reshape(*grey[band].shape, -1).mean(axis=-1)
    grey -= np.float32(level)
    return grey


def _pyramid(image: Image) -> list[Image]:
    """Pyramid of the image's features, halved while their shorter side has at least 40 pixels."""
    levels = [_features(image)]
    while min(levels[-1].shape) >= 40:
        levels.append(_halve(levels[-1]))
    return levels


def _halve(image: Image) -> Image:
    import cv2

    return np.asarray(cv2.pyrDown(np.ascontiguousarray(image)), dtype=np.float32)


def _gradient(image: Image) -> tuple[Image, Image]:
    import cv2

    return cv2.Scharr(image, cv2.CV_32F, 1, 0) / 32, cv2.Scharr(image, cv2.CV_32F, 0, 1) / 32
