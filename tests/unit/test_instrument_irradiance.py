"""Errors of the lights' brightness at the teeth, where errors of intensities and of distances are correlated."""

from __future__ import annotations

import numpy as np
import pytest

from services.core.calibration.uncertainty import CalibrationUncertainty
from services.core.geometry import Light
from services.fit.measurements.instrument.irradiance import DRIFT, uncertainty_at_teeth

CHANNELS = ("red",)
LIGHTS = tuple(
    Light(name=name, position_mm=place, intensity=(intensity,))
    for name, place, intensity in (
        ("a", (0.0, 1000.0, 0.0), 1.2),
        ("b", (600.0, 800.0, 0.0), 0.8),
        ("c", (-300.0, 700.0, 500.0), 1.0),
    )
)
PLACES_MM = np.array([light.position_mm for light in LIGHTS])
INTENSITY = np.array([light.intensity[0] for light in LIGHTS])
TEETH_MM = np.zeros(3)
MEASURED = 0.003
"""Relative scatter of one light's brightness on the white sphere."""
NAMES = ("gain.red", *(f"light_gain.{light.name}.red" for light in LIGHTS))
NAMES += tuple(f"light.{light.name}.{axis}" for light in LIGHTS for axis in "xyz")


def calibrated(rng: np.random.Generator, off_mm: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Calibrations with a white sphere at the place of the teeth: errors of NAMES (count, 13), and relative errors of
    photographs over renders (count, 3).

    Lights are believed to be away from where they are, mostly along the line of sight. Intensities and the radiance per
    count still agree with what the sphere shows; the gauge is that the mean intensity is 1.
    """
    away = PLACES_MM / np.linalg.norm(PLACES_MM, axis=1, keepdims=True)
    # The lights' errors are equal in part, as all of them depend on where the spheres were.
    along = rng.normal(size=(count, 3, 1)) + rng.normal(size=(count, 1, 1))
    believed = PLACES_MM + (off := off_mm * along * away + rng.normal(0, 2, (count, 3, 3)))
    seen = INTENSITY / (PLACES_MM**2).sum(axis=1) * np.exp(rng.normal(0, MEASURED, (count, 3)))
    relative = seen * (believed**2).sum(axis=2)
    radiance = 1 / relative.mean(axis=1, keepdims=True)
    found = relative * radiance
    modelled = found / (believed**2).sum(axis=2)
    photographed = radiance * INTENSITY / (PLACES_MM**2).sum(axis=1)
    gains = rng.normal(0, 0.01, (count, 1))
    errors = np.concatenate([gains, np.log(found / INTENSITY), off.reshape(count, -1)], axis=1)
    return errors, np.log(photographed / modelled)


def drawn(off_mm: float) -> tuple[CalibrationUncertainty, np.ndarray]:
    errors, photographs = calibrated(np.random.default_rng(1), off_mm, 8000)
    covariance = np.cov(errors.T) + 1e-12 * np.eye(len(NAMES))
    stated = CalibrationUncertainty(names=NAMES, covariance=tuple(map(tuple, covariance.tolist())))
    return stated, photographs


@pytest.mark.parametrize("off_mm", [2.0, 15.0])
def test_gains_are_those_of_photographs_over_renders(off_mm: float) -> None:
    stated, photographs = drawn(off_mm)
    found = uncertainty_at_teeth(stated, LIGHTS, CHANNELS, TEETH_MM)
    assert found is not None
    # An error that all lights share belongs to the gain, not to a light. The expected values come from whole
    # calibrations, not from derivatives: the scatter on the sphere.
    apart = photographs - photographs @ (INTENSITY / INTENSITY.sum())[:, None]
    expected = np.cov(apart.T) + DRIFT**2 * np.eye(3)
    # Squares of 1.5 % of a distance are left out, and 8,000 draws give a variance to 1.6 %.
    np.testing.assert_allclose(np.diag(found.matrix)[1:4], np.diag(expected), rtol=0.12)
    assert np.sqrt(np.diag(found.matrix)[1:4]).max() < 1.3 * MEASURED
    if off_mm > 10:
        assert np.sqrt(np.diag(stated.matrix)[1:4]).min() > 5 * MEASURED
    others = np.r_[0, 4:13]
    np.testing.assert_allclose(found.matrix[np.ix_(others, others)], stated.matrix[np.ix_(others, others)], rtol=1e-12)


def test_without_every_lights_place_all_stays_as_it_is() -> None:
    stated, _ = drawn(5.0)
    assert uncertainty_at_teeth(stated, LIGHTS[:2], CHANNELS, TEETH_MM) == stated
    short = CalibrationUncertainty(names=NAMES[:4], covariance=tuple(map(tuple, stated.matrix[:4, :4].tolist())))
    assert uncertainty_at_teeth(short, LIGHTS, CHANNELS, TEETH_MM) == short
    assert uncertainty_at_teeth(None, LIGHTS, CHANNELS, TEETH_MM) is None
