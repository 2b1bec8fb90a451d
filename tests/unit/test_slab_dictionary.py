"""The dictionary's numbers, its mixtures, and the faces of a cell."""

from __future__ import annotations

import math

import numpy as np
import pytest

from services.slab.cell.dictionary import (
    ANGLES_RAD,
    KNOTS,
    SPACING_RAD,
    Material,
    cosine_moments,
    henyey_greenstein,
    mixture,
    tent_solid_angles,
)
from services.slab.cell.interface import Interface, fresnel


def test_tents_have_the_solid_angles_that_were_derived() -> None:
    angles = tent_solid_angles()
    assert math.degrees(SPACING_RAD) == pytest.approx(0.90452, abs=1e-5)
    assert angles[0] / (2 * math.pi) == pytest.approx(4.15372e-5, rel=1e-5)
    assert 1 / angles[-1] == pytest.approx(3831.63, rel=1e-5)
    assert angles.sum() == pytest.approx(4 * math.pi, rel=1e-12)


def test_moments_agree_with_quadrature() -> None:
    nodes = np.linspace(0, math.pi, 199 * 400 + 1)
    values = np.random.default_rng(1).random(KNOTS)
    integrand = np.interp(nodes, ANGLES_RAD, values) * np.sin(nodes) * 2 * math.pi
    assert values @ tent_solid_angles() == pytest.approx(np.trapezoid(integrand, nodes), rel=1e-7)
    assert values @ cosine_moments() == pytest.approx(np.trapezoid(integrand * np.cos(nodes), nodes), rel=1e-6)


def test_a_mixture_gives_back_its_weights() -> None:
    weights = np.random.default_rng(2).dirichlet(np.ones(KNOTS + 2))
    material = mixture(weights)
    np.testing.assert_allclose(material.weights(), weights, atol=1e-12)
    assert material.extinction_per_mm == pytest.approx(200 * (1 - weights[-1]))


def test_hg_keeps_its_numbers() -> None:
    material = henyey_greenstein(1.5, 0.8, 0.1)
    assert material.scattering_per_mm == pytest.approx(1.5)
    assert material.extinction_per_mm == pytest.approx(1.6)
    # Straight lines between knots are above the curve where it is convex, beside the peak, and add a little light
    # there.
    assert material.mean_cosine == pytest.approx(0.8, abs=2e-4)
    with pytest.raises(ValueError, match="exceeds the dictionary"):
        Material(material.scattering * 200, 0).weights()


def test_faces_let_light_pass_alike_both_ways() -> None:
    face = Interface(1.33, 1.0)
    sine = face.inside_sine(25.0)
    assert sine == pytest.approx(math.sin(math.radians(25)) / 1.33)
    assert face.transmittance(sine) == pytest.approx(1 - fresnel(math.cos(math.radians(25)), 1.33))
    assert fresnel(0.3, 1 / 1.33) == 1.0
    assert fresnel(1.0, 1.5) == pytest.approx(0.04)
    assert Interface(1.0, 1.0).transmittance(0.5) == 1.0


def test_glass_bends_reflects_twice_and_displaces() -> None:
    face = Interface(1.33, 1.0, 1.52, 1.25)
    sine = face.inside_sine(25.0)
    near, far = face.reflections(sine)
    assert face.transmittance(0.0) == pytest.approx(
        (1 - fresnel(1, 1.52 / 1.33)) * 0.96 / (1 - fresnel(1, 1.52 / 1.33) * 0.04), rel=5e-3
    )
    assert near.shift_mm == 0
    glass_angle = math.asin(math.sin(math.radians(25)) / 1.52)
    assert far.shift_mm == pytest.approx(2 * 1.25 * math.tan(glass_angle))
    assert face.inside_sine(-25.0) == -sine
    assert face.glass_shift_mm(-sine) == -face.glass_shift_mm(sine)
