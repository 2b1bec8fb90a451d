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
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Camera
from services.preprocess.masking.shadows import expected_irradiance
from services.preprocess.projection import Footprint
from services.preprocess.stabilisation.stabilise import reduce_grey
from services.preprocess.window import Window

FloatArray = NDArray[np.float64]
Image = NDArray[np.float32]
Indices = tuple[NDArray[np.intp], NDArray[np.intp]]

BAND_PX = 2
"""Width of the compared band on either side of the outline, pixels. Farther in, the terms follow a translucent tooth's
shading less well than the outline needs: with bands of 5 and 8 pixels errors are 10 and 25 % larger."""
COARSEST_PX, FINEST_PX = 64, 256
"""Longest side of the body in the reduced images: below ``COARSEST_PX`` in the first, in which a translation is
searched, and at most ``FINEST_PX`` in the last, in which an error of 0.1 px is 0.3 px of a body of 700 px."""
MARGIN_PX = BAND_PX + 3
"""Margin of the compared part of an image beyond the reach, pixels of the coarsest image."""
SAMPLED_PX, MIN_SAMPLES, MAX_SAMPLES = 200, 2, 6
"""Longest side of the body in samples of the surface, and the bounds of the samples along a pixel's side: the share of
an outline's pixel that is covered is known to a few per cent, and the template of a large body fits in memory."""
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
ARCS = 12
"""Number of arcs of the outline whose residuals count as independent of each other: shading is alike along a twelfth of
an outline and differs beyond it."""


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
        self._templates: list[_Template] = []
        if extent_px < MIN_BODY_PX:
            return
        finest = max(1, int(np.ceil(extent_px / FINEST_PX)))
        factors = [finest]
        while extent_px / factors[0] >= COARSEST_PX:
            factors.insert(0, 2 * factors[0])
        self._part = _surroundings(visible, int(np.ceil(reach_px)) + MARGIN_PX * factors[0])
        camera = self._part.cropped(camera)
        self._templates = [
            _Template(camera, numbers, factor, extent_px / factor, reach_px / factor, footprint_in)
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
            lit = template.under(light_mm)
            starts = [shift_px / template.factor]
            if template is self._templates[0]:
                starts.append(lit.searched(grey))
            found = min((lit.refined(grey, start) for start in starts), key=lambda shift: lit.unexplained(grey, shift))
            shift_px = found * template.factor
        return lit.judged(grey, found)


class _Template:
    """Samples of the surface in one reduced image."""

    def __init__(
        self,
        camera: Camera,
        numbers: Sequence[int],
        factor: int,
        extent: float,
        reach: float,
        footprint_in: Callable[[Camera], Footprint],
    ) -> None:
        """Sample the surface; lengths are in pixels of the reduced image."""
        import cv2

        self.factor, self.reach = factor, reach
        self.samples = int(np.clip(np.ceil(SAMPLED_PX / extent), MIN_SAMPLES, MAX_SAMPLES))
        self.pad = int(np.ceil(reach)) + BAND_PX + 2
        width, height = (max(1, n // factor) for n in camera.size)
        self.shape = height, width
        sampled = _sampled_camera(camera, factor, self.samples, self.pad, (width, height))
        footprint = footprint_in(sampled)
        self._body = np.isin(footprint.mesh, list(numbers))
        surface = np.isfinite(footprint.depth_mm)
        self._other = surface & ~self._body
        y, x = np.mgrid[0 : self._body.shape[0], 0 : self._body.shape[1]]
        # Points and normals of all surfaces, in the world for the light and along the camera's axes for the shading
        every = replace(footprint, mesh=np.where(surface, 0, -1).astype(np.int16))
        self._points_mm = every.points_at(sampled, y, x).astype(np.float32)
        self._normal = footprint.normal
        pose = np.asarray(camera.camera_from_world)[:3, :3].astype(np.float32)
        facing = footprint.normal @ pose.T
        inside = np.flatnonzero(self._body.any(axis=1)), np.flatnonzero(self._body.any(axis=0))
        middle = inside[1].mean(), inside[0].mean()
        half = 0.5 * max(1, int(np.ptp(inside[0])), int(np.ptp(inside[1])))
        place = ((x - middle[0]) / half).astype(np.float32), ((y - middle[1]) / half).astype(np.float32)
        self._shading = _polynomial(facing[..., 0], facing[..., 1], *place)
        self._place = place
        # Pixels by whether they see the body: the band along its outline, and the whole with its surroundings
        covered = _block_mean(self._body, self.samples, self.pad, self.shape)
        self.arc = _arcs(covered)
        self.band = _near_outline(covered)
        disc = _disc(int(np.ceil(reach)) + 1)
        self.around = cv2.dilate((covered > 0).astype(np.uint8), disc) > 0

    def under(self, light_mm: tuple[float, float, float]) -> _LitTemplate:
        """Terms of an image under one light."""
        irradiance = expected_irradiance(self._points_mm, self._normal, light_mm, None)
        lit_share = float((irradiance[self._body] > 0).mean())
        irradiance /= max(float(irradiance.max()), 1e-30)
        body, other = self._body[..., None].astype(np.float32), self._other[..., None].astype(np.float32)
        linear = np.stack([np.ones_like(irradiance), *self._place], axis=-1)
        parts = [body * self._shading * irradiance[..., None], body * self._shading, (1 - body - other) * linear]
        if self._other.any():
            parts += [other * linear, other * irradiance[..., None]]
        return _LitTemplate(self, np.concatenate(parts, axis=-1), lit_share)


class _LitTemplate:
    """Terms of a reduced image under one light, each the mean over a pixel at any translation."""

    def __init__(self, template: _Template, terms: NDArray[np.float32], lit_share: float) -> None:
        import cv2

        self._template, self._lit_share = template, lit_share
        side = (template.samples, template.samples)
        # Each sample holds the mean over the pixel that begins there
        means = [cv2.blur(np.ascontiguousarray(term), side, anchor=(0, 0)) for term in np.moveaxis(terms, -1, 0)]
        self._means = np.stack(means, axis=-1)

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


def _surroundings(visible: NDArray[np.bool_], margin_px: int) -> Window:
    """Part of an image that holds a body (H, W) and a margin."""
    rows, columns = (np.flatnonzero(visible.any(axis=axis)) for axis in (1, 0))
    body = Window(int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1)
    return body.grown(margin_px, (visible.shape[1], visible.shape[0]))


def _sampled_camera(camera: Camera, factor: int, samples: int, pad: int, size: tuple[int, int]) -> Camera:
    """Camera whose pixels are samples of the reduced image of ``size`` (width, height) and of ``pad`` pixels around."""
    K = np.array(camera.K)
    K[:2] /= factor
    K[:2, 2] += pad
    K[:2] *= samples
    width, height = ((n + 2 * pad) * samples for n in size)
    return camera.model_copy(update={"size": (width, height), "K": tuple(map(tuple, K.tolist()))})


def _polynomial(right: Image, down: Image, x: Image, y: Image) -> Image:
    """Polynomials (H, W, 14) of a normal's components to the right and down and of a place x, y, each (H, W).

    All products of two of one kind are there, and those with the normal's third component, with which the light from
    inside a translucent tooth fades towards the outline.
    """
    towards = np.sqrt(np.clip(1 - right * right - down * down, 0, 1))
    terms = [np.ones_like(right), right, down, x, y, towards, towards * right, towards * down]
    for first, second in ((right, down), (x, y)):
        terms += [first * first, first * second, second * second]
    return np.stack(terms, axis=-1)


def _left_without_outline(grey: FloatArray, pixels: Indices) -> float:
    """Mean square that a cubic polynomial of the place leaves over some pixels."""
    y, x = ((index - index.mean()) / max(int(np.ptp(index)), 1) for index in pixels)
    design = np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=-1)
    residual = grey[pixels] - design @ np.linalg.lstsq(design, grey[pixels], rcond=None)[0]
    return float((residual * residual).mean())


def _block_mean(body: NDArray[np.bool_], samples: int, pad: int, shape: tuple[int, int]) -> Image:
    """Covered share (H, W) of each pixel of the reduced image."""
    inner = body[pad * samples : (pad + shape[0]) * samples, pad * samples : (pad + shape[1]) * samples]
    blocks = inner.reshape(shape[0], samples, shape[1], samples)
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float32))


def _near_outline(covered: Image) -> NDArray[np.bool_]:
    """Pixels (H, W) at most ``BAND_PX`` inside or outside the outline."""
    import cv2

    disc = _disc(BAND_PX)
    outer = cv2.dilate((covered > 0).astype(np.uint8), disc)
    return np.asarray((outer > 0) & (cv2.erode((covered >= 1).astype(np.uint8), disc) == 0))


def _arcs(covered: Image) -> NDArray[np.intp]:
    """Number (H, W) of the arc of the outline to which a pixel belongs, by its direction from the body's centre."""
    rows, columns = np.nonzero(covered > 0)
    y, x = np.indices(covered.shape)
    turn = np.arctan2(y - rows.mean(), x - columns.mean()) / (2 * np.pi) + 0.5
    return np.asarray(np.minimum((turn * ARCS).astype(np.intp), ARCS - 1))


def _disc(radius: int) -> NDArray[np.uint8]:
    import cv2

    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)), dtype=np.uint8)
