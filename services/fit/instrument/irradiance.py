"""How wrong each light's brightness is at the teeth, which is what photographs show: its intensity and its distance
together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from services.core.calibration.uncertainty import CalibrationUncertainty
from services.core.geometry import Light

Array = NDArray[np.float64]
DRIFT = 1e-4
"""Of a light by itself, relative: what a lamp changes while it warms. Without it errors whose mean is 0 would have no
inverse."""


def at_the_teeth(
    stated: CalibrationUncertainty | None, lights: Sequence[Light], channels: Sequence[str], centre_mm: Array
) -> CalibrationUncertainty | None:
    """A calibration's uncertainty whose ``light_gain`` is the error of a light's irradiance at the teeth.

    A light that is taken to be farther away than it is comes out brighter on a white sphere, and at the teeth both
    errors cancel: irradiance goes as I ÷ d², so its relative error is that of I less 2 (p − c) · δp ÷ |p − c|². Alone,
    the ± of I would count an error of the distance that the teeth do not see.

    Only products of intensity and radiance per count are measured, and a calibration sets the lights' mean intensity to
    1. If all lights are taken to be too far, all irradiances come out low, and all radiances too, by the same share; so
    the part that all lights have in common is none of photographs against renders, and is taken off. What a white
    sphere's reflectance leaves is ``gain``.

    Args:
        stated: by the calibration; None stays None. Where it states no place of some light, or of a light that was not
            used, all stays as it is.
        lights: where it says that they are, and how bright.
        channels: of the lights' intensities.
        centre_mm: of the teeth (3,).
    """
    if stated is None:
        return None
    place = {name: k for k, name in enumerate(stated.names)}
    gains = [k for name, k in place.items() if name.startswith("light_gain.")]
    transform, common = np.eye(len(place)), np.eye(len(place))
    seen: list[int] = []
    for channel, suffix in ((None, ""), *((k, f".{name}") for k, name in enumerate(channels))):
        own = [light for light in lights if f"light_gain.{light.name}{suffix}" in place]
        axes = [_axes(place, light) for light in own]
        if not own or not all(axes):
            continue
        rows = [place[f"light_gain.{light.name}{suffix}"] for light in own]
        for row, light, columns in zip(rows, own, axes, strict=True):
            away = np.array(light.position_mm) - centre_mm
            transform[row, columns] = -2 * away / (away @ away)
        weights = np.array([np.mean(light.intensity) if channel is None else light.intensity[channel] for light in own])
        common[np.ix_(rows, rows)] -= weights / weights.sum()
        seen += rows
    if not seen or set(seen) != set(gains):
        return stated
    whole = common @ transform
    covariance = whole @ stated.matrix @ whole.T
    covariance[seen, seen] += DRIFT**2
    # Rounding leaves halves that differ in their last digits.
    table = ((covariance + covariance.T) / 2).tolist()
    return CalibrationUncertainty(names=stated.names, covariance=tuple(map(tuple, table)))


def _axes(place: Mapping[str, int], light: Light) -> list[int]:
    """Numbers of the three errors of a light's place; none where they are not stated."""
    names = [f"light.{light.name}.{axis}" for axis in "xyz"]
    return [place[name] for name in names] if all(name in place for name in names) else []
