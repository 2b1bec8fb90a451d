"""Roughness of a surface from the highlights of photographs under point lights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from services.core.errors import CaptureInputError
from services.core.geometry import Mesh
from services.fit.measurements.roughness.background import LENGTHS_MM
from services.fit.measurements.roughness.lobe_fit import LobeFit, fit_lobe
from services.fit.measurements.roughness.patches import Patch, Photograph, Views
from services.fit.measurements.roughness.start import Start, first_guess
from services.fit.measurements.roughness.surface import SurfaceError

REMEDY = "give roughness a number, such as 0.15"
SATURATED = (
    "The highlights are saturated, and what is left of them does not tell the roughness; photograph with shorter"
    f" exposures too, or {REMEDY}."
)
WIDEST = 1.2
"""Tangent of the widest angle between normal and half vector at which pixels are looked at, 50 degrees."""
FIRST_PIXELS, PIXELS = 800, 1500
"""Largest number of pixels of a photograph for the first guess, and for the fit."""
FIRST_ROUGHNESS = 0.1
"""Roughness whose highlights the first guess resolves."""
MIN_PIXELS = 60
"""Least number of pixels of a photograph that is used: the background has 18 free terms there, and its bumps."""
MAX_PHOTOGRAPHS = 24
"""Largest number of photographs that are fitted, those that tell most."""
MAX_WINDOWS = 3
"""Largest number of fits, each to the pixels that the roughness before it reaches."""
SAME_WINDOW = 0.3
"""Change of the roughness' logarithm below which these pixels are kept."""
MIN_TOLD = 25.0
"""Least squared ratio of a photograph's highlight to its noise."""
MIN_BRIGHTNESS = 0.1
"""Least brightness of highlights, over the predicted one, that is taken for a reflection. A film of water reflects
a third of what bare enamel does."""
MAX_RELATIVE_SE = 0.3
"""Largest relative standard error of a roughness that is handed on."""
TELLS_LITTLE = 0.1
"""Relative standard error from which on a warning says that the data tell little."""
CORE_LEFT = 0.1
"""Least share of a highlight's core that is not saturated."""
LARGE_HEIGHT = 3.0
"""Error of the surface, over the assumed one, from which on a warning says so."""
UNEXPECTED_Z = 3.0
"""Standard errors from which on a brightness is another than the predicted one."""
UNEXPECTED = 0.2
"""Relative difference of the brightness that is worth a warning: a change of the roughness by a tenth."""


@dataclass(frozen=True)
class Roughness:
    """Measured roughness of a surface.

    Attributes:
        value, standard_error: GGX roughness.
        brightness, brightness_se: of the highlights, over the one that index and calibration predict.
        index, index_se: index of refraction by this brightness, if the lights' calibration is exact.
        surface_height_mm: standard deviation of the scanned surface's error, as the highlights show it, mm.
        photographs: (camera, light) of the photographs that were fitted.
        pixels: number of their pixels.
        warnings: what to know before trusting the value, one sentence each.
    """

    value: float
    standard_error: float
    brightness: float
    brightness_se: float
    index: float
    index_se: float
    surface_height_mm: float
    photographs: tuple[tuple[str, str], ...]
    pixels: int
    warnings: tuple[str, ...]

    @property
    def lights(self) -> int:
        """Number of lights whose highlights were used."""
        return len({light for _, light in self.photographs})


def roughness_from_highlights(
    outer: Mesh,
    photographs: Sequence[Photograph],
    ior: float,
    occluders: Sequence[Mesh] = (),
    error: SurfaceError | None = None,
) -> Roughness:
    """Measure the roughness by which highlights have the form that they have.

    A pixel shows the light that GGX facets of one roughness reflect once, and a smooth background. The scanned surface
    is wrong by a smooth random height, which is fitted with the roughness: an unknown tilt of a normal moves and
    stretches a highlight, and would else be taken for another roughness. The brightness of the highlights is free, so
    that neither the index nor the calibration of the lights decides.

    The standard error contains the pixels' noise, the surface's error, what goes together in a photograph, and how far
    the answer depends on how smooth the background is taken to be.

    Args:
        outer: the scanned surface.
        photographs: the photographs, those of one camera one after the other.
        ior: index of refraction.
        occluders: other surfaces, which hide and shade it.
        error: how far the scanned surface may be off.

    Raises:
        CaptureInputError: no highlight is seen, all are saturated, or they tell too little; the message names the
            remedy.
    """
    error = error or SurfaceError()
    start, seen = _first(outer, photographs, ior, occluders)
    chosen = _chosen(start, seen)
    roughness = start.roughness
    for _ in range(MAX_WINDOWS):
        patches = _patches(outer, [photographs[k] for k in chosen], roughness, occluders)
        fit = fit_lobe(patches, ior, roughness, error, LENGTHS_MM[0])
        change, roughness = fit.ln_roughness - np.log(roughness), float(np.exp(fit.ln_roughness))
        if abs(change) < SAME_WINDOW:
            break
    fits = [fit, *(fit_lobe(patches, ior, roughness, error, length) for length in LENGTHS_MM[1:])]
    return _judged(fits, patches, ior, error)


def _first(
    outer: Mesh, photographs: Sequence[Photograph], ior: float, occluders: Sequence[Mesh]
) -> tuple[Start, list[tuple[int, Patch]]]:
    """First guess, and the photographs that show the surface near the mirror direction, each with its pixels."""
    views = Views(outer, occluders, FIRST_ROUGHNESS)
    found = [(k, views.patch(photograph, 1.0, FIRST_PIXELS)) for k, photograph in enumerate(photographs)]
    seen = [(k, patch) for k, patch in found if patch is not None and len(patch.value) >= MIN_PIXELS]
    if not seen and any(photograph.clipped.any() for photograph in photographs):
        raise CaptureInputError(SATURATED)
    if not seen:
        raise CaptureInputError(
            "No photograph shows lit surface around the mirror direction of its light, so no highlight tells the"
            f" roughness; {REMEDY}."
        )
    return first_guess((patch for _, patch in seen), ior), seen


def _chosen(start: Start, seen: Sequence[tuple[int, Patch]]) -> list[int]:
    """Numbers of the photographs to fit, whose highlights tell most.

    Raises:
        CaptureInputError: no photograph has a highlight, or all highlights are saturated.
    """
    saturated = [_is_saturated(patch, start.roughness) for _, patch in seen]
    told = np.where(saturated, 0.0, start.told)
    order = [k for k in np.argsort(-told, kind="stable") if told[k] > MIN_TOLD][:MAX_PHOTOGRAPHS]
    if start.brightness < MIN_BRIGHTNESS or not order:
        if any(len(patch.clipped) for _, patch in seen):
            raise CaptureInputError(SATURATED)
        raise CaptureInputError(
            "No photograph shows a highlight, as of a matte subject or behind a polariser, so none tells the roughness;"
            f" {REMEDY}."
        )
    return sorted(seen[k][0] for k in order)


def _is_saturated(patch: Patch, roughness: float) -> bool:
    core = np.count_nonzero(patch.tangent < roughness)
    clipped = np.count_nonzero(patch.clipped < roughness)
    return bool(clipped > 0 and core < CORE_LEFT * (core + clipped))


def _patches(
    outer: Mesh, photographs: Sequence[Photograph], roughness: float, occluders: Sequence[Mesh]
) -> list[Patch]:
    """Pixels around the highlights, as far as a lobe of a roughness and the scan's tilted normals reach."""
    views, widest = Views(outer, occluders, roughness), min(5 * roughness + 0.06, WIDEST)
    found = (views.patch(photograph, widest, PIXELS) for photograph in photographs)
    patches = [patch for patch in found if patch is not None and len(patch.value) >= MIN_PIXELS]
    if not patches:
        raise CaptureInputError(
            f"The highlights are smaller than {MIN_PIXELS} pixels, too few to tell the roughness; photograph from"
            f" nearer, or {REMEDY}."
        )
    return patches


def _judged(fits: Sequence[LobeFit], patches: Sequence[Patch], ior: float, error: SurfaceError) -> Roughness:
    """The roughness with its standard error and warnings.

    Raises:
        CaptureInputError: the standard error is too large.
    """
    fit = fits[0]
    both = np.array([[one.ln_roughness, one.ln_brightness] for one in fits])
    spread = ((both - both[0]) ** 2).sum(axis=0) / max(len(fits) - 1, 1)
    se, brightness_se = np.sqrt(np.diag(fit.covariance) + spread)
    value, brightness = float(np.exp(fit.ln_roughness)), float(np.exp(fit.ln_brightness))
    clipped, pixels = sum(len(patch.clipped) for patch in patches), sum(len(patch.value) for patch in patches)
    if not se <= MAX_RELATIVE_SE:
        why = f", of whose pixels {100 * clipped / (clipped + pixels):.0f} % are saturated" if clipped else ""
        raise CaptureInputError(
            f"The highlights{why} tell the roughness only within {100 * se:.0f} %; photograph more of them, or"
            f" {REMEDY}."
        )
    index, index_se = _index(ior, brightness, brightness * float(brightness_se))
    warnings = []
    if se > TELLS_LITTLE:
        warnings.append(
            f"The highlights of {len(patches)} photographs tell the roughness only within {100 * se:.0f} %; more lights"
            " near the cameras, or finer pixels, tell more."
        )
    if not all(one.converged for one in fits):
        warnings.append("The fit of the roughness did not come to an end; look at the photographs' highlights.")
    if abs(brightness - 1) > max(UNEXPECTED, UNEXPECTED_Z * brightness * brightness_se):
        warnings.append(
            f"The highlights are {brightness:.2f} ± {brightness * brightness_se:.2f} times as bright as an index of"
            f" {ior:g} and the calibration of the lights predict; check ior (by the brightness alone {index:.2f} ±"
            f" {index_se:.2f}), wet surfaces and the calibration."
        )
    if fit.height_mm > LARGE_HEIGHT * error.height_mm:
        warnings.append(
            f"The highlights are as uneven as on a surface that is {fit.height_mm:.2g} mm off the scan; take a finer"
            " scan, because its facets may pass for roughness."
        )
    return Roughness(
        value,
        value * float(se),
        brightness,
        brightness * float(brightness_se),
        index,
        index_se,
        fit.height_mm,
        tuple(patch.photograph for patch in patches),
        fit.pixels,
        tuple(warnings),
    )


def _index(ior: float, brightness: float, se: float) -> tuple[float, float]:
    """Index of refraction by which the reflectance at normal incidence is ``brightness`` times that of ``ior``, and its
    standard error.
    """

    def of(factor: float) -> float:
        root = min(np.sqrt(max(factor, 0.0)) * (ior - 1) / (ior + 1), 0.95)
        return float((1 + root) / (1 - root))

    return of(brightness), abs(of(brightness + se) - of(brightness - se)) / 2
