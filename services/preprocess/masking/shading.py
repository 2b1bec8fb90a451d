"""Diffuse shading of a tooth in one image: a quadratic in the surface's normal."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.preprocess.masking.lobe import FoundLobe

Image = NDArray[np.float32]
Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
FITTED_PIXELS = 100_000
"""Largest number of pixels to which shading is fitted."""
MIN_PIXELS = 90
"""Smallest number of pixels to which shading is fitted: ten for each of nine coefficients."""
LOBE_RESIDUAL = 0.75
"""Largest part of shading's residual that a lobe may leave. Translucent teeth without a reflection, brightest around
the mirror direction, kept 0.88 to 0.91 of it; GGX lobes of roughness 0.3, the broadest that are looked for, left 0.27
to 0.56, narrower ones less."""


@dataclass(frozen=True)
class Shading:
    """Diffuse shading as a quadratic in the normal.

    Attributes:
        quadratic: (3, 3) symmetric matrix of the quadratic part.
        linear: (3,) coefficients of the linear part.
        constant: constant part.
        misfit: relative standard deviation of the residual, at least the error that ``fit_shading`` is given.
    """

    quadratic: NDArray[np.float32]
    linear: NDArray[np.float32]
    constant: np.float32
    misfit: float

    def at(self, normal: Image) -> Image:
        """Shading (h, w) of surfaces with unit normals (h, w, 3)."""
        flat = normal.reshape(-1, 3)
        product = flat @ self.quadratic
        product += self.linear
        product *= flat
        return np.asarray(product @ np.ones(3, dtype=np.float32) + self.constant).reshape(normal.shape[:2])


def fit_shading(brightness: Image, far: BoolArray, normal: Image, smallest_error: float) -> Shading | None:
    """Fit the shading (nine coefficients) of the diffuse pixels ``far``; None if too few of them are lit."""
    chosen = lit_pixels(brightness, far)
    if len(chosen) < MIN_PIXELS:
        return None
    level, terms = _level_and_terms(brightness, normal, chosen)
    c = _solve(terms, level)
    # Take the relative residual as the model's error
    misfit = max(smallest_error, float(np.sqrt(np.mean((level - terms @ c) ** 2)) / level.mean()))
    quadratic = np.array(
        [[c[7], c[4] / 2, c[6] / 2], [c[4] / 2, -c[7], c[5] / 2], [c[6] / 2, c[5] / 2, 3 * c[8]]], dtype=np.float32
    )
    return Shading(quadratic, c[1:4].astype(np.float32), np.float32(c[0] - c[8]), misfit)


def lobe_explains_light(lobe: FoundLobe, brightness: Image, usable: BoolArray, normal: Image, cosines: Image) -> bool:
    """Whether a lobe explains light of an image that shading cannot.

    Shading is fitted to all lit pixels, those around the mirror direction too, with and without the lobe, and the
    residuals within the lobe's half-angle are compared. A translucent tooth that is brightest there needs no lobe. If
    its shading is learned from the other pixels alone, it is extrapolated, and the error looks like a broad lobe.

    Args:
        brightness: (H, W). usable: (H, W), pixels of the tooth. normal: (H, W, 3). cosines: (H, W) of the angle between
            normal and half vector.
    """
    chosen = lit_pixels(brightness, usable)
    cosine = cosines.ravel()[chosen].astype(np.float64)
    within = cosine > np.cos(lobe.half_angle)
    if len(chosen) < MIN_PIXELS or not within.any():
        return False
    level, terms = _level_and_terms(brightness, normal, chosen)
    reflected = np.zeros(len(chosen))
    reflected[cosine > 0] = lobe.distribution.at(cosine[cosine > 0] ** 2)
    # Scale the lobe like the other terms, which reach one, so that the ridge treats it as one of them
    with_lobe = np.column_stack([terms, reflected / reflected.max()])
    c, without = _solve(with_lobe, level), _solve(terms, level)
    residuals = (level - with_lobe @ c)[within], (level - terms @ without)[within]
    return bool(c[-1] > 0 and np.linalg.norm(residuals[0]) < LOBE_RESIDUAL * np.linalg.norm(residuals[1]))


def lit_pixels(brightness: Image, pixels: BoolArray) -> NDArray[np.intp]:
    """Flat indices of at most ``FITTED_PIXELS`` pixels of a mask, evenly strided, without those in shadow."""
    inside = np.flatnonzero(pixels)
    chosen = inside[:: max(1, -(-len(inside) // FITTED_PIXELS))]
    if not len(chosen):
        return chosen
    level = brightness.ravel()[chosen]
    return np.asarray(chosen[level > 0.1 * np.quantile(level, 0.95)])


def _level_and_terms(brightness: Image, normal: Image, chosen: NDArray[np.intp]) -> tuple[Array, Array]:
    """Brightness (N,) and terms of shading (N, 9) of the chosen pixels."""
    terms = np.stack(tuple(_quadratic(normal.reshape(-1, 3)[chosen].astype(np.float64))), axis=-1)
    return brightness.ravel()[chosen].astype(np.float64), terms


def _solve(terms: Array, level: Array) -> Array:
    """Coefficients of a least-squares fit. A small ridge keeps those near zero that the visible normals do not
    determine.
    """
    matrix = terms.T @ terms
    count = len(matrix)
    return np.linalg.solve(matrix + 1e-4 * np.trace(matrix) / count * np.eye(count), terms.T @ level)


def _quadratic(normal: NDArray[Any]) -> Iterator[NDArray[Any]]:
    """Yield nine polynomials of a normal (..., 3) up to degree two: the spherical harmonics up to scale."""
    x, y, z = (normal[..., k] for k in range(3))
    yield np.ones_like(x)
    yield from (x, y, z)
    yield x * y
    yield y * z
    yield z * x
    yield x * x - y * y
    yield 3 * z * z - 1
