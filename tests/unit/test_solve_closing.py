"""A fit that uses other Jacobians than those of its images states correct errors once its response is measured."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
import pytest
from numpy.typing import NDArray

from services.fit.coordinates.domain import Coordinate, Domain
from services.fit.coordinates.instrument_errors import InstrumentErrors
from services.fit.solve.covariance import FinalModel, Uncertainty, Whitening, final_model, uncertainty, whitening
from services.fit.solve.curvature_noise import CurvatureNoise
from services.fit.solve.final_uncertainty import FinalSums, final_sums, response
from services.fit.solve.normal_equations import NormalEquations, normal_equations
from tests.support.z_scores import rms_bounds

ROUNDS, LIGHTS, PIXELS = 200, 4, 100
DOMAIN = Domain(tuple(Coordinate((name,)) for name in ("enamel.sigma", "dentin.sigma", "dentin.alpha")))
FLAT = np.zeros(3, dtype=bool)
SENSOR, IMAGE, SLOPE = 0.05, 0.05, 0.15
"""Standard deviations of noise: of a measurement, of a render and of a derivative."""


@lru_cache(maxsize=1)
def derivatives() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Similar and exact derivatives (3, M), and the derivative (M,) by what is held."""
    rng, count = np.random.default_rng(1), LIGHTS * PIXELS
    similar = 0.1 * rng.standard_normal((3, count)) + 0.1 * rng.standard_normal(count)
    mix = np.array([[1.5, 0.4, 0.0], [0.0, 0.8, 0.2], [0.0, 0.3, 0.7]])
    exact = mix @ similar + 0.03 * rng.standard_normal((3, count))
    return similar, exact, 0.02 * rng.standard_normal(count) + 0.1 * similar[0]


class Linear:
    """Images J x; the fit uses ``similar`` instead of J. Lights of a pixel share half of their noise."""

    def __init__(self, seed: int, held: bool = False) -> None:
        self.similar, self.exact, direction = derivatives()
        self.direction = held * direction
        self.rng = np.random.default_rng([seed, 2])
        self.weight = np.full(LIGHTS * PIXELS, 1 / SENSOR**2)
        self.truth = np.array([1.0, 2.0, 2.0])

    def noise(self, spread: float, *shape: int) -> np.ndarray:
        shared = np.tile(self.rng.standard_normal((*shape, PIXELS)), LIGHTS)
        return spread * np.sqrt(0.5) * (shared + self.rng.standard_normal((*shape, LIGHTS * PIXELS)))

    def photograph(self, offset: float) -> np.ndarray:
        return self.truth @ self.exact + offset * self.direction + SENSOR * self.rng.standard_normal(LIGHTS * PIXELS)

    def pair(self, mean: np.ndarray, spread: float) -> tuple[np.ndarray, np.ndarray]:
        return mean + self.noise(spread, *mean.shape[:-1]), mean + self.noise(spread, *mean.shape[:-1])

    def equations(self, x: np.ndarray, photo: np.ndarray) -> NormalEquations:
        j1, j2 = self.pair(self.similar, SLOPE)
        r1, r2 = self.pair(x @ self.exact - photo, IMAGE)
        return normal_equations(j1, j2, r1, r2, np.full(len(photo), SENSOR**2), self.weight, LIGHTS)

    def closing(self, x: np.ndarray, photo: np.ndarray, transform: np.ndarray) -> FinalSums:
        residuals = self.pair(x @ self.exact - photo, IMAGE)
        moved = np.array([self.pair(self.direction, IMAGE)])
        return final_sums(
            transform,
            self.pair(self.similar, SLOPE),
            self.pair(self.exact, SLOPE),
            FLAT,
            residuals,
            moved,
            self.weight,
            LIGHTS,
        )


def fitted(problem: Linear, *, measured: bool, offset: float) -> tuple[np.ndarray, Uncertainty]:
    # A Newton step with the curvature that ``similar`` gives, the equations moved there, then the final uncertainty
    # estimate.
    photo = problem.photograph(offset)
    start = problem.truth + 0.05
    equations = problem.equations(start, photo)
    step = -np.asarray(np.linalg.solve(equations.hessian, equations.gradient), dtype=np.float64)
    x, equations = start + step, equations.moved(step)
    if not measured:
        return x, uncertainty(DOMAIN, x, equations)
    sums = problem.closing(x, photo, whitening(DOMAIN, equations).transform)
    last = final_model(DOMAIN, x, equations, sums).step()
    return x + last, uncertainty(DOMAIN, x + last, equations, sums, last)


def rms(*, measured: bool, held: bool, rounds: int = ROUNDS) -> np.ndarray:
    rng, z = np.random.default_rng(7), []
    for seed in range(rounds):
        problem = Linear(seed, held)
        x, known = fitted(problem, measured=measured, offset=float(rng.standard_normal()) if held else 0.0)
        z.append((x - problem.truth) / np.sqrt(np.diag(known.covariance)))
    return np.sqrt(np.mean(np.square(z), axis=0))


@pytest.mark.parametrize("held", [False, True])
def test_stated_errors_are_those_seen_over_noise(held: bool) -> None:
    # The rule that tables use, an rms of 0.8 to 1.25: with correct errors, 200 values are outside it in fewer than one
    # of a thousand cases.
    low, high = rms_bounds(ROUNDS)
    found = rms(measured=True, held=held)
    assert (found > low).all(), found
    assert (found < high).all(), found


def model_and_loss(seed: int) -> tuple[FinalModel, np.ndarray, Callable[[np.ndarray], float]]:
    # Images are linear and ``similar`` is their own derivative, so the model's statements about x can be compared with
    # the loss itself.
    problem = Linear(seed)
    problem.similar = problem.exact
    photo, x = problem.photograph(0.0), problem.truth + 0.05
    equations = problem.equations(x, photo)
    model = final_model(DOMAIN, x, equations, problem.closing(x, photo, whitening(DOMAIN, equations).transform))
    return model, x, lambda at: 0.5 * float(problem.weight @ (at @ problem.exact - photo) ** 2)


def assert_standard(z: list[float]) -> None:
    # 200 problems: a mean beyond 4 of its standard errors happens by chance with a probability of 6e-5.
    low, high = rms_bounds(ROUNDS)
    assert abs(np.mean(z)) < 4 / np.sqrt(ROUNDS)
    assert low < np.sqrt(np.mean(np.square(z))) < high


def test_a_step_s_promise_and_its_slope_are_those_of_the_loss(monkeypatch: pytest.MonkeyPatch) -> None:
    # Derivatives have little noise here: its effect on the curvature is not in the stated error but in the margin of
    # the judgement. The slope is that along a step that does not depend on noise; the central difference of a quadratic
    # loss is exact.
    monkeypatch.setattr("tests.unit.test_solve_closing.SLOPE", 0.01)
    promises, slopes, along = [], [], np.full(3, -0.02)
    for seed in range(ROUNDS):
        model, x, loss = model_and_loss(seed)
        step = model.step()
        promised, se = model.predicted_change(step)
        promises.append((promised - (loss(x + step) - loss(x))) / se)
        difference = 0.5 * (loss(x + along) - loss(x - along))
        slopes.append((model.slope(along) - difference) / model.predicted_change(along)[1])
    assert_standard(promises)
    assert_standard(slopes)


def test_without_the_measurement_they_are_not() -> None:
    # The rms of 100 values is known to 7 %.
    assert rms(measured=False, held=True, rounds=100).max() > 1.5


def test_a_response_is_without_bias_and_its_stated_noise_is_what_is_seen() -> None:
    # Rendered rows and a borrowed one, mixed by T. Variances of 1000 draws are known to 4.5 % each, and the draws
    # themselves state them: 20 % is more than four times that. One of nine means is beyond 4 of its standard errors in
    # one case of 2000.
    copied, transform = np.array([False, False, True]), np.array([[1.0, 0.0, 0.3], [0.0, 0.8, -0.2], [0.1, 0.0, 1.2]])
    draws, count = [], 1000
    for seed in range(count):
        problem = Linear(seed)
        nothing = np.zeros((0, 2, LIGHTS * PIXELS))
        similar, exact = problem.pair(problem.similar, SLOPE), problem.pair(problem.exact, SLOPE)
        draws.append(
            final_sums(
                transform, similar, exact, copied, (np.zeros(400), np.zeros(400)), nothing, problem.weight, LIGHTS
            )
        )
    responses = np.array([draw.response for draw in draws])
    rows = np.where(copied[:, None], problem.similar, problem.exact)
    true = transform.T @ (problem.weight * problem.similar) @ rows.T @ transform
    assert np.abs((responses.mean(axis=0) - true) / (responses.std(axis=0) / np.sqrt(count))).max() < 4
    stated = np.mean([draw.response_variance for draw in draws], axis=0)
    np.testing.assert_allclose(stated, responses.var(axis=0), rtol=0.2)


def test_a_response_that_noise_explains_is_not_believed() -> None:
    rng = np.random.default_rng(3)
    noise = np.full((3, 3), 0.09)
    sums = FinalSums(
        np.zeros(3),
        np.eye(3),
        np.eye(3) + 0.1 * rng.standard_normal((3, 3)),
        noise,
        np.zeros((0, 3)),
        np.zeros((0, 3, 3)),
    )
    found = response(sums, np.zeros((3, 3)), DOMAIN.relation)
    np.testing.assert_allclose(found.inverse, np.eye(3))
    np.testing.assert_allclose(found.variance, 0.0)


def test_a_response_beyond_noise_is_taken_as_it_is() -> None:
    truth = np.array([[1.5, 0.4, 0.0], [0.0, 0.8, 0.2], [0.0, 0.3, 0.7]])
    sums = FinalSums(np.zeros(3), np.eye(3), truth, np.full((3, 3), 1e-8), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    np.testing.assert_allclose(
        response(sums, np.zeros((3, 3)), DOMAIN.relation).inverse, np.linalg.inv(truth), atol=1e-5
    )


def test_a_gain_moves_itself_and_not_the_tissue_although_derivatives_have_changed_on_the_way() -> None:
    # The solver's equations are those of derivatives of half the size, so the gain that they eliminate is half too
    # small. With a weak prior, photographs that are all brighter by 1 % move the gain by 1 % and the tissue by nothing.
    rng, weight = np.random.default_rng(4), np.full(100, 1e4)
    domain = Domain(DOMAIN.coordinates[:2], InstrumentErrors(("gain.green",), ((1.0,),)))
    tissue, image = rng.uniform(0.2, 1.0, (2, 100)), rng.uniform(0.5, 1.0, 100)
    before, exact = (np.stack([scale * tissue[0], tissue[1], image]) for scale in (0.5, 1.0))
    equations = normal_equations(before, before, 0 * image, 0 * image, 1 / weight, weight, exact=1)
    transform = whitening(domain, equations).transform
    brighter = np.broadcast_to(0.01 * image, (1, 2, 100))
    nothing, flat = (0 * image, 0 * image), np.zeros(3, dtype=bool)
    sums = final_sums(transform, (exact, exact), (exact, exact), flat, nothing, brighter, weight, 1, 1)
    inverse = response(sums, transform.T @ domain.precision @ transform, domain.relation, 1).inverse
    # The prior of 100 % is not quite nothing: 1 / (1e4 * 58) of the information on the gain alone.
    np.testing.assert_allclose(transform @ inverse @ sums.shifts[0], [0.0, 0.0, 0.01], atol=1e-6)


def test_a_response_that_is_smaller_than_its_noise_states_no_smaller_error() -> None:
    # The measured response of one photograph of a scanned shape, whose last column is noisy: its least singular value
    # is 0.28 at a noise level of 0.9. Errors of the solution are those of the gradient through the true response.
    truth = np.array([[1.1, 0.1, -0.7], [0.3, 1.5, -4.2], [0.3, 0.6, -0.9]])
    noise, curvature, rng = np.array([[0.02, 0.02, 0.25]] * 3), 400 * np.eye(3), np.random.default_rng(7)
    equations = NormalEquations(
        curvature, np.zeros(3), CurvatureNoise(()), np.zeros((3, 3)), curvature, squares=60.0, expected_squares=60.0
    )
    scores = []
    for _ in range(400):
        measured = truth + noise * rng.standard_normal((3, 3))
        sums = FinalSums(
            np.zeros(3), 1e-9 * np.eye(3), measured, noise**2, np.zeros((0, 3)), np.zeros((0, 3, 3))
        )  # fmt: skip
        errors = np.linalg.solve(truth, rng.standard_normal(3)) / 20
        scores.append(errors / np.sqrt(np.diag(uncertainty(DOMAIN, np.zeros(3), equations, sums).covariance)))
    # 400 draws leave an rms uncertain by 0.04. With the noise level in place of the response it is 1.7 to 1.8.
    rms = np.sqrt(np.mean(np.square(scores), axis=0))
    assert rms.max() < 1.2
    assert rms.min() > 0.85


def test_how_a_tooth_responds_is_not_hidden_by_teeth_that_do_not() -> None:
    # Twelve teeth of two coordinates; each tooth responds differently, only with its own coordinates. The noise is 0.1,
    # and 0.03 between teeth.
    rng = np.random.default_rng(5)
    domain = Domain(tuple(Coordinate((f"{k}.enamel.{leaf}",)) for k in range(12) for leaf in ("sigma", "alpha")))
    own = domain.relation == 0
    noise = np.where(own, 0.1, 0.03)
    excess = np.where(own, 0.3 * rng.standard_normal(own.shape), 0.0)
    measured = np.eye(24) + excess + noise * rng.standard_normal(own.shape)
    sums = FinalSums(np.zeros(24), np.eye(24), measured, noise**2, np.zeros((0, 24)), np.zeros((0, 24, 24)))
    told, alike = (
        response(sums, np.zeros((24, 24)), relation).excess
        for relation in (domain.relation, np.zeros_like(domain.relation))
    )
    # Shrinking by 0.3^2 / (0.3^2 + 0.1^2) gives an rms error of 0.095; with one scatter for all entries, the teeth's
    # own entries would shrink by more than half.
    assert np.sqrt(np.mean((told - excess)[own] ** 2)) < 0.12
    assert np.sqrt(np.mean((alike - excess)[own] ** 2)) > 0.15
    assert np.abs(told[~own]).max() < 0.03


def shifted(shift: NDArray[np.float64], noise: NDArray[np.float64]) -> FinalSums:
    """Sums with one shift (F,) and its noise (F, F)."""
    none = np.zeros_like(noise)
    return FinalSums(np.zeros(len(shift)), none, none, none, shift[None], noise[None])


def test_a_shift_without_noise_is_taken_as_it_is_and_one_within_its_noise_is_not() -> None:
    shift = np.array([1.0, 0.5, -0.2])
    sums = shifted(shift, np.zeros((3, 3)))
    stated = [sums.shift_covariance([0], is_combined=is_combined) for is_combined in (False, True)]
    for covariance in (*stated, sums.expected_shift_covariance([0])):
        np.testing.assert_allclose(covariance, np.outer(shift, shift), atol=1e-12)
    sums = shifted(shift, np.eye(3))
    np.testing.assert_array_equal(sums.expected_shift_covariance([0]), np.zeros((3, 3)))
    assert np.trace(sums.shift_covariance([0], is_combined=False)) == pytest.approx(shift @ shift - 1)


def test_a_shift_that_is_noisy_in_most_directions_is_stated_whole_where_it_is_well_known() -> None:
    # Along the first coordinate the square is known to 0.4 on average; the other five have noise as large as the shift.
    # Shortened as a whole by 1 - tr N / |b|^2, the shift would have 0.6 of its square there.
    rng, true, noise = np.random.default_rng(9), np.array([2.0, 1.0, 1.0, 1.0, 1.0, 1.0]), np.array([0.1, *5 * [1.0]])
    stated = []
    for _ in range(2000):
        sums = shifted(true + noise * rng.standard_normal(6), np.diag(noise**2))
        stated.append(float(sums.shift_covariance([0], is_combined=False)[0, 0]))
    assert np.mean(stated) == pytest.approx(true[0] ** 2, rel=0.1)


def test_noise_of_a_shift_does_not_pass_for_a_direction_that_can_be_avoided() -> None:
    # True shifts of any direction in six coordinates, measured with noise of variance 1 each. Of all combinations with
    # v_0 = 1, take the one that the expected covariance C takes for the least moved, v = C^-1 e_0 / e_0'C^-1 e_0.
    rng, first, noise = np.random.default_rng(8), np.eye(6)[0], np.eye(6)
    expected, stated, unbiased, shown = [], [], [], []
    for _ in range(1000):
        true = 1.5 * rng.standard_normal(6)
        sums = shifted(true + rng.standard_normal(6), noise)
        covariance = sums.expected_shift_covariance([0])
        best = np.linalg.solve(covariance + 1e-2 * noise, first)
        best /= best[0]
        expected.append(float(best @ covariance @ best))
        stated.append(float(best @ sums.shift_covariance([0], is_combined=True) @ best))
        unbiased.append(float(best @ sums.shift_covariance([0], is_combined=False) @ best))
        shown.append(float(best @ true) ** 2)
    # The prior of the true shifts is estimated from one of them, with an error of (2 / 6)^1/2 in |b|^2; ratios of means
    # of 1000 draws scatter by 7 %. With k b b', which has the same trace, 0.0001 are expected.
    assert np.mean(shown) == pytest.approx(np.mean(expected), rel=0.3)
    # The combination avoids b, so what is stated without regard to it is far below what is shown.
    assert np.mean(stated) == pytest.approx(np.mean(shown), rel=0.3)
    assert np.mean(unbiased) < 0.3 * np.mean(shown)


def test_the_measurement_survives_the_journal() -> None:
    problem = Linear(1)
    sums = problem.closing(problem.truth, problem.photograph(0.0), np.eye(3))
    assert FinalSums.of(sums.record()).record() == sums.record()
    assert (sums + sums).response == pytest.approx(2 * sums.response)


def test_errors_follow_the_step_that_the_tissue_takes_and_not_the_one_it_asked_for() -> None:
    # The tissue's step is longer than one scale, which is not allowed; the errors found are best for the step taken.
    rng, errors = np.random.default_rng(8), InstrumentErrors(("gain.green",), ((1e-2,),))
    domain = Domain(DOMAIN.coordinates, errors)
    root = rng.standard_normal((4, 4))
    transform = np.tril(rng.uniform(0.2, 1.0, (4, 4)))
    transform[:3, :3] = np.diag([0.5, 0.7, 0.9])
    known = Whitening(transform, np.zeros((4, 0)))
    gradient = np.array([9.0, -7.0, 5.0, 3.0])
    model = FinalModel(
        domain, np.array([1.0, 2.0, 2.0, 0.0]), known, np.eye(4) + 0.1 * root, gradient, np.zeros((4, 4))
    )
    step = model.step()
    whole = -transform @ model.inverse @ gradient
    assert np.linalg.norm(step[:3] / domain.scale[:3]) < 0.5 * np.linalg.norm(whole[:3] / domain.scale[:3])
    for change in (-1e-3, 1e-3):
        assert model.predicted_change(step + np.array([0.0, 0.0, 0.0, change]))[0] > model.predicted_change(step)[0]


def test_a_prior_used_in_full_takes_the_tissue_back_along_a_direction_that_images_leave_open() -> None:
    # A gain of -10 % and a tissue that is 0.1 brighter make nearly the same images, so with noisy derivatives that
    # direction is not determined. The prior of 1 % takes both back together. The rest of the step, 0.05 of another
    # coordinate, counts as error; it would keep the tissue in place if the gain moved as if every direction were
    # determined.
    domain, count, sensor, opened = (
        Domain(DOMAIN.coordinates, InstrumentErrors(("gain.green",), ((1e-4,),))),
        400,
        0.01,
        0,
    )
    for seed in range(10):
        rng = np.random.default_rng([11, seed])
        gain = rng.uniform(0.5, 1.0, count)
        exact = np.stack([gain, *0.1 * rng.standard_normal((2, count)), gain])
        exact[0] += 0.01 * rng.standard_normal(count)
        residual = np.array([0.3, 0.05, 0.0, -0.1]) @ exact - sensor * rng.standard_normal(count)
        noise = [np.append(0.15 * rng.standard_normal((3, count)), np.zeros((1, count)), axis=0) for _ in range(2)]
        r1, r2 = (residual + 0.05 * rng.standard_normal(count) for _ in range(2))
        weight = np.full(count, sensor**-2)
        equations = normal_equations(exact + noise[0], exact + noise[1], r1, r2, 1 / weight, weight, exact=1)
        x = np.array([1.0, 2.0, 2.0, -0.1])
        known = uncertainty(domain, x, equations)
        if known.undetermined_directions.shape[1]:
            opened += 1
            assert known.x[3] - x[3] == pytest.approx(0.1, abs=0.01)
            # To a tenth; with the gain of the whole step it would be 0.05 to 0.09.
            assert known.x[0] - x[0] == pytest.approx(-0.1, abs=0.01)
    assert opened >= 5


def test_an_answer_that_its_prior_would_take_too_far_goes_one_scale_and_states_the_rest_as_error() -> None:
    # The tissue follows the gain one to one, and with the noise of the renders only the gain's prior determines both.
    domain = Domain(DOMAIN.coordinates[:1], InstrumentErrors(("gain.green",), ((1e-6,),)))
    scale, rows, weight = float(domain.scale[0]), np.stack(2 * [np.linspace(0.5, 1.0, 50)]), np.full(50, 1e4)
    noise = 30 * np.cos(np.arange(50))
    equations = normal_equations(rows, rows, noise, -noise, 1 / weight, weight, exact=1)
    # In a jaw of four teeth, each tooth may move by one scale, which is two in their common norm.
    for off, part_count, moved, rest in ((0.5, 1, 0.5, 0.0), (3.0, 1, 1.0, 2.0), (3.0, 4, 2.0, 1.0)):
        x = np.array([1.0, -off * scale])
        known = uncertainty(domain, x, equations, part_count=part_count)
        np.testing.assert_allclose((known.x - x) / scale, [-moved, moved], rtol=1e-6)
        assert known.is_full_step is (rest == 0)
        parts = known.se_parts(np.array([1.0, 0.0]))
        assert parts.get("unfinished", 0.0) == pytest.approx(rest * scale, rel=1e-6)
        assert known.covariance[0, 0] == pytest.approx(sum(part**2 for part in parts.values()), rel=1e-9)
