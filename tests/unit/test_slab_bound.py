"""The smallest error that a cell's images allow."""

from __future__ import annotations

import numpy as np
import pytest

from services.slab.cell.dictionary import henyey_greenstein
from services.slab.design.bound import Bound, bound_of
from services.slab.solve.uncertainty import slopes
from tests.support.small_slab import small_rig

MATERIAL = henyey_greenstein(1.2, 0.6, 0.05)


@pytest.fixture(scope="module")
def bounds() -> dict[float, Bound]:
    return {noise: bound_of(small_rig(), MATERIAL, noise=noise, paths=2000) for noise in (0.01, 0.1)}


def test_noise_that_is_ten_times_as_large_tells_less_but_not_less_than_the_prior(bounds: dict[float, Bound]) -> None:
    slope = slopes(MATERIAL)["sigma_s_reduced"]
    small, large = (bounds[noise].of(slope) for noise in (0.01, 0.1))
    # A bound grows at most in proportion to the noise, and less where a prior helps.
    assert 3 * small < large < 10.5 * small


def test_what_the_prior_moves_belongs_to_the_bound(bounds: dict[float, Bound]) -> None:
    bound = bounds[0.01]
    slope = slopes(MATERIAL)["g"]
    assert bound.of(slope) == pytest.approx(np.hypot(bound.uncertainty.standard_error(slope), slope @ bound.bias))
    # The logarithm of HG bends at the forward peak, which a smoothness prior flattens.
    assert (np.exp(bound.bias[:1]) < 1).all()


def test_variance_beside_the_shot_noise_widens_the_bound(bounds: dict[float, Bound]) -> None:
    rig = small_rig()
    more = bound_of(rig, MATERIAL, noise=0.01, variances=np.full(rig.shape, 1e-3), paths=2000)
    slope = slopes(MATERIAL)["sigma_s"]
    assert more.of(slope) > bounds[0.01].of(slope)


def test_the_phase_functions_bound_is_smallest_where_cameras_look(bounds: dict[float, Bound]) -> None:
    share = bounds[0.01].of_phase(MATERIAL) / MATERIAL.phase_per_sr
    # In the small cell's medium, cameras are at angles of about 2, 10, 150 and 170 degrees to beams; none looks across.
    assert share[5:15].max() < share[90:110].min()
