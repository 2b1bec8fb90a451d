"""The advised light or view lowers the errors as predicted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from services.anatomy.dentin_shape import DentinShape
from services.core.geometry import Camera
from services.fit.checks.next_capture import (
    LIGHTS,
    VIEWS,
    Candidate,
    Sensor,
    capture_advice,
    probes_of,
    rotated_camera,
    sentence,
)
from services.fit.coordinates.media import media_domain
from services.fit.measurements.blocks import BlockInstrument, PixelBlock, read_block, write_block
from services.fit.passes.passes import Passes, StackProblem
from services.fit.solve.covariance import Uncertainty, uncertainty
from services.fit.solve.estimates import estimates
from services.fit.solve.information import AddedInformation, covariance_with
from services.tasks.engine_host import InProcessHost
from services.tasks.executors import LocalExecutor
from services.tasks.seeds import Seeds
from services.transport.optics.parameters import Tissue
from services.transport.scene.recipe import SceneRecipe, View, single_tooth
from services.transport.scene.recipe_files import read_recipe, write_recipe
from tests.support.fake_engine import FakeEngine
from tests.support.prepared import FAKE, SIZE, TRUTH, camera, sphere

SAMPLES = 16384
SENSOR = Sensor(0.01, 0.002)
WEIGHT = 1e4
PARTS = ("enamel", "dentin")
DOMAIN = media_domain(PARTS, ("sigma", "alpha"))
PIXELS = np.stack([i.reshape(-1) for i in np.mgrid[: SIZE[0], 2 : SIZE[1]]], axis=-1).astype(np.int32)[::2]


def scene(*positions_mm: tuple[float, float, float]) -> SceneRecipe:
    dentin = DentinShape(sphere(3.0), np.zeros((0, 1, 3)))
    return single_tooth(sphere(4.0), dentin, np.array(positions_mm), np.full(len(positions_mm), 1e6))


def problem_of(folder: Path, recipe: SceneRecipe) -> StackProblem[Tissue]:
    view = View(camera("c0"), PIXELS)
    reference = FakeEngine(recipe)._formula(TRUTH, view)
    block = PixelBlock(
        view,
        reference,
        SENSOR.variance(reference),
        np.full(reference.shape, WEIGHT),
        np.zeros(reference.shape, dtype=bool),
    )
    executor = LocalExecutor(InProcessHost(FAKE))
    passes = Passes(
        executor, (write_block(folder, block),), write_recipe(folder, recipe), Seeds(1, "green"), lambda _: None
    )
    return StackProblem(passes, DOMAIN, TRUTH, "final", jacobian_g=0.0)


def known_of(problem: StackProblem[Tissue]) -> Uncertainty:
    # Linearise at the truth, where the step to the minimum is only noise, which is not part of a prediction.
    x = DOMAIN.x_of(TRUTH)
    known = uncertainty(DOMAIN, x, problem.linearise(x, samples=SAMPLES, step=0))
    assert known.sandwich is not None
    return replace(known, covariance=known.sandwich.covariance)


@pytest.fixture(scope="module")
def few_lights(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[StackProblem[Tissue], Uncertainty, str, tuple[Candidate, ...], Path]:
    folder = tmp_path_factory.mktemp("few")
    problem = problem_of(folder, scene((-300.0, 300.0, -700.0)))
    known = known_of(problem)
    text, candidates = capture_advice(problem, known, folder, PARTS, SENSOR, WEIGHT, SAMPLES)
    return problem, known, text, candidates, folder


def test_adding_a_light_gives_the_error_that_was_predicted(
    few_lights: tuple[StackProblem[Tissue], Uncertainty, str, tuple[Candidate, ...], Path], tmp_path: Path
) -> None:
    problem, known, _, candidates, folder = few_lights
    assert known.sandwich is not None
    before = estimates(TRUTH, PARTS, known)
    more = read_recipe(probes_of(problem, folder)[0])
    changed = 0
    for k, words in enumerate(LIGHTS):
        candidate = next(c for c in candidates if c.words == f"A light {words}")
        after = estimates(TRUTH, PARTS, replace(known, covariance=covariance_with(known.sandwich, candidate.whole)))
        actual = estimates(
            TRUTH,
            PARTS,
            known_of(problem_of(tmp_path, scene(*map(tuple, more.light_positions_mm[[0, 1 + k]].tolist())))),
        )
        for name in ("enamel.sigma_s_reduced", "enamel.sigma_a", "dentin.sigma_s_reduced", "dentin.sigma_a"):
            assert after[name].se == pytest.approx(actual[name].se, rel=0.3), (words, name)
            changed += (actual[name].se or 0.0) < 0.7 * (before[name].se or 0.0)
    # The test would fail for predictions of no change.
    assert changed > 4


def test_the_sentence_names_quantity_and_both_errors(
    few_lights: tuple[StackProblem[Tissue], Uncertainty, str, tuple[Candidate, ...], Path],
) -> None:
    _, _, text, candidates, _ = few_lights
    assert {c.words for c in candidates} == {f"A light {words}" for words in LIGHTS} | {
        f"A camera {words}" for words in VIEWS
    }
    assert "would help most: it would cut the error of" in text
    assert text.count(" %") == 2


def test_where_nothing_helps_that_is_said(
    few_lights: tuple[StackProblem[Tissue], Uncertainty, str, tuple[Candidate, ...], Path],
) -> None:
    _, known, _, _, _ = few_lights
    nothing = AddedInformation(np.zeros((4, 4)), np.zeros((4, 4)))
    assert sentence(TRUTH, PARTS, known, [Candidate("A light above", (nothing, nothing))]).startswith(
        "None of the 1 further lights and views"
    )


def test_new_images_have_the_errors_that_are_known_and_one_of_their_own(tmp_path: Path) -> None:
    problem = problem_of(tmp_path, scene((-300.0, 300.0, -700.0)))
    (block,) = problem.passes.read_blocks()
    known = BlockInstrument("gain.green", ("light_gain.a",), "flare.c0.green", 1.3)
    blocks = (write_block(tmp_path, replace(block, instrument=known)),)
    problem = replace(problem, passes=replace(problem.passes, blocks=blocks))
    lights, *views = probes_of(problem, tmp_path)[1]
    # A new light with the fit's camera has that camera's flare and a new gain; a new camera has the old lights' gains
    # and a new flare.
    acting = read_block(lights.block).instrument
    assert acting is not None
    assert (acting.flare, acting.lights[:2], lights.own_error) == (known.flare, ("light_gain.a", ""), "light_gain")
    for view in views:
        acting = read_block(view.block).instrument
        assert acting is not None
        assert (acting.flare, acting.lights[0], view.own_error) == ("", "light_gain.a", "flare")


def test_a_turned_camera_keeps_its_distance_and_looks_at_the_tooth() -> None:
    first, centre = camera("c0"), np.array([1.0, -2.0, 3.0])
    before, depth = first.project(centre[None])
    moved: Camera = rotated_camera(first, centre, np.array([0.0, 1.0, 0.0]))
    after, moved_depth = moved.project(centre[None])
    np.testing.assert_allclose(after, before, atol=1e-6)
    np.testing.assert_allclose(moved_depth, depth)
    np.testing.assert_allclose(
        np.asarray(moved.camera_from_world)[:3, :3] @ np.asarray(first.camera_from_world)[:3, :3].T,
        similar_rotation(),
        atol=1e-12,
    )


def similar_rotation() -> np.ndarray:
    c, s = np.cos(np.radians(60)), np.sin(np.radians(60))
    return np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
