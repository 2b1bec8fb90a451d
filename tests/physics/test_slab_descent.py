"""The paper's solver: its projection, its gradient, and the reason why the two images of a product need independent
random streams.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from services.slab.cell.dictionary import KNOTS, henyey_greenstein, mixture
from services.slab.cell.forward import render
from services.slab.cell.single import single_scattering
from services.slab.read.images import Measurements
from services.slab.solve.projected_descent import DescentOptions, descend, image_weights, projected, weight_gradient
from tests.support.small_slab import small_rig


@pytest.mark.parametrize(
    ("point", "nearest"),
    [([0.1, 0.9, 0.4, -0.2], [0, 0.75, 0.25, 0]), ([1e8, 1e8 + 1, 0], [0, 1, 0]), ([0.2, 0.3, 0.5], [0.2, 0.3, 0.5])],
)
def test_points_are_projected_on_the_simplex(point: list[float], nearest: list[float]) -> None:
    np.testing.assert_allclose(projected(np.array(point)), nearest, atol=1e-12)


def test_weights_have_the_derivatives_of_their_mixtures() -> None:
    rig, material = small_rig(), henyey_greenstein(1.0, 0.5, 0.2)
    cotangent = np.random.default_rng(3).random(rig.shape)
    _, rows = single_scattering(rig, material, scores=True)
    gradient = weight_gradient(rows, material, cotangent)
    weights, small = material.weights(), 1e-8
    for atom in (5, 100, KNOTS):
        sides = []
        for sign in (1, -1):
            changed = weights + sign * small * (np.eye(KNOTS + 2)[atom] - np.eye(KNOTS + 2)[-1])
            sides.append(float((cotangent * single_scattering(rig, mixture(changed), scores=False)[0]).sum()))
        assert gradient[atom] == pytest.approx((sides[0] - sides[1]) / (2 * small), rel=1e-4)


@pytest.mark.dear("A bias of some percent shows only after many steps.")
def test_algorithm_1_as_printed_is_biased_and_independent_streams_are_not() -> None:
    """At the truth the gradient is zero, but the printed product of an image with a derivative from the same paths has
    their covariance as its mean.
    """
    rig = small_rig(pixels={"x_mm": [-4.0, 4.0], "y_mm": [-4.0, 4.0], "columns": 4, "rows": 4})
    material = henyey_greenstein(1.0, 0.5, 0.1)
    truth = render(rig, material, seed=1, step=0, batches=1, paths=400_000, scores=False).mean
    weights, count = image_weights(truth), 400
    batches = render(rig, material, seed=2, step=0, batches=count, paths=200, scores=True)

    def total(image: np.ndarray, rows: np.ndarray) -> float:
        # Project on the direction of more scattering with the same phase function.
        gradient = weight_gradient(rows, material, weights * (image - truth))
        return float(gradient @ np.append(material.weights()[:-1], 0.0))

    printed = np.array([total(*pair) for pair in zip(batches.images, batches.rows, strict=True)])
    ours = np.array([total(*pair) for pair in zip(batches.images, np.roll(batches.rows, 1, axis=0), strict=True)])
    z_printed, z_ours = (values.mean() / values.std(ddof=1) * math.sqrt(count) for values in (printed, ours))
    assert z_printed > 5
    assert abs(z_ours) < 4


def test_the_gradient_points_from_the_truth_to_where_one_is() -> None:
    rig = small_rig(pixels={"x_mm": [-4.0, 4.0], "y_mm": [-4.0, 4.0], "columns": 4, "rows": 4})
    truth, here = henyey_greenstein(1.0, 0.5, 0.1), henyey_greenstein(0.6, 0.3, 0.1)
    images = render(rig, truth, seed=1, step=0, batches=1, paths=50_000, scores=False).mean
    batches = render(rig, here, seed=2, step=0, batches=48, paths=500, scores=True)
    weights, away = image_weights(images), here.weights() - truth.weights()
    pairs = zip(batches.images, np.roll(batches.rows, 1, axis=0), strict=True)
    slopes = np.array([weight_gradient(rows, here, weights * (image - images)) @ away for image, rows in pairs])
    assert slopes.mean() > 4.5 * slopes.std(ddof=1) / math.sqrt(len(slopes))


def test_the_descent_stays_on_the_simplex_and_repeats() -> None:
    rig, start = small_rig(), henyey_greenstein(0.6, 0.3, 0.1)
    images = single_scattering(rig, henyey_greenstein(1.0, 0.5, 0.1), scores=False)[0]
    measured = Measurements(
        images, np.ones_like(images), np.zeros(len(images), dtype=bool), (("", ""),) * len(images), False
    )
    first, again = (
        descend(rig, measured, start, 1, DescentOptions(iterations=3, rate=1e-10, paths=50)) for _ in range(2)
    )
    np.testing.assert_array_equal(first.scattering, again.scattering)
    assert (first.weights() >= 0).all()
    assert first.weights().sum() == pytest.approx(1)
    assert (first.scattering != start.scattering).any()
