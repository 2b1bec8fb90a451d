"""Standard errors, derived quantities, and what counts as determined."""

from __future__ import annotations

import numpy as np
import pytest

from services.fit.coordinates.domain import Coordinate, Domain
from services.fit.solve.covariance import uncertainty
from services.fit.solve.estimates import estimates
from services.fit.solve.normal_equations import NormalEquations
from services.transport.optics.parameters import Medium, Tissue
from tests.support.curvature import isotropic

TISSUE = Tissue(Medium(5.0, 0.995, g1=0.8), Medium(12.0, 0.99, g1=0.8))
DOMAIN = Domain((Coordinate(("enamel.sigma",)), Coordinate(("enamel.alpha",)), Coordinate(("enamel.g1",), 1.1, 0.35)))


def _equations(hessian: np.ndarray, noise: float = 0.0, monte_carlo: float = 0.0) -> NormalEquations:
    count = len(hessian)
    return NormalEquations(
        hessian, np.zeros(count), isotropic(count, noise**2), monte_carlo * hessian, hessian, 100.0, 100.0
    )


def test_well_posed_fit_has_the_inverse_curvature_as_covariance() -> None:
    h = np.array([[400.0, 50, 0], [50, 300, 0], [0, 0, 5000]])
    flat = Domain(tuple(Coordinate(c.targets) for c in DOMAIN.coordinates))
    known = uncertainty(flat, flat.x_of(TISSUE), _equations(h))
    np.testing.assert_allclose(known.covariance, np.linalg.inv(h), rtol=1e-8)
    known = uncertainty(flat, flat.x_of(TISSUE), _equations(h, monte_carlo=3.0))
    np.testing.assert_allclose(known.covariance, 4 * np.linalg.inv(h), rtol=1e-8)


def test_sigma_and_g_along_a_valley_are_flagged_but_the_reduced_scattering_is_not() -> None:
    # The data depend only on log sigma_s' = log sigma + log(1 - tanh x), whose gradient by (log sigma, kappa, x) is
    # (1, ~0, -(1 + g)).
    seen = np.array([1.0, 0.0, -1.8])
    h = 1e4 * np.outer(seen, seen) + np.diag([0.0, 1e4, 0.0])
    known = uncertainty(DOMAIN, DOMAIN.x_of(TISSUE), _equations(h))
    table = estimates(TISSUE, ("enamel",), known)
    assert not table["enamel.sigma"].determined
    assert not table["enamel.g1"].determined
    assert table["enamel.alpha"].determined
    reduced = table["enamel.sigma_s_reduced"]
    assert reduced.determined
    assert reduced.unit == "1/mm"
    assert reduced.se == pytest.approx(0.01 * reduced.value, rel=0.2)
    assert table["enamel.sigma"].se is not None
    assert table["enamel.sigma"].se > 10 * (reduced.se or 0)
    assert table["enamel.beta"].se is None
    assert not table["enamel.beta"].determined


def test_direction_below_its_noise_is_undetermined() -> None:
    h = np.diag([1e4, 1e4, 1e4])
    assert estimates(TISSUE, ("enamel",), uncertainty(DOMAIN, DOMAIN.x_of(TISSUE), _equations(h, noise=1e3)))[
        "enamel.sigma"
    ].determined
    assert not estimates(TISSUE, ("enamel",), uncertainty(DOMAIN, DOMAIN.x_of(TISSUE), _equations(h, noise=1e5)))[
        "enamel.sigma"
    ].determined


def test_indefinite_curvature_still_gives_finite_errors() -> None:
    rng = np.random.default_rng(1)
    for _ in range(200):
        root = rng.standard_normal((3, 3)) * 10.0 ** rng.uniform(-3, 3)
        h = root + root.T
        equations = NormalEquations(h, rng.standard_normal(3), isotropic(3, 1.0), root @ root.T, h, 1.0, 0.0)
        known = uncertainty(DOMAIN, DOMAIN.x_of(TISSUE), equations)
        assert all(
            e.se is None or (np.isfinite(e.se) and e.se >= 0) for e in estimates(TISSUE, ("enamel",), known).values()
        )


def test_misfit_widens_the_errors() -> None:
    h = np.diag([1e4, 1e4, 1e4])
    exact, poor = _equations(h), NormalEquations(h, np.zeros(3), isotropic(3, 0.0), np.zeros((3, 3)), h, 900.0, 100.0)
    flat = Domain(tuple(Coordinate(c.targets) for c in DOMAIN.coordinates))
    x = flat.x_of(TISSUE)
    np.testing.assert_allclose(
        uncertainty(flat, x, poor).covariance, 9 * uncertainty(flat, x, exact).covariance, rtol=1e-8
    )


def test_a_bound_is_never_determined() -> None:
    flat = Domain((Coordinate(("shape.0",)),))
    tissue = Tissue(TISSUE.enamel, TISSUE.dentin, (1.0,))
    known = uncertainty(flat, flat.x_of(tissue), _equations(np.array([[1e4]])))
    assert not estimates(tissue, ("shape",), known)["shape.0"].determined
