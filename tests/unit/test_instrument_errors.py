"""The instrument's errors as unknowns of the fit: what a calibration states about them, their columns, and the
covariance of the tissue with them.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.core.calibration.record import require_consistent
from services.core.calibration.uncertainty import CalibrationUncertainty
from services.core.errors import CaptureInputError
from services.core.geometry import Light
from services.core.records import FolderCapture, JobSpec
from services.core.store import read_record
from services.fit.checks.instrument.sentences import REMEDY, assumed_names, instrument_sentences
from services.fit.checks.next_calibration import calibration_advice, covariance_if_known
from services.fit.coordinates.domain import Coordinate, Domain
from services.fit.coordinates.instrument_errors import (
    COMMON_KINDS,
    DEFAULT_SE,
    InstrumentErrors,
    errors_of,
    have_common_cause,
)
from services.fit.measurements.blocks import BlockInstrument, PixelBlock, read_block, write_block
from services.fit.measurements.instrument.moves import move_covariance, write_moves
from services.fit.measurements.instrument.photographs import error_derivatives, photographed
from services.fit.passes.moves import by_scene
from services.fit.solve.covariance import _prior_parts, uncertainty
from services.fit.solve.curvature_noise import CurvatureNoise, curvature_noise
from services.fit.solve.elimination import eliminate
from services.fit.solve.estimates import estimates, instrument_estimates
from services.fit.solve.normal_equations import normal_equations
from services.fit.solve.recombination import Fault
from services.transport.optics.parameters import Medium, Tissue
from services.transport.scene.recipe import View, single_tooth
from services.transport.scene.recipe_files import read_recipe
from services.transport.scene.rigid_moves import rigid
from tests.support.prepared import camera, sphere

NAMES = ("gain.green", "light_gain.a", "light_gain.b", "flare.c0.green")
ERRORS = InstrumentErrors(NAMES, tuple(map(tuple, np.diag([1e-4, 1e-4, 4e-4, 9e-6]).tolist())))
DOMAIN = Domain((Coordinate(("enamel.sigma",)), Coordinate(("enamel.alpha",), 3.0, 2.0)), ERRORS)
TISSUE = Tissue(Medium(4.0, 0.999, g1=0.8), Medium(4.0, 0.999, g1=0.8))


def block(random: np.random.Generator) -> PixelBlock:
    shape = (2, 5)
    image = random.uniform(0.2, 1.0, shape)
    view = View(camera("c0"), np.stack([np.arange(5), np.arange(5)], axis=-1).astype(np.int32))
    acting = BlockInstrument("gain.green", ("light_gain.a", "light_gain.b"), "flare.c0.green", 1.3)
    return PixelBlock(view, image, np.full(shape, 1e-4), np.ones(shape), np.zeros(shape, dtype=bool), instrument=acting)


def test_columns_are_the_derivatives_of_what_the_instrument_takes() -> None:
    random = np.random.default_rng(1)
    whole, image, at = (
        block(random),
        random.uniform(0.2, 1.0, (2, 5)),
        dict(zip(NAMES, (0.01, -0.02, 0.03, 0.004), strict=True)),
    )
    for name, column in zip(NAMES, error_derivatives(image, whole, NAMES), strict=True):
        high, low = (photographed(image, whole, at | {name: at[name] + step}) for step in (1e-3, -1e-3))
        # Exactly linear, so equal except for rounding.
        np.testing.assert_allclose((high - low).reshape(-1) / 2e-3, column, rtol=1e-9, atol=1e-12)
    gains = np.array([[1.0 + 0.01 - 0.02], [1.0 + 0.01 + 0.03]])
    np.testing.assert_allclose(photographed(image, whole, at), gains * image + 0.004 * 1.3, rtol=1e-12)
    assert not error_derivatives(image, whole, ("gain.red", "flare.c1.green")).any()


def test_a_gain_is_not_pulled_by_noise_of_photographs_or_renders() -> None:
    # The slope by a gain at the truth, over many draws of both kinds of noise, in its standard errors: either kind
    # alone would shift it by sqrt(M) of the photographs'.
    random, image, found = np.random.default_rng(2), np.full(400, 0.7), []
    for _ in range(200):
        photograph = image + 0.01 * random.standard_normal(400)
        renders = [image + 0.05 * random.standard_normal(400) for _ in range(2)]
        j1, j2 = (np.stack([random.standard_normal(400), render]) for render in renders)
        r1, r2 = (render - photograph for render in renders)
        one = normal_equations(j1, j2, r1, r2, np.full(400, 1e-4), np.full(400, 1e4), exact=1)
        found.append((one.gradient[1], np.sqrt(one.gradient_noise[1, 1] + one.data_noise[1, 1])))
    slopes, errors = np.array(found).T
    # Means and spreads of 200: 4 standard errors.
    assert abs(slopes.mean()) < 4 * slopes.std() / np.sqrt(200)
    assert abs(slopes.std() / np.sqrt(np.mean(errors**2)) - 1) < 4 / np.sqrt(2 * 200)


def test_a_block_keeps_which_errors_act_on_it(tmp_path: Path) -> None:
    whole = block(np.random.default_rng(3))
    assert read_block(write_block(tmp_path, whole)).instrument == whole.instrument


def test_the_calibration_joins_with_the_defaults() -> None:
    stated = CalibrationUncertainty(
        names=("light_gain.b.green", "gain.green", "gain.red"),
        covariance=((4e-4, 1e-5, 0.0), (1e-5, 1e-4, 0.0), (0.0, 0.0, 1e-4)),
    )
    found = errors_of("green", ("a", "b"), ("c0",), stated)
    assert found.names == ("gain.green", "light_gain.a", "light_gain.b.green", "flare.c0.green")
    gain, light, flare = (DEFAULT_SE[kind] ** 2 for kind in ("gain", "light_gain", "flare"))
    expected = np.diag([gain, light, 4e-4, flare])
    expected[0, 2] = expected[2, 0] = 1e-5
    np.testing.assert_allclose(found.matrix, expected)
    assert found.assumed == {"light_gain.a", "flare.c0.green"}


@pytest.mark.parametrize(
    ("names", "covariance", "told"),
    [
        (["gain.green"], [[0.0]], "variance of gain.green is not positive"),
        (["gain.green", "flare.c0.green"], [[1e-4]], "1 rows of 1 numbers for 2 names"),
        (["gain.green", "flare.c0.green"], [[1e-4, 0.0]], "1 rows of 2 numbers for 2 names"),
        (["gain.green", "flare.c0.green"], [[1e-4, 2e-4], [2e-4, 1e-4]], "not positive definite"),
        (["gain.green", "flare.c0.green"], [[1e-4, 1e-5], [0.0, 1e-4]], "not symmetric"),
        (["gain.green", "gain.green"], [[1e-4, 0.0], [0.0, 1e-4]], "gain.green is named twice"),
        (["teeth.rx"], [[1.0]], "in radians, not in degrees"),
        (["gain.violet"], [[1e-4]], "uncertainty names gain.violet, which is no error"),
        (["gain.green"], [[float("nan")]], "finite number"),
    ],
)
def test_a_wrong_uncertainty_is_told_in_one_sentence(
    tmp_path: Path, names: list[str], covariance: list[list[float]], told: str
) -> None:
    light = Light(name="a", position_mm=(0.0, 0.0, 500.0), intensity=(1e6,))
    capture = FolderCapture(units="mm", channels=("green",), cameras=(camera("c0"),), lights=(light,))
    content = capture.model_dump(mode="json") | {"uncertainty": {"names": names, "covariance": covariance}}
    (tmp_path / "capture.json").write_text(json.dumps(content))
    with pytest.raises(CaptureInputError, match=told):
        require_consistent(read_record(tmp_path / "capture.json", FolderCapture), "capture.json")


def equations(random: np.random.Generator, noise: float = 0.0, count: int = 40) -> Any:
    truth = random.standard_normal((2, count))
    known = random.standard_normal((4, count))
    j1, j2 = (np.concatenate([truth + noise * random.standard_normal(truth.shape), known]) for _ in range(2))
    r1, r2 = np.zeros((2, count))
    return normal_equations(j1, j2, r1, r2, np.full(count, 1e-2), np.full(count, 1e2), exact=4)


def test_what_is_left_to_the_tissue_is_the_marginal_of_the_whole() -> None:
    found = equations(np.random.default_rng(4))
    marginal = np.linalg.inv(found.hessian + DOMAIN.precision)[:2, :2]
    left = eliminate(found, DOMAIN.precision, np.zeros(6), 2)
    np.testing.assert_allclose(np.linalg.inv(left.hessian), marginal, rtol=1e-9)
    # Weights are inverse variances, so the sandwich is the inverse of the curvature, and its parts add up.
    known = uncertainty(DOMAIN, DOMAIN.x_of(TISSUE), found)
    np.testing.assert_allclose(known.covariance[:2, :2], marginal, rtol=1e-6)
    np.testing.assert_allclose(sum(known.parts.values()), known.covariance, rtol=1e-6, atol=1e-12)
    table = estimates(TISSUE, ("enamel",), known)
    for one in (table["enamel.sigma"], table["enamel.sigma_a"], *instrument_estimates(known).values()):
        assert one.se is not None
        assert {"photographs", "gain", "light_gain", "flare"} <= one.se_parts.keys()
        assert sum(part**2 for part in one.se_parts.values()) == pytest.approx(one.se**2, rel=1e-6)


def test_exact_derivatives_have_the_noise_of_any_that_agree() -> None:
    random = np.random.default_rng(5)
    mean, difference, weight = (
        random.standard_normal((5, 12)),
        random.standard_normal((5, 12)),
        random.uniform(1, 2, 12),
    )
    difference[3:] = 0.0
    whole = CurvatureNoise((curvature_noise(mean, difference, weight, range(5), 2),))
    parted = CurvatureNoise((curvature_noise(mean, difference, weight, range(3), 2, range(3, 5)),))
    directions, vector = random.standard_normal((5, 7)), random.standard_normal(5)
    np.testing.assert_allclose(parted.variance(directions), whole.variance(directions), rtol=1e-12)
    np.testing.assert_allclose(parted.of_product(vector), whole.of_product(vector), rtol=1e-12, atol=1e-12)
    again = CurvatureNoise.of(json.loads(json.dumps((parted + parted.scaled(2.0)).record())))
    np.testing.assert_allclose(again.variance(directions), 3 * whole.variance(directions), rtol=1e-12)


def test_what_noise_squares_to_in_the_elimination_is_known() -> None:
    # The mean of two derivatives of unit noise has half its variance, so sum_kl S^-1_kl Cov(A_ak, A_al) is half of
    # sum_kl S^-1_kl sum_i w^2 b_k b_l.
    found = []
    for seed in range(100):
        one = equations(np.random.default_rng([6, seed]), noise=1.0)
        known, inverse = one.hessian[2:, 2:], np.linalg.inv(one.hessian[2:, 2:] + ERRORS.precision)
        expected = 0.5 * 1e2 * float((inverse * known).sum())
        found.append(one.hessian_noise.of_eliminated(inverse, 2) / expected)
    # One such estimate rests on 40 squares of noise: 4 standard errors of the mean of 100.
    error = np.std(found, axis=0) / np.sqrt(len(found))
    assert (np.abs(np.mean(found, axis=0) - np.eye(2)) < 4 * error).all()
    assert (error < 0.05).all()


def test_the_prior_of_the_errors_joins_slope_and_change() -> None:
    x = np.array([0.3, 2.0, 0.01, -0.02, 0.01, 0.001])
    shifts = 1e-4 * np.eye(6)
    slope = [(DOMAIN.prior_change(x, x + s) - DOMAIN.prior_change(x, x - s)) / 2e-4 for s in shifts]
    np.testing.assert_allclose(DOMAIN.prior_slope(x), slope, rtol=1e-6, atol=1e-8)
    assert DOMAIN.errors_at(x) == tuple(zip(NAMES, x[2:].tolist(), strict=True))
    np.testing.assert_allclose(DOMAIN.x_of(TISSUE, dict(DOMAIN.errors_at(x)))[2:], x[2:])


def test_says_what_was_assumed_and_which_calibration_is_at_fault() -> None:
    spec = JobSpec.model_validate({"capture": "c"})
    errors = {"green": errors_of("green", ("a", "b"), ("c0",), None)}
    kinds = assumed_names(errors, ("teeth", "dome"))
    assert kinds == (*errors["green"].names, "teeth", "dome")
    (assumed,) = instrument_sentences(spec, errors, {}, kinds)
    assert assumed.startswith("Assumed, as the calibration does not state")
    assert "1 % for the gain, 1 % for each light, 0.3 % for flare, 0.05 mm and 0.1° for where the scan lies" in assumed
    _, fault = instrument_sentences(spec, errors, {"green": (Fault(2, -0.05, -4.2),)}, kinds)
    assert fault.startswith(
        "In green the images put light_gain.b off by -5.0 %, 4.2 times what their own error and its standard error of 1"
        " %"
    )
    assert "check that light, its cable and its name" in fault
    assert set(REMEDY) == set(COMMON_KINDS[0])
    assert "Images hardly show a gain that is farther off" in assumed
    off = spec.model_copy(update={"instrument": "off"})
    assert instrument_sentences(off, {"green": InstrumentErrors()}, {}, ())[0].startswith(
        "The standard errors take the instrument for perfect"
    )


def test_many_lights_off_at_once_are_told_as_one_cause() -> None:
    spec, lights = JobSpec.model_validate({"capture": "c"}), tuple("abcdefgh")
    errors = {"green": errors_of("green", lights, ("c0",), None)}
    two, three = (tuple(Fault(k, -0.01 * k, -3.0 - k) for k in range(1, count)) for count in (3, 4))
    # Three of nine are more than a quarter.
    assert len(instrument_sentences(spec, errors, {"green": two}, ())) == 2
    (told,) = instrument_sentences(spec, errors, {"green": three}, ())
    assert told.startswith(
        "In green the images put 3 gains of lights and flares off, most of all light_gain.c by -3.0 %"
    )
    assert "rendered with surroundings = 'on'" in told
    (told,) = instrument_sentences(spec, errors, {"green": three}, (), is_alone=False)
    assert "surroundings" not in told
    assert have_common_cause(3, errors["green"].names)
    assert not have_common_cause(2, errors["green"].names)
    # A jaw under many lights has flares alone, of which one may be a fault.
    assert not have_common_cause(1, ("gain.green", "flare.c0.green"))


def test_an_error_that_the_calibration_states_is_not_told_as_assumed() -> None:
    stated = CalibrationUncertainty(names=("gain.green", "light_gain.b"), covariance=((1e-4, 0.0), (0.0, 1e-4)))
    errors = {"green": errors_of("green", ("a", "b"), ("c0",), stated)}
    # No move was measured, so the assumptions about moves are not in any ±.
    names = assumed_names(errors, ())
    assert names == ("light_gain.a", "flare.c0.green")
    (told,) = instrument_sentences(JobSpec.model_validate({"capture": "c"}), errors, {}, names, stated)
    assert "may be: 1 % for light_gain.a and 0.3 % for flare. The standard errors" in told


def test_a_move_of_the_teeth_is_one_of_cameras_and_lights_the_other_way(tmp_path: Path) -> None:
    ball, lights = sphere(4.0), np.array([[100.0, 300.0, -700.0], [-200.0, 100.0, -600.0]])
    recipe = single_tooth(ball, None, lights, np.array([1.0, 2.0]))
    covariance, assumed = move_covariance(None, ())
    assert assumed == ("teeth", "dome")
    moves = write_moves(tmp_path, recipe, covariance, lights.mean(axis=0))
    assert sorted(move.body for move in moves) == ["dome"] * 6 + ["teeth"] * 6
    assert len(by_scene(moves)) == 1
    stored = read_recipe(moves[0].recipe)
    np.testing.assert_allclose(stored.light_positions_mm[:2], lights)
    points, twist = ball.vertices_mm[:5], np.zeros(6)
    for move in moves:
        moved = stored.light_positions_mm[move.first : move.first + 2]
        seen, depth = move.moved_camera(camera("c0")).project(points)
        if move.body == "dome":
            np.testing.assert_allclose(seen, camera("c0").project(points)[0], atol=1e-9)
            continue
        # The moved tooth's points must appear at the same pixels and be at the same distances from the lights.
        back = np.array(move.camera_move)
        there = points @ back[:3, :3].T + back[:3, 3]
        np.testing.assert_allclose(seen, camera("c0").project(there)[0], atol=1e-9)
        away, expected = (np.linalg.norm(a[:, None] - b, axis=2) for a, b in ((points, moved), (there, lights)))
        np.testing.assert_allclose(away, expected, rtol=1e-12)
        assert (depth > 0).all()
    twist[3] = 2 * 0.05
    assert any(
        np.allclose(move.camera_move, rigid(sign * twist, np.zeros(3)), atol=1e-6) for move in moves for sign in (1, -1)
    )
    stated = CalibrationUncertainty(names=("dome.tx",), covariance=((0.25,),))
    assert move_covariance(stated, ())[0][9, 9] == 0.25


def test_knowing_an_error_better_beforehand_is_worth_what_a_fit_with_that_prior_would_say() -> None:
    found = equations(np.random.default_rng(8))
    known = uncertainty(DOMAIN, DOMAIN.x_of(TISSUE), found)
    better = np.diag([0.25e-4, 1e-4, 4e-4, 9e-6])
    errors = InstrumentErrors(NAMES, tuple(map(tuple, better.tolist())))
    domain = Domain(DOMAIN.coordinates, errors)
    expected = uncertainty(domain, domain.x_of(TISSUE), found).covariance
    np.testing.assert_allclose(covariance_if_known(known, "gain"), expected, rtol=1e-6, atol=1e-15)
    # A better calibration does not shorten the distance to the minimum where a fit ended early.
    left = replace(known, parts={**known.parts, "unfinished": np.eye(6)})
    np.testing.assert_allclose(covariance_if_known(left, "gain"), expected + np.eye(6), rtol=1e-6, atol=1e-15)


def test_says_which_measurement_of_the_instrument_would_help_most() -> None:
    # Only the gain limits how well this one measurement gives the extinction: half the gain's ± halves every ±.
    extinction, gain = Coordinate(("enamel.sigma",)), InstrumentErrors(("gain.green",), ((1e-4,),))
    for errors, expected in (
        (gain, "Measuring the gain to 0.5 % would cut the error of enamel scattering from 10 % to 5.0 %."),
        (InstrumentErrors(), ""),
    ):
        domain, row = Domain((extinction,), errors), np.array([[0.1], [1.0]])[: 1 + len(errors.names)]
        measured = np.zeros(1), np.zeros(1), np.array([1e-10]), np.array([1e10])
        found = normal_equations(row, row, *measured, exact=len(errors.names))
        known = uncertainty(domain, domain.x_of(TISSUE), found)
        assert calibration_advice(TISSUE, ("enamel",), known) == expected


TOGETHER = np.diag([1e-4, 1e-4, 4e-4, 9e-6])
TOGETHER[0, 1] = TOGETHER[1, 0] = 0.9e-4
CORRELATED = Domain(DOMAIN.coordinates, InstrumentErrors(NAMES, tuple(map(tuple, TOGETHER.tolist()))))


def test_parts_of_the_prior_add_up_where_kinds_go_together() -> None:
    t = np.random.default_rng(5).standard_normal((6, 3))
    parts = _prior_parts(CORRELATED, t)
    assert set(parts) == {"prior", "gain", "light_gain", "flare"}
    np.testing.assert_allclose(sum(parts.values()), t.T @ CORRELATED.precision @ t, rtol=1e-9)
    for part in parts.values():
        assert np.linalg.eigvalsh(part).min() > -1e-6 * np.abs(part).max(), "a part of a variance is negative"


def test_a_gain_that_goes_with_a_light_is_known_twice_as_well_when_it_is_said_so() -> None:
    # The photographs have no weight: only the prior determines the gain, and it is divided as stated.
    random, count = np.random.default_rng(9), 6
    j1, j2 = (random.standard_normal((count, 20)) for _ in range(2))
    found = normal_equations(j1, j2, np.zeros(20), np.zeros(20), np.full(20, 1e6), np.full(20, 1e-12), exact=4)
    known = uncertainty(CORRELATED, CORRELATED.x_of(TISSUE), found)
    gain = CORRELATED.tissue_count
    assert known.covariance[gain, gain] == pytest.approx(1e-4, rel=1e-3)
    assert covariance_if_known(known, "gain")[gain, gain] == pytest.approx(0.25e-4, rel=1e-3)


def test_an_uncertainty_that_no_fit_uses_is_told() -> None:
    stated = CalibrationUncertainty(names=("camera.c0.rx", "light.a.x"), covariance=((1e-6, 0.0), (0.0, 1.0)))
    told = instrument_sentences(JobSpec(capture=Path("/mouth")), {"green": ERRORS}, {}, (), stated)
    assert told == (
        (
            "The calibration states how wrong camera.c0.rx and 1 more may be. No fit moves single cameras and lights:"
            " of these errors the standard errors know at most the lights' distances, which count in their gains, and"
            " what moves all lights as one."
        ),
    )
