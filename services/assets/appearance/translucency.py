"""Translucency of the measured tissues: TP00 of a layer, the colour difference of it over black and over white.

TP00 is the difference ΔE00 of a layer before an ideal black and an ideal white backing, under diffuse light (the
translucency parameter of Johnston et al. 1995 with ΔE00 in place of ΔE*ab). Reflectance and transmittance of the layer
are those of discrete ordinates for a Henyey-Greenstein phase function of the medium's mean cosine.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.assets.appearance.white import CameraWhite
from services.assets.asset import tissue_of
from services.assets.content import RGB
from services.core.choices import chosen
from services.core.colour.cie import delta_e_2000
from services.core.records import Boundary
from services.core.results import Estimate
from services.transport.optics.ggx_albedo import fresnel_reflectance
from services.transport.optics.parameters import Medium
from services.transport.optics.slab_totals import Interface, Optics, slab_totals

THICKNESS_MM = 1.0
"""Thickness of the layer, mm, for which translucencies of teeth and materials are usually stated."""
STEP = 1e-3
"""Relative step of the derivatives."""
MIN_STEP_PER_MM = 1e-6
"""Least step of a coefficient, 1/mm."""


@dataclass(frozen=True)
class ThinFace:
    """A face that reflects by Fresnel's law and does not bend light; index 1 has no reflection."""

    ior: float
    index: float = 1.0
    index_outside: float = 1.0

    def inside_sine(self, angle_deg: float) -> float:
        """Sine of the angle of light in the layer: that outside."""
        return math.sin(math.radians(angle_deg))

    def transmittance(self, inside_sine: float) -> float:
        """Share of light that passes."""
        return _passed(inside_sine, self.ior)


@dataclass(frozen=True)
class PolishedFace:
    """A face that reflects and bends light by Fresnel's and Snell's laws; it stands for a rough one of its index."""

    index: float
    index_outside: float = 1.0

    def inside_sine(self, angle_deg: float) -> float:
        """Sine of the angle in the layer of light at ``angle_deg`` outside."""
        return math.sin(math.radians(angle_deg)) / self.index

    def transmittance(self, inside_sine: float) -> float:
        """Share of light that passes; none beyond the critical angle."""
        return _passed(inside_sine, self.index_outside / self.index)


def _passed(sine: float, eta: float) -> float:
    return 1 - float(fresnel_reflectance(np.sqrt(max(1 - sine**2, 0.0)), eta))


@dataclass(frozen=True)
class Translucency:
    """TP00 of a layer of one tissue."""

    tissue: str
    tp00: float
    se: float
    """One standard error by those of reduced scattering and absorption in each channel, taken to be independent."""


def translucencies(
    tables: Mapping[str, Mapping[str, Estimate]], boundary: Boundary, ior: float, white: CameraWhite
) -> tuple[Translucency, ...]:
    """TP00 of enamel and dentin of a table of estimates with red, green and blue."""
    found = []
    faces: dict[str, Interface] = {"matched": ThinFace(1.0), "thin": ThinFace(ior), "rough": PolishedFace(ior)}
    face = chosen("Boundary", boundary, faces)
    for part in ("enamel", "dentin"):
        names = f"{part}.sigma_s_reduced", f"{part}.sigma_a"
        if any(name not in tables[channel] for channel in RGB for name in (f"{part}.sigma", f"{part}.alpha", *names)):
            continue
        media = [getattr(tissue_of(dict(tables[channel])), part) for channel in RGB]
        values = np.array([[tables[channel][name].value for name in names] for channel in RGB])
        errors = np.array([[tables[channel][name].se or 0.0 for name in names] for channel in RGB])

        def tp00(coefficients: NDArray[np.float64], media: list[Medium] = media) -> float:
            return _tp00(coefficients, media, face, white)

        value, variance = tp00(values), 0.0
        for place in np.ndindex(values.shape):
            moved = values.copy()
            step = max(STEP * float(values[place]), MIN_STEP_PER_MM)
            moved[place] += step
            variance += ((tp00(moved) - value) / step * float(errors[place])) ** 2
        found.append(Translucency(part, value, math.sqrt(variance)))
    return tuple(found)


def _tp00(coefficients: NDArray[np.float64], media: list[Medium], face: Interface, white: CameraWhite) -> float:
    over = np.zeros((2, len(RGB)))
    for channel, ((scattering, absorption), medium) in enumerate(zip(coefficients, media, strict=True)):
        g = medium.mean_cosine
        totals = slab_totals(Optics(absorption, scattering / (1 - g), g), THICKNESS_MM, face)
        alone, through = totals.reflectance_diffuse, totals.transmittance_diffuse
        over[:, channel] = alone, alone + through**2 / (1 - alone)
    black, light = white.lab(over)
    return float(delta_e_2000(black[None], light[None])[0])
