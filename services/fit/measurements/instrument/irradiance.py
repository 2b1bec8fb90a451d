"""Uncertainty of each light's irradiance at the teeth, which photographs show: its intensity and its
distance together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from services.core.calibration.uncertainty import CalibrationUncertainty
from services.core.geometry import Light

Array = NDArray[np.float64]
DRIFT = 1e-4
"""Relative standard deviation of each light's own drift: the change of a lamp while it warms up. It keeps the
covariance invertible, which that of errors with mean 0 is not."""


def uncertainty_at_teeth(
    stated: CalibrationUncertainty | None, lights: Sequence[Light], channels: Sequence[str], centre_mm: Array
) -> CalibrationUncertainty | None:
    """The calibration's uncertainty with ``light_gain`` as the error of a light's irradiance at the teeth.

    A light whose assumed distance is too large appears too bright on a white sphere, and at the teeth both errors
    cancel: irradiance is I ÷ d², so its relative error is that of I less 2 (p − c) · δp ÷ |p − c|², for a light at p
    and teeth at c. The standard error of I alone would include an error of the distance that has no effect at the
    teeth.

    Only products of intensity and radiance per count are measured, and a calibration sets the lights' mean intensity to
    1. If all assumed distances are too large, all irradiances are too low, and all radiances too, by the same share. So
    the part that is common to all lights does not change the difference of photographs and renders, and is subtracted.
    The remaining error of a white sphere's reflectance is ``gain``.

    Args:
        stated: the calibration's uncertainty; None gives None. Where it does not state the place of some light, or
            states the gain of an unused light, it is returned unchanged.
        lights: lights with the calibrated places and intensities.
        channels: names of the intensities' channels.
        centre_mm: centre of the teeth (3,).
    """
    if stated is None:
        return None
    index = {name: k for k, name in enumerate(stated.names)}
    gains = [k for name, k in index.items() if name.startswith("light_gain.")]
    transform, common = np.eye(len(index)), np.eye(len(index))
    gain_rows: list[int] = []
    for channel, suffix in ((None, ""), *((k, f".{name}") for k, name in enumerate(channels))):
        own = [light for light in lights if f"light_gain.{light.name}{suffix}" in index]
        axes = [_axes(index, light) for light in own]
        if not own or not all(axes):
            continue
        rows = [index[f"light_gain.{light.name}{suffix}"] for light in own]
        for row, light, columns in zip(rows, own, axes, strict=True):
            offset_mm = np.array(light.position_mm) - centre_mm
            transform[row, columns] = -2 * offset_mm / (offset_mm @ offset_mm)
        weights = np.array([np.mean(light.intensity) if channel is None else light.intensity[channel] for light in own])
        common[np.ix_(rows, rows)] -= weights / weights.sum()
        gain_rows += rows
    if not gain_rows or set(gain_rows) != set(gains):
        return stated
    whole = common @ transform
    covariance = whole @ stated.matrix @ whole.T
    covariance[gain_rows, gain_rows] += DRIFT**2
    # Make the covariance exactly symmetric: rounding leaves its halves different in their last digits.
    table = ((covariance + covariance.T) / 2).tolist()
    return CalibrationUncertainty(names=stated.names, covariance=tuple(map(tuple, table)))


def _axes(index: Mapping[str, int], light: Light) -> list[int]:
    """Indices of the three errors of a light's place; empty where they are not stated."""
    names = [f"light.{light.name}.{axis}" for axis in "xyz"]
    return [index[name] for name in names] if all(name in index for name in names) else []
