"""Translation of a body between photographs under different lights, found from its outline.

Between two lights everything in a picture changes but where the known surface ends. So an image is compared with the
scan and not with another image: near the outline it is a sum of shading terms inside, each cut off by the outline, and
of a free level outside. The terms are the light's irradiance and the footprint itself, each times a quadratic
polynomial of the normal and of the position, which also describes light that leaves a translucent tooth elsewhere than
it entered. Their coefficients are eliminated by least squares at each trial translation (variable projection; Golub &
Pereyra 1973, with the derivative of Kaufman 1975).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Camera
from services.preprocess.stabilisation.stabilise import reduce_grey
from services.preprocess.stabilisation.surface_samples import ARCS, BAND_PX, SurfaceSamples, surroundings
from services.preprocess.views.direct_light import expected_irradiance
from services.preprocess.views.projection import Footprint

FloatArray = NDArray[np.float64]
Indices = tuple[NDArray[np.intp], NDArray[np.intp]]

COARSEST_PX, FINEST_PX = 64, 256
"""Longest side of the body in the reduced images: below ``COARSEST_PX`` in the first, in which a translation is
searched, and at most ``FINEST_PX`` in the last, in which an error of 0.1 px is 0.3 px of a body of 700 px."""
MARGIN_PX = BAND_PX + 3
"""Margin of the compared part of an image beyond the reach, pixels of the coarsest image."""
SEARCH_STEP_PX = 2
"""Distance between the translations that are tried first, pixels of the coarsest image: less than the basin of the
right one, which is about as wide as the band."""
SEARCHED_OF = 3
"""One pixel in so many counts in the search: two images of a tooth differ at hundreds of pixels."""
ITERATIONS = 12
"""Largest number of steps in one image; three to five are taken."""
DIFFERENCE_PX = 0.25
"""Distance to either side at which the template is sampled for its derivative, pixels."""
CONVERGED_PX = 0.01
"""Step below which the translation is found, pixels of the reduced image."""
RIDGE = 1e-3
"""Prior standard deviation of a term's coefficient is the image's size over this; it keeps terms that hardly differ
near the outline from cancelling each other."""
ERROR_OF_RESIDUAL = 4.0
"""Standard error of the translation over that by the residuals. What the terms do not describe shifts all of an outline
alike and so leaves less residual than error: over static images by another renderer the ratio of their rms is 2 to 3.4,
and single opaque teeth in a hundred lie 4 residual errors off."""
MIN_LIT_SHARE = 1 / 4
"""Smallest share of the visible surface that a light from behind has to reach for the outline to tell a translation.
With less an opaque tooth is a bright crescent, whose width its gloss sets: such images lie up to 1.7 px off, by up to
seven of their errors."""
UNLIT_ERROR_PX = 1e3
"""Standard error of an outline that its light does not reach: it tells nothing, but it is no sign of a fault either."""
MIN_ERROR_PX = 0.1
"""Smallest standard error, pixels of the last reduced image: the errors that opaque static subjects leave."""
MAX_UNEXPLAINED = 0.25
"""Largest mean square that the outline leaves, as a share of what a cubic polynomial of the place leaves, which knows
of no outline. With more there is none to be seen where it is looked for. Teeth before a dark ground leave 0.01 to
0.05, and more where their noise is a tenth of the brightness."""
MIN_BODY_PX = 8
"""Smallest longer side of a body whose outline is looked for."""
MIN_PIXELS_PER_TERM = 6
"""Smallest number of compared pixels for each term; an image with fewer tells no translation. Some teeth that are 10
pixels wide have 4, and one image in twenty is then a pixel off."""


@dataclass(frozen=True)
class OutlineShift:
    """Translation of a body's outline in one image from where the scan puts it."""

    shift_px: FloatArray
    """x and y (2,), pixels."""
    error_px: float
    """Standard error of either component; infinite where a lit outline is not to be seen within reach."""
    arcs_px: tuple[tuple[float, float], tuple[float, float]]
    """The same translation by the odd and by the even arcs alone."""


NOT_SEEN = OutlineShift(np.zeros(2), np.inf, ((0.0, 0.0), (0.0, 0.0)))


class OutlineMatcher:
    """Finds the translation of one body in a camera's images.

    Args:
        camera: the camera of the images.
        numbers: numbers of the body's meshes in a footprint.
        visible: (H, W) pixels of an image that show the body where the scan puts it.
        reach_px: largest translation that is searched, pixels.
        footprint_in: gives the surfaces that a camera sees.
    """

    def __init__(
        self,
        camera: Camera,
        numbers: Sequence[int],
        visible: NDArray[np.bool_],
        reach_px: float,
        footprint_in: Callable[[Camera], Footprint],
    ) -> None:
        """Sample the surface for each reduced image."""
        extent_px = float(max(np.ptp(np.flatnonzero(visible.any(axis=axis))) + 1 for axis in (0, 1)))
        self._templates: list[SurfaceSamples] = []
        if extent_px < MIN_BODY_PX:
            return
        finest = max(1, int(np.ceil(extent_px / FINEST_PX)))
        factors = [finest]
        while extent_px / factors[0] >= COARSEST_PX:
            factors.insert(0, 2 * factors[0])
        self._part = surroundings(visible, int(np.ceil(reach_px)) + MARGIN_PX * factors[0])
        camera = self._part.cropped(camera)
        self._templates = [
            SurfaceSamples(camera, numbers, factor, extent_px / factor, reach_px / factor, footprint_in)
            for factor in factors
        ]

    def match(
        self, image: NDArray[np.generic], light_mm: tuple[float, float, float], level: float = 0.0
    ) -> OutlineShift:
        """Find the translation in one image.

        Args:
            image: (H, W) or (H, W, C), linear in light above ``level``.
            light_mm: position of the only light.
            level: value of a pixel without light.
        """
        if not self._templates:
            return NOT_SEEN
        shift_px = np.zeros(2)
        own = image[self._part.rows, self._part.columns]
        for template in self._templates:
            grey = reduce_grey(own, template.factor, level).astype(np.float64)
            grey /= max(float(np.abs(grey).max()), 1e-30)
            lit = _LitTemplate.under(template, light_mm)
            starts = [shift_px / template.factor]
            if template is self._templates[0]:
                starts.append(lit.searched(grey))
            found = min((lit.refined(grey, start) for start in starts), key=lambda shift: lit.unexplained(grey, shift))
            shift_px = found * template.factor
        return lit.judged(grey, found)


class _LitTemplate:
    """Terms of a reduced image under one light, each the mean over a pixel at any translation."""

    def __init__(self, template: SurfaceSamples, terms: NDArray[np.float32], lit_share: float) -> None:
        import cv2

        self._template, self._lit_share = template, lit_share
        side = (template.samples, template.samples)
        # Each sample holds the mean over the pixel that begins there
        means = [cv2.blur(np.ascontiguousarray(term), side, anchor=(0, 0)) for term in np.moveaxis(terms, -1, 0)]
        self._means = np.stack(means, axis=-1)

    @classmethod
    def under(cls, samples: SurfaceSamples, light_mm: tuple[float, float, float]) -> _LitTemplate:
        """Terms of an image under one light."""
        irradiance = expected_irradiance(samples.points_mm, samples.normal, light_mm, None)
        lit_share = float((irradiance[samples.body] > 0).mean())
        irradiance /= max(float(irradiance.max()), 1e-30)
        body, other = samples.body[..., None].astype(np.float32), samples.other[..., None].astype(np.float32)
        linear = np.stack([np.ones_like(irradiance), *samples.place], axis=-1)
        parts = [body * samples.shading * irradiance[..., None], body * samples.shading, (1 - body - other) * linear]
        if samples.other.any():
            parts += [other * linear, other * irradiance[..., None]]
        return cls(samples, np.concatenate(parts, axis=-1), lit_share)

    def searched(self, grey: FloatArray) -> FloatArray:
        """Best translation (2,) of a grid over the reach."""
        rows, columns = (index[::SEARCHED_OF] for index in np.nonzero(self._template.around))
        count = int(self._template.reach // SEARCH_STEP_PX)
        best = np.zeros(2)
        for step, reach in ((SEARCH_STEP_PX, count), (1, 1)):
            offsets = [
                step * np.array([i, j], dtype=np.float64)
                for i in range(-reach, reach + 1)
                for j in range(-reach, reach + 1)
            ]
            best = min((best + one for one in offsets), key=lambda shift: self._fit(grey, (rows, columns), shift)[0])
        return best

    def refined(self, grey: FloatArray, start: FloatArray) -> FloatArray:
        """Translation (2,) at the least squares near a start; pixels are those along the outline at the start."""
        pixels, shift = self._band(start), start
        cost = self._fit(grey, pixels, shift)[0]
        for _ in range(ITERATIONS):
            _, coefficients, design, residual = self._fit(grey, pixels, shift)
            slope = self._projected_slope(pixels, shift, coefficients, design)
            step = np.clip(np.linalg.lstsq(slope, residual, rcond=None)[0], -1, 1)
            while (there := self._fit(grey, pixels, shift + step)[0]) > cost and np.abs(step).max() >= CONVERGED_PX:
                step = step / 2
            if there > cost or np.abs(shift + step).max() > self._template.reach:
                break
            shift, cost = shift + step, there
            if np.abs(step).max() < CONVERGED_PX:
                break
        return np.asarray(shift)

    def judged(self, grey: FloatArray, shift: FloatArray) -> OutlineShift:
        """The translation with its error and its values by odd and even arcs, in pixels of the unreduced image."""
        pixels, factor = self._band(shift), self._template.factor
        _, coefficients, design, residual = self._fit(grey, pixels, shift)
        slope = self._projected_slope(pixels, shift, coefficients, design)
        moved = np.rint(shift).astype(int)
        arc = self._template.arc[pixels[0] - moved[1], pixels[1] - moved[0]]
        scores = np.stack([slope[arc == k].T @ residual[arc == k] for k in range(ARCS)])
        curvature = slope.T @ slope
        spread = np.linalg.pinv(curvature)
        covariance = spread @ (scores.T @ scores) @ spread * ARCS / (ARCS - 1)
        odd, even = (
            (shift + np.linalg.pinv(slope[arc % 2 == k].T @ slope[arc % 2 == k]) @ scores[k::2].sum(axis=0)) * factor
            for k in (1, 0)
        )
        error = max(ERROR_OF_RESIDUAL * float(np.sqrt(np.trace(covariance) / 2)), MIN_ERROR_PX)
        is_seen = self.unexplained(grey, shift) < MAX_UNEXPLAINED
        is_within = np.abs(shift).max() < self._template.reach - 1
        if self._lit_share < MIN_LIT_SHARE:
            return OutlineShift(np.zeros(2), UNLIT_ERROR_PX, NOT_SEEN.arcs_px)
        if not (is_seen and is_within) or len(design) < MIN_PIXELS_PER_TERM * design.shape[1]:
            return NOT_SEEN
        arcs = (float(odd[0]), float(odd[1])), (float(even[0]), float(even[1]))
        return OutlineShift(shift * factor, error * factor, arcs)

    def unexplained(self, grey: FloatArray, shift: FloatArray) -> float:
        """Mean square that an outline at a translation leaves, as a share of what no outline leaves."""
        pixels = self._band(shift)
        return self._fit(grey, pixels, shift)[0] / max(_left_without_outline(grey, pixels), 1e-30)

    def _band(self, shift: FloatArray) -> Indices:
        """Rows and columns of the pixels along the outline after a translation by the nearest whole pixels."""
        rows, columns = np.nonzero(self._template.band)
        moved = np.rint(shift).astype(int)
        rows, columns = rows + moved[1], columns + moved[0]
        height, width = self._template.shape
        inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        return rows[inside], columns[inside]

    def _fit(
        self, grey: FloatArray, pixels: Indices, shift: FloatArray
    ) -> tuple[float, FloatArray, FloatArray, FloatArray]:
        """Least squares over some pixels: mean square of the residual, coefficients (K,) of the terms, the terms
        (N, K) scaled to a mean square of one, and the residual (N,).
        """
        values, design = grey[pixels], self._terms(pixels, shift)
        scale = np.sqrt((design * design).mean(axis=0)) + 1e-9
        scaled = design / scale
        normal = scaled.T @ scaled
        normal[np.diag_indices_from(normal)] += RIDGE**2 * len(values)
        coefficients = np.linalg.solve(normal, scaled.T @ values)
        residual = values - scaled @ coefficients
        return float((residual * residual).mean()), coefficients / scale, scaled, residual

    def _projected_slope(
        self, pixels: Indices, shift: FloatArray, coefficients: FloatArray, design: FloatArray
    ) -> FloatArray:
        """Derivative (N, 2) of the image with respect to the translation, less what the terms can take up."""
        steps = DIFFERENCE_PX * np.eye(2)
        slope = np.stack(
            [(self._terms(pixels, shift + step) - self._terms(pixels, shift - step)) @ coefficients for step in steps],
            axis=-1,
        ) / (2 * DIFFERENCE_PX)
        normal = design.T @ design
        normal[np.diag_indices_from(normal)] += RIDGE**2 * len(design)
        return np.asarray(slope - design @ np.linalg.solve(normal, design.T @ slope))

    def _terms(self, pixels: Indices, shift: FloatArray) -> FloatArray:
        """Values (N, K) of the terms at some pixels after a translation, linear between samples."""
        samples, pad = self._template.samples, self._template.pad
        first = [(pad + at - moved) * samples for at, moved in zip(pixels, shift[::-1], strict=True)]
        low = [np.floor(one).astype(np.intp) for one in first]
        part = [(one - whole)[:, None] for one, whole in zip(first, low, strict=True)]
        value = np.zeros((len(first[0]), self._means.shape[-1]))
        for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
            weight = (part[0] if down else 1 - part[0]) * (part[1] if right else 1 - part[1])
            value += weight * self._means[low[0] + down, low[1] + right]
        return value


def _left_without_outline(grey: FloatArray, pixels: Indices) -> float:
    """Mean square that a cubic polynomial of the place leaves over some pixels."""
    y, x = ((index - index.mean()) / max(int(np.ptp(index)), 1) for index in pixels)
    design = np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=-1)
    residual = grey[pixels] - design @ np.linalg.lstsq(design, grey[pixels], rcond=None)[0]
    return float((residual * residual).mean())
