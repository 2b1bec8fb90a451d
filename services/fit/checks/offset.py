"""Offset of photographs from the render that should explain them, with its standard error by the noise of both.

The render's pixels are shifted over the photographs. With a the render, s the standard error of its mean, b the
photograph under it and v the photograph's variance,

    U = sum (|b - beta a|^2 - sum v - beta^2 sum s^2) / sum (|b|^2 - sum v),    beta = a.b / (|a|^2 - sum s^2)

is the share of the photographs that stays unexplained at the best brightness of each image, without the noise of both.
The outer sums are over the images, so that those with little light, which a shift onto the dark would explain as well,
count for little. The shift of least U is refined below a pixel by a parabola. With E the lower sum, noise n of a
photograph's pixel changes U by 2 (b - beta a - U b) n / E to first order, that of a render's pixel by -2 beta (b - beta
a) n / E. Several U share that noise, so the error of quantities derived from them follows by the delta method.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Shift = tuple[int, int]
"""Shift in pixels to the right and down."""

MAX_OFFSET_MM = 4.0
"""Largest offset of the search, half of a small tooth."""
GRID = 8
"""Number of grid steps to each side in the first search."""
MIN_KNOWN = 0.7
"""Least share of the render's pixels that a shift must leave on usable pixels of the photograph."""
MEDIAN_OF_SQUARE = 0.4549
"""Median of the square of a standard normal number."""


@dataclass(frozen=True)
class Comparison:
    """A photograph and its render, (H, W) each."""

    photo: Array
    """Photograph; NaN where it is unusable."""
    variance: Array
    """Stated variance of the photograph's noise."""
    render: Array
    """Render; NaN where nothing was fitted."""
    spread: Array
    """Standard error of ``render``; 0 where it is not known."""


@dataclass(frozen=True)
class Unexplained:
    """Unexplained share at one shift, and its derivatives with respect to the noise of each pixel."""

    value: float
    slopes: Array
    """Change of ``value`` by a noise of one standard deviation in each pixel, (2, I, H, W): of the I photographs, then
    of their renders."""


@dataclass(frozen=True)
class _Match:
    # Pixels of one image at one shift where photograph and render are known: indices and values (n,) of both.
    photo_at: tuple[NDArray[np.int64], NDArray[np.int64]]
    render_at: tuple[NDArray[np.int64], NDArray[np.int64]]
    b: Array
    a: Array
    variance: Array
    spread: Array

    def residual(self, beta: float) -> Array:
        return self.b - beta * self.a

    def beta(self, render_noise: float) -> float:
        return _beta(self.b, self.a, render_noise)


def _beta(b: Array, a: Array, render_noise: float) -> float:
    # Best brightness of the render; 0 where the render is all noise.
    energy = float(a @ a) - render_noise
    return float(a @ b) / energy if energy > 0 else 0.0


@dataclass(frozen=True)
class _Shown:
    # Pixels (n,) of a render that are known: their places and values, and the photograph for a search that reads it at
    # hundreds of shifts.
    photo: Array
    x: NDArray[np.int64]
    y: NDArray[np.int64]
    a: Array

    @staticmethod
    def of(image: Comparison, pixels: NDArray[np.int64]) -> _Shown:
        x, y = pixels.T
        values = image.render[y, x]
        known = np.isfinite(values)
        return _Shown(image.photo, x[known], y[known], values[known])

    def under(self, shift: Shift) -> tuple[Array, Array]:
        # Values of photograph and render where both are known.
        height, width = self.photo.shape
        x, y, a = self.x + shift[0], self.y + shift[1], self.a
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        if not inside.all():
            x, y, a = x[inside], y[inside], a[inside]
        b = self.photo[y, x]
        known = np.isfinite(b)
        return (b, a) if known.all() else (b[known], a[known])


@dataclass(frozen=True)
class ShiftedRender:
    """Pixels of a render that are shifted over the photographs of one camera."""

    images: Sequence[Comparison]
    pixels: NDArray[np.int64]
    """Compared pixels (N, 2) of the render."""

    def cropped(self, margin_px: int) -> ShiftedRender:
        """The images cropped to a margin around the render's pixels, because large images would need much memory."""
        height, width = self.images[0].photo.shape
        low = np.maximum(self.pixels.min(axis=0) - margin_px, 0)
        high = np.minimum(self.pixels.max(axis=0) + margin_px + 1, (width, height))
        window = np.s_[low[1] : high[1], low[0] : high[0]]
        images = [
            Comparison(i.photo[window], i.variance[window], i.render[window], i.spread[window]) for i in self.images
        ]
        return ShiftedRender(images, self.pixels - low)

    def mismatch(self, shift: Shift) -> float:
        """Unexplained share at a shift, noise included, as the objective of the search; 1 where photograph and render
        have nothing in common.

        Infinite where too few pixels are known.
        """
        pairs = [shown.under(shift) for shown in self._shown]
        energy = sum(float(b @ b) for b, _ in pairs)
        if energy <= 0 or not all(self._is_enough(a) for _, a in pairs):
            return np.inf
        return sum(float((b - max(_beta(b, a, 0.0), 0.0) * a) @ b) for b, a in pairs) / energy

    def noise(self, shift: Shift) -> float:
        """Ratio of the photographs' noise variance to the stated one, from differences of neighbouring residuals; at
        least 1.

        A capture that states no noise has an assumed one. The median ignores edges.
        """
        ratios = [ratio for match in self._matches(shift) for ratio in _neighbours(match, self.images[0].photo.shape)]
        return max(float(np.median(ratios)) / MEDIAN_OF_SQUARE, 1.0) if ratios else 1.0

    def unexplained(self, shift: Shift, noise: float) -> Unexplained | None:
        """Unexplained share at a shift; None where too few pixels are known or the photographs are all noise.

        Args:
            shift: shift in pixels.
            noise: ratio of the photographs' noise variance to the stated one.
        """
        matches = self._matches(shift)
        betas = [match.beta(float(match.spread @ match.spread)) for match in matches]
        energy = sum(float(match.b @ match.b) - noise * float(match.variance.sum()) for match in matches)
        if not matches or energy <= 0:
            return None
        value, slopes = 0.0, np.zeros((2, len(matches), *self.images[0].photo.shape))
        for match, beta in zip(matches, betas, strict=True):
            residual, spread = match.residual(beta), beta * match.spread
            value += (float(residual @ residual - spread @ spread) - noise * float(match.variance.sum())) / energy
        for k, (match, beta) in enumerate(zip(matches, betas, strict=True)):
            residual = match.residual(beta)
            slopes[0, k][match.photo_at] = 2 * (residual - value * match.b) / energy * np.sqrt(noise * match.variance)
            slopes[1, k][match.render_at] = -2 * beta * residual / energy * match.spread
        return Unexplained(value, slopes)

    def _matches(self, shift: Shift) -> list[_Match]:
        # Matches of all images; none where one of the images is known on too few pixels.
        matches = [_match(image, self.pixels, shift) for image in self.images]
        return matches if all(self._is_enough(match.a) for match in matches) else []

    def _is_enough(self, known: Array) -> bool:
        return len(known) >= MIN_KNOWN * len(self.pixels)

    @cached_property
    def _shown(self) -> list[_Shown]:
        return [_Shown.of(image, self.pixels) for image in self.images]


def _match(image: Comparison, pixels: NDArray[np.int64], shift: Shift) -> _Match:
    height, width = image.photo.shape
    x, y = (pixels + shift).T
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    photo_at, render_at = (y[inside], x[inside]), (pixels[inside, 1], pixels[inside, 0])
    known = np.isfinite(image.photo[photo_at]) & np.isfinite(image.render[render_at])
    photo_at, render_at = (photo_at[0][known], photo_at[1][known]), (render_at[0][known], render_at[1][known])
    values = image.photo[photo_at], image.render[render_at], image.variance[photo_at], image.spread[render_at]
    return _Match(photo_at, render_at, *values)


def _neighbours(match: _Match, shape: tuple[int, ...]) -> Array:
    # Squared differences between the residuals of a pixel and its right neighbour, in units of their stated variance.
    beta = match.beta(0.0)
    residual, stated = np.full(shape, np.nan), np.zeros(shape)
    residual[match.photo_at] = match.residual(beta)
    stated[match.photo_at] = match.variance + (beta * match.spread) ** 2
    difference, variance = (residual[:, 1:] - residual[:, :-1]) ** 2, stated[:, 1:] + stated[:, :-1]
    is_known = np.isfinite(difference) & (variance > 0)
    return np.asarray(difference[is_known] / variance[is_known])


@dataclass(frozen=True)
class FoundOffset:
    """Offset at which a render explains its photographs best."""

    right_px: float
    down_px: float
    right_se_px: float
    """Standard error by the photographs' noise."""
    down_se_px: float
    gain: float
    """Share of the unexplained difference at shift 0 that the offset removes."""
    z: float
    """Removed difference in its own standard errors."""

    @property
    def length_px(self) -> float:
        """Length of the offset."""
        return float(np.hypot(self.right_px, self.down_px))

    @property
    def length_se_px(self) -> float:
        """Standard error of ``length_px``, with the errors to the right and down taken as independent."""
        along = np.array([self.right_px, self.down_px]) / max(self.length_px, 1e-9)
        # An unknown error across the offset does not count, though 0 times infinity is no number.
        right, down = (
            a * se if a != 0 else 0.0 for a, se in zip(along.tolist(), (self.right_se_px, self.down_se_px), strict=True)
        )
        return float(np.hypot(right, down))


def best_offset(shifted_render: ShiftedRender, pixel_mm: float) -> FoundOffset | None:
    """Best offset by search over a grid of shifts, then with ever smaller steps around the best one.

    None where nothing can be compared or no difference is unexplained.
    """
    shifted_render = shifted_render.cropped(2 * math.ceil(MAX_OFFSET_MM / pixel_mm))
    best = _best_shift(shifted_render, pixel_mm)
    if best is None:
        return None
    # Take the smaller of the two noise estimates: at a wrong shift the tooth's edges are in the residuals and enlarge
    # it.
    noise = min(shifted_render.noise((0, 0)), shifted_render.noise(best))
    unshifted, shifted = (shifted_render.unexplained(shift, noise) for shift in ((0, 0), best))
    if unshifted is None or shifted is None or unshifted.value <= 0:
        return None
    right, down = (_vertex(shifted_render, best, shifted, noise, direction) for direction in ((1, 0), (0, 1)))
    removed = unshifted.value - shifted.value
    se = float(np.linalg.norm(unshifted.slopes - shifted.slopes))
    gain, z = removed / unshifted.value, removed / se if se > 0 else 0.0
    return FoundOffset(best[0] + right.px, best[1] + down.px, right.se_px, down.se_px, gain, z)


def _best_shift(shifted_render: ShiftedRender, pixel_mm: float) -> Shift | None:
    step = max(round(MAX_OFFSET_MM / pixel_mm / GRID), 1)
    reach = round(MAX_OFFSET_MM / pixel_mm / step)
    mismatches = {shift: shifted_render.mismatch(shift) for shift in _around((0, 0), step, reach)}
    best = min(mismatches, key=mismatches.__getitem__)
    while step > 1:
        step = max(step // 2, 1)
        mismatches |= {
            shift: shifted_render.mismatch(shift) for shift in _around(best, step, 1) if shift not in mismatches
        }
        best = min(mismatches, key=mismatches.__getitem__)
    return best if np.isfinite(mismatches[best]) and np.isfinite(mismatches[0, 0]) else None


def _around(centre: Shift, step: int, reach: int) -> list[Shift]:
    steps = range(-reach, reach + 1)
    return [(centre[0] + i * step, centre[1] + j * step) for i, j in product(steps, steps)]


class _Vertex(NamedTuple):
    px: float
    se_px: float


def _vertex(
    shifted_render: ShiftedRender, best: Shift, shifted: Unexplained, noise: float, direction: Shift
) -> _Vertex:
    # Minimum of the parabola through the values at -1, 0 and 1, with its standard error; (0, infinite) where the
    # parabola has no minimum or a value is unknown.
    steps = [(best[0] + k * direction[0], best[1] + k * direction[1]) for k in (-1, 1)]
    before, after = (shifted_render.unexplained(step, noise) for step in steps)
    if before is None or after is None or before.value + after.value <= 2 * shifted.value:
        return _Vertex(0.0, np.inf)
    curvature = before.value - 2 * shifted.value + after.value
    vertex = float(np.clip(0.5 * (before.value - after.value) / curvature, -0.5, 0.5))
    bending = before.slopes - 2 * shifted.slopes + after.slopes
    return _Vertex(vertex, float(np.linalg.norm(0.5 * (before.slopes - after.slopes) - vertex * bending)) / curvature)
