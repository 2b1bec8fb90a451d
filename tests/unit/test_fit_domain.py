"""The unbounded parameters of a fit: conversion there and back, derivatives, extremes, and similar media."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from services.core.errors import SettingsError
from services.core.records import JobSpec
from services.fit.coordinates.domain import (
    BOUNDS,
    HELD_G,
    Coordinate,
    Domain,
    kind_of,
    natural_derivative,
    similar_medium,
    to_dual,
    to_natural,
)
from services.transport.optics.parameters import Medium, Tissue

KINDS = tuple(BOUNDS)


@pytest.mark.parametrize("kind", KINDS)
@given(fraction=st.floats(0, 1))
def test_round_trip_and_derivative_over_the_whole_range(kind: str, fraction: float) -> None:
    low, high = BOUNDS[kind]
    x = low + fraction * (high - low)
    # alpha is stored as itself: 1 - alpha has 1e-16 of absolute rounding, so kappa has 1e-16 / (10^-kappa ln 10),
    # 4.4e-10 at kappa = 7.
    assert math.isclose(to_dual(kind, to_natural(kind, x)), x, rel_tol=1e-9, abs_tol=1e-9)
    step = 1e-6
    numeric = (to_natural(kind, x + step) - to_natural(kind, x - step)) / (2 * step)
    # Central differences: truncation 1e-12 relative, rounding 1e-16 / step.
    assert math.isclose(natural_derivative(kind, x), numeric, rel_tol=1e-5, abs_tol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("value", [-5.0, -1.0, 0.0, 1e-300, 0.5, 1.0, 7.0, 1e300])
def test_any_value_lands_inside_the_bounds(kind: str, value: float) -> None:
    low, high = BOUNDS[kind]
    assert low <= to_dual(kind, value) <= high
    assert math.isfinite(to_natural(kind, to_dual(kind, value)))


def test_forms_that_do_not_cancel() -> None:
    # 1 - alpha = 10^-7 to rounding; beta near both ends; sech^2 where 1 - tanh^2 would be 0.
    assert math.isclose(1 - to_natural("alpha", 7.0), 1e-7, rel_tol=1e-8)
    assert natural_derivative("g1", 25.0) > 0
    assert to_natural("beta", -40.0) > 0
    assert math.isclose(natural_derivative("alpha", 3.0), 1e-3 * math.log(10))


def test_shared_coordinate_moves_both_media() -> None:
    domain = Domain((Coordinate(("enamel.sigma", "dentin.sigma")), Coordinate(("enamel.alpha",), 2.0, 0.5)))
    base = Tissue(Medium(3.0, 0.99, g1=0.5), Medium(3.0, 0.9, g1=0.5))
    x = domain.x_of(base)
    moved = domain.tissue_at(x + np.array([math.log(2), 0]), base)
    assert (moved.enamel.sigma, moved.dentin.sigma) == pytest.approx((6.0, 6.0))
    assert domain.names == ("tooth.sigma", "enamel.alpha")
    assert domain.parameters == ("enamel.sigma", "dentin.sigma", "enamel.alpha")
    np.testing.assert_allclose(domain.chain(x), [[3.0, 0], [3.0, 0], [0, 0.01 * math.log(10)]])
    np.testing.assert_allclose(domain.prior, [[0, 2.0], [0, 4.0]])


def test_unknown_parameter_is_named() -> None:
    with pytest.raises(SettingsError, match=r"enamel\.colour"):
        kind_of("enamel.colour")


@given(sigma=st.floats(0.01, 100), alpha=st.floats(0.5, 0.99999), g=st.floats(-0.5, 0.95), other=st.floats(0, 0.9))
def test_similar_media_share_reduced_scattering_and_absorption(
    sigma: float, alpha: float, g: float, other: float
) -> None:
    medium = Medium(sigma, alpha, g1=g)
    similar = similar_medium(medium, other)
    assert similar.sigma_s_reduced == pytest.approx(medium.sigma_s_reduced, rel=1e-9)
    assert (1 - similar.alpha) * similar.sigma == pytest.approx((1 - alpha) * sigma, rel=1e-6)
    assert similar.alpha_reduced == pytest.approx(medium.alpha_reduced, rel=1e-6)


def test_a_cosine_changes_neither_reduced_quantity_and_comes_back() -> None:
    tissue = Tissue(Medium(4.0, 0.995, g1=0.6), Medium(12.0, 0.99, g1=0.75))
    domain = Domain(
        tuple(Coordinate((name,)) for name in ("enamel.sigma", "enamel.alpha", "dentin.sigma", "enamel.cosine"))
    )
    x = domain.x_of(tissue)
    again = domain.tissue_at(x, tissue)
    for name in ("enamel.sigma", "enamel.alpha", "enamel.g1", "dentin.sigma", "dentin.g1"):
        assert again.value(name) == pytest.approx(tissue.value(name), rel=1e-12)
    moved = domain.tissue_at(x + np.array([0, 0, 0, 0.5]), tissue).enamel
    assert moved.g1 == pytest.approx(math.tanh(math.atanh(0.6) + 0.5))
    assert (moved.sigma_s_reduced, moved.alpha_reduced) == pytest.approx(
        (tissue.enamel.sigma_s_reduced, tissue.enamel.alpha_reduced)
    )
    # The other coordinates are those of the similar medium at the cosine that is used where none is fitted.
    assert x[0] == pytest.approx(math.log(similar_medium(tissue.enamel, HELD_G).sigma))


def test_only_what_can_be_held_may_be() -> None:
    with pytest.raises(ValidationError, match=r"held names 'enamel.colour'"):
        JobSpec.model_validate({"capture": "x", "held": {"enamel.colour": 1.0}})
    with pytest.raises(ValidationError, match=r"held enamel.alpha = 1.5 must lie between 0 and 1"):
        JobSpec.model_validate({"capture": "x", "held": {"enamel.alpha": 1.5}})
