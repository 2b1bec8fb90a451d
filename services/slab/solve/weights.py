"""Weights of images: the inverse of their covariance, by the measurements' noise and by the noise of the rendered
paths.

A path is connected to every camera, and in a thick cell cameras of one side see nearly the same of it: at sigma_t w = 5
the noise of a pixel correlates by 0.95 between them. Weighted as independent, three cameras counted each path three
times, and the information in their differences, which that noise hardly touches, was lost in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NEIGHBOURHOOD = 3
"""Edge in pixels of the square over which the Monte Carlo covariance is smoothed."""


@dataclass(frozen=True)
class Weights:
    """Weights W = R R^T of each pixel of each light's images; different pixels and lights are independent."""

    images: tuple[NDArray[np.int64], ...]
    """Indices of each light's images, C of all."""
    roots: tuple[Array, ...]
    """R for each light (pixels, C, C)."""
    spreads: Array
    """Standard deviation of each measurement by its own noise (images, pixels); 0 where the value has no weight."""
    used: NDArray[np.bool_]
    """Which values have weight (images, pixels)."""

    def whitened(self, stack: Array) -> Array:
        """R^T times a stack of images (B, images, pixels) or of their derivatives (B, images, pixels, U)."""
        out = np.zeros_like(stack)
        for own, root in zip(self.images, self.roots, strict=True):
            out[:, own] = np.einsum("pij,bip...->bjp...", root, stack[:, own], optimize=True)
        return out

    def of_measurements(self, whitened: Array) -> Array:
        """S^1/2 R x of an array x that ``whitened`` gave, with S the variances of the measurements: x^T R^T S R x is
        their part in W.
        """
        out = np.zeros_like(whitened)
        for own, root in zip(self.images, self.roots, strict=True):
            out[:, own] = np.einsum("pij,bjp...->bip...", root, whitened[:, own], optimize=True)
        return out * self.spreads.reshape(self.spreads.shape + (1,) * (whitened.ndim - 3))


def weights_of(images: Sequence[NDArray[np.int64]], variances: Array, covariances: Sequence[Array]) -> Weights:
    """Weights from the noise of measurements and of renders.

    Args:
        images: indices of each light's images.
        variances: variances of the measurements (images, pixels); infinite where a value has no weight.
        covariances: covariances of the renders' noise, for each light (pixels, C, C).
    """
    used = np.isfinite(variances)
    roots = []
    for own, noise in zip(images, covariances, strict=True):
        counts = used[own].T
        both = counts[:, :, None] & counts[:, None, :]
        total = np.where(both, noise, 0.0)
        diagonal = np.arange(len(own))
        total[:, diagonal, diagonal] += np.where(counts, variances[own].T, 1.0)
        # total = L L^T, so its inverse is L^-T L^-1. Values without weight are independent of the others in it, and are
        # left out here.
        root = np.linalg.inv(np.linalg.cholesky(total)).transpose(0, 2, 1)
        roots.append(np.where(both, root, 0.0))
    spreads = np.sqrt(np.where(used, variances, 0.0))
    return Weights(tuple(images), tuple(roots), spreads, used)


def independent_weights(variances: Array, noise: Array) -> Weights:
    """Weights of values whose measurements and renders all have independent noise, with these variances (images,
    pixels).
    """
    each = [np.array([image]) for image in range(len(variances))]
    return weights_of(each, variances, [one[:, None, None] for one in noise])


def smoothed_covariance(images: Array, shape: tuple[int, int]) -> Array:
    """Monte Carlo covariance (pixels, C, C) of the mean of batches (B, C, pixels), smoothed over neighbours of one
    image.

    A pixel's own estimate is small where its value happens to be small, and weights that follow it pull the fit down.
    """
    batches, count, _ = images.shape
    apart = images - images.mean(axis=0)
    products = np.einsum("bip,bjp->ijp", apart, apart).reshape(count, count, *shape) / (batches * (batches - 1))
    reach = NEIGHBOURHOOD // 2
    padded = np.pad(products, ((0, 0), (0, 0), (reach, reach), (reach, reach)), mode="symmetric")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (NEIGHBOURHOOD, NEIGHBOURHOOD), axis=(2, 3))
    return np.ascontiguousarray(windows.mean(axis=(-1, -2)).reshape(count, count, -1).transpose(2, 0, 1))


def smoothed_variance(images: Array, shape: tuple[int, int]) -> Array:
    """The same for each image by itself: images (B, images, pixels) to variances (images, pixels)."""
    each = [smoothed_covariance(images[:, image : image + 1], shape)[:, 0, 0] for image in range(images.shape[1])]
    return np.stack(each)
