"""How far photographs lie beside the render that should explain them, with the ± that the noise of both gives.

The render's pixels are slid over the photographs. With a the render, s the spread of its mean, b the photograph under
it and v the photograph's variance,

    U = sum (|b - beta a|^2 - sum v - beta^2 sum s^2) / sum (|b|^2 - sum v),    beta = a.b / (|a|^2 - sum s^2)

is the share of the photographs that stays unexplained at the best brightness of each, the noise of both taken out. The
outer sums are over the images, so that those of little light, which a shift onto the dark would explain as well, count
for little. The shift of least U is refined below a pixel by a parabola. With E the lower sum, noise n of a photograph's
pixel changes U by 2 (b - beta a - U b) n / E to first order, that of a render's by -2 beta (b - beta a) n / E. Several
U share that noise, and so the error of what is made of them follows (the delta method).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Shift = tuple[int, int]
"""Pixels to the right and down."""

REACH_MM = 4.0
"""Farthest offset that is looked for, half of a small tooth."""
GRID = 8
"""Offsets tried to each side before the best is refined."""
MIN_KNOWN = 0.7
"""Share of the render's pixels that a shift must leave on usable pixels of the photograph."""
MEDIAN_OF_SQUARE = 0.4549
"""Median of the square of a standard normal number."""


@dataclass(frozen=True)
class Comparison:
    """A photograph as taken beside its render, each (H, W)."""

    photo: Array
    """NaN where it is unusable."""
    variance: Array
    """Of the photograph's noise, as stated."""
    render: Array
    """NaN where nothing was fitted."""
    spread: Array
    """One standard error of ``render``, as far as it is known."""


@dataclass(frozen=True)
class Unexplained:
    """What stays unexplained at one shift, and how it changes with the noise of each pixel."""

    value: float
    slopes: Array
    """(2, I, H, W), of photographs and renders: change of ``value`` by a noise of one standard deviation."""


@dataclass(frozen=True)
class _Match:
    # One image's pixels at one shift, as far as photograph and render are known there: indices and values (n,) of both.
    photo_at: tuple[NDArray[np.int64], NDArray[np.int64]]
    render_at: tuple[NDArray[np.int64], NDArray[np.int64]]
    b: Array
    a: Array
    variance: Array
    spread: Array

    def residual(self, beta: float) -> Array:
        return self.b - beta * self.a

    def beta(self, render_noise: float) -> float:
        # 0 where the render is all noise.
        energy = float(self.a @ self.a) - render_noise
        return float(self.a @ self.b) / energy if energy > 0 else 0.0


@dataclass(frozen=True)
class Slide:
    """The pixels of a render on photographs of one camera."""

    images: Sequence[Comparison]
    pixels: NDArray[np.int64]
    """(N, 2) of the render that are compared."""

    def cropped(self, margin_px: int) -> Slide:
        """The same without what lies farther than a margin from the render's pixels: large images would cost memory."""
        height, width = self.images[0].photo.shape
        low = np.maximum(self.pixels.min(axis=0) - margin_px, 0)
        high = np.minimum(self.pixels.max(axis=0) + margin_px + 1, (width, height))
        window = np.s_[low[1] : high[1], low[0] : high[0]]
        images = [
            Comparison(i.photo[window], i.variance[window], i.render[window], i.spread[window]) for i in self.images
        ]
        return Slide(images, self.pixels - low)

    def unlikeness(self, shift: Shift) -> float:
        """Share that stays unexplained with the noise in it, 1 where nothing is alike: what a search may compare.

        Infinite where too little is known.
        """
        matches = self._matches(shift)
        energy = sum(float(match.b @ match.b) for match in matches)
        if not matches or energy <= 0:
            return np.inf
        return sum(float(match.residual(max(match.beta(0.0), 0.0)) @ match.b) for match in matches) / energy

    def noise(self, shift: Shift) -> float:
        """How many times its stated variance the noise has, by differences of neighbouring residuals; at least 1.

        A capture that says nothing of its noise is given a guess. The median passes over edges.
        """
        ratios = [ratio for match in self._matches(shift) for ratio in _neighbours(match, self.images[0].photo.shape)]
        return max(float(np.median(ratios)) / MEDIAN_OF_SQUARE, 1.0) if ratios else 1.0

    def unexplained(self, shift: Shift, noise: float) -> Unexplained | None:
        """See ``Unexplained``; None where too little is known or the photographs are all noise.

        Args:
            noise: how many times its stated variance the photographs' noise has.
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
        # Of all images, or none where one of them is known on too few pixels.
        matches = [_match(image, self.pixels, shift) for image in self.images]
        return matches if all(len(match.a) >= MIN_KNOWN * len(self.pixels) for match in matches) else []


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
    # Squared differences between a pixel's residual and its right neighbour's, in units of their stated variance.
    beta = match.beta(0.0)
    residual, stated = np.full(shape, np.nan), np.zeros(shape)
    residual[match.photo_at] = match.residual(beta)
    stated[match.photo_at] = match.variance + (beta * match.spread) ** 2
    difference, variance = (residual[:, 1:] - residual[:, :-1]) ** 2, stated[:, 1:] + stated[:, :-1]
    is_known = np.isfinite(difference) & (variance > 0)
    return np.asarray(difference[is_known] / variance[is_known])


@dataclass(frozen=True)
class FoundOffset:
    """The offset at which a render explains its photographs best."""

    right_px: float
    down_px: float
    right_se_px: float
    """One standard error by the photographs' noise."""
    down_se_px: float
    gain: float
    """Share of what is unexplained in place that goes away."""
    z: float
    """What goes away, in standard errors of its own."""

    @property
    def length_px(self) -> float:
        """How far."""
        return float(np.hypot(self.right_px, self.down_px))

    @property
    def length_se_px(self) -> float:
        """One standard error of ``length_px``, the errors to the right and down taken as independent."""
        along = np.array([self.right_px, self.down_px]) / max(self.length_px, 1e-9)
        return float(np.hypot(along[0] * self.right_se_px, along[1] * self.down_se_px))


def best_offset(slide: Slide, pixel_mm: float) -> FoundOffset | None:
    """Search a grid of shifts, then ever smaller steps around the best one.

    None where nothing can be compared or nothing is unexplained.
    """
    slide = slide.cropped(2 * math.ceil(REACH_MM / pixel_mm))
    best = _most_alike(slide, pixel_mm)
    if best is None:
        return None
    # At a wrong shift the tooth's edges are among the residuals, so the lesser of the two is nearer to the noise.
    noise = min(slide.noise((0, 0)), slide.noise(best))
    in_place, there = (slide.unexplained(shift, noise) for shift in ((0, 0), best))
    if in_place is None or there is None or in_place.value <= 0:
        return None
    right, down = (_vertex(slide, best, there, noise, direction) for direction in ((1, 0), (0, 1)))
    less = in_place.value - there.value
    se = float(np.linalg.norm(in_place.slopes - there.slopes))
    gain, z = less / in_place.value, less / se if se > 0 else 0.0
    return FoundOffset(best[0] + right.px, best[1] + down.px, right.se_px, down.se_px, gain, z)


def _most_alike(slide: Slide, pixel_mm: float) -> Shift | None:
    step = max(round(REACH_MM / pixel_mm / GRID), 1)
    reach = round(REACH_MM / pixel_mm / step)
    tried = {shift: slide.unlikeness(shift) for shift in _around((0, 0), step, reach)}
    best = min(tried, key=tried.__getitem__)
    while step > 1:
        step = max(step // 2, 1)
        tried |= {shift: slide.unlikeness(shift) for shift in _around(best, step, 1) if shift not in tried}
        best = min(tried, key=tried.__getitem__)
    return best if np.isfinite(tried[best]) and np.isfinite(tried[0, 0]) else None


def _around(centre: Shift, step: int, reach: int) -> list[Shift]:
    steps = range(-reach, reach + 1)
    return [(centre[0] + i * step, centre[1] + j * step) for i, j in product(steps, steps)]


class _Vertex(NamedTuple):
    px: float
    se_px: float


def _vertex(slide: Slide, best: Shift, there: Unexplained, noise: float, direction: Shift) -> _Vertex:
    # Where a parabola through the values at -1, 0 and 1 is least, with its standard error; (0, infinite) where that is
    # nowhere between them.
    steps = [(best[0] + k * direction[0], best[1] + k * direction[1]) for k in (-1, 1)]
    before, after = (slide.unexplained(step, noise) for step in steps)
    if before is None or after is None or before.value + after.value <= 2 * there.value:
        return _Vertex(0.0, np.inf)
    curvature = before.value - 2 * there.value + after.value
    vertex = float(np.clip(0.5 * (before.value - after.value) / curvature, -0.5, 0.5))
    bending = before.slopes - 2 * there.slopes + after.slopes
    return _Vertex(vertex, float(np.linalg.norm(0.5 * (before.slopes - after.slopes) - vertex * bending)) / curvature)
