"""How many steps the last stages of a slab's fit have, and what their weights contain."""

from __future__ import annotations

import numpy as np
import pytest

from services.slab.cell.dictionary import Material, henyey_greenstein
from services.slab.read.images import Measurements
from services.slab.solve.budget import Budget
from services.slab.solve.checkpoint import Checkpoint
from services.slab.solve.coordinates import Knots
from services.slab.solve.gauss_newton import MAX_THICKNESS, GaussNewton
from services.slab.solve.weights import Weights, weights_of
from tests.support.small_slab import small_rig

THIN, THICK = henyey_greenstein(1.2, 0.6, 0.05), henyey_greenstein(6.0, 0.6, 0.05)


def solver() -> GaussNewton:
    rig = small_rig()
    values = np.ones((sum(len(views.images) for views in rig.lights), rig.grid.pixels))
    places = tuple((str(number), "l0") for number in range(len(values)))
    measured = Measurements(values, values, np.zeros(len(values), dtype=bool), places, assumed_noise=False)
    return GaussNewton(rig, measured, 1, Budget(), map, Knots(), path_noise=(), multiple=np.zeros((1, 1)))


def checkpoint(stage: int, step: int) -> Checkpoint:
    return Checkpoint(THIN, stage, step, 3, True, 5, 1000, (), np.zeros((1, 1)), None)


def test_effort_multiplies_the_paths_and_leaves_the_steps() -> None:
    whole, tenth = Budget(), Budget().scaled(0.1)
    assert tenth.final_paths == whole.final_paths // 10
    for scaled, stage in zip(tenth.last, whole.last, strict=True):
        assert scaled.paths == stage.paths // 10
        assert (scaled.batches, scaled.thin_steps, scaled.thick_steps) == (
            stage.batches, stage.thin_steps, stage.thick_steps
        )  # fmt: skip
    assert min(stage.paths for stage in whole.scaled(1e-9).last) == 1


@pytest.mark.parametrize(
    ("gain", "path_variance", "is_settled", "is_over"),
    [
        (1.9, 0.4, False, True),
        (2.1, 0.4, False, False),
        (1.9, 0.6, False, False),
        (9.0, 0.4, True, True),
        (9.0, 0.6, True, False),
    ],
)
def test_a_stage_ends_where_steps_promise_or_change_little_and_paths_add_little(
    gain: float, path_variance: float, is_settled: bool, is_over: bool
) -> None:
    fit, stage = solver(), Budget().last[0]
    following = fit.next_checkpoint(checkpoint(0, 0), stage, THIN, gain, path_variance, is_settled=is_settled)
    assert (following.stage, following.step) == ((1, 0) if is_over else (0, 1))


@pytest.mark.parametrize(
    ("moved", "allowed"), [(THIN, Budget().last[1].thin_steps), (THICK, Budget().last[1].thick_steps)]
)
def test_a_stage_ends_with_its_steps(moved: Material, allowed: int) -> None:
    fit, stage = solver(), Budget().last[1]
    assert fit.next_checkpoint(checkpoint(1, allowed - 2), stage, moved, 9.0, 9.0, is_settled=False).stage == 1
    assert fit.next_checkpoint(checkpoint(1, allowed - 1), stage, moved, 9.0, 9.0, is_settled=False).stage == 2


@pytest.mark.parametrize(
    ("material", "gain", "steps", "is_far"),
    [
        (THIN, 60.0, 3, True),
        (THIN, -60.0, 3, True),
        (THIN, 40.0, 3, False),
        (THICK, 60.0, 3, False),
        (THIN, 60.0, 99, False),
    ],
)
def test_a_thin_fit_far_from_its_minimum_returns_to_the_search(
    material: Material, gain: float, steps: int, is_far: bool
) -> None:
    assert solver().is_far(material, gain, steps) is is_far


def test_a_search_that_has_gone_astray_takes_no_further_step() -> None:
    fit = solver()
    fit.budget, fit.path_noise, fit.multiple = Budget(batches=2, first_paths=5), None, None
    found = fit.search(henyey_greenstein(1.2 * MAX_THICKNESS, 0.5, 0.0))  # in a cell of 1 mm
    assert (found.steps, found.is_converged) == (0, False)


def given_noise(monkeypatch: pytest.MonkeyPatch, *, combine: bool, share: float = 1.0) -> list[np.ndarray]:
    """Covariances (pixels, C, C) of each light that weights of a thin cell are made from."""
    given: list[np.ndarray] = []

    def watched(images: list[np.ndarray], variances: np.ndarray, noise: list[np.ndarray]) -> Weights:
        given.extend(noise)
        return weights_of(images, variances, noise)

    monkeypatch.setattr("services.slab.solve.gauss_newton.weights_of", watched)
    fit = solver()
    fit.path_noise = fit.multiple = None
    fit.linearised(THIN, 200, 4, combine=combine, noise_share=share)
    return given


def test_weights_know_what_cameras_share_where_renders_are_combined(monkeypatch: pytest.MonkeyPatch) -> None:
    own = np.eye(2, dtype=bool)
    for apart, together in zip(
        given_noise(monkeypatch, combine=False), given_noise(monkeypatch, combine=True), strict=True
    ):
        assert (apart[:, ~own] == 0).all()
        assert (together[:, ~own] != 0).any()
        np.testing.assert_array_equal(apart[:, own], together[:, own])


def test_weights_contain_a_share_of_the_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    for whole, part in zip(
        given_noise(monkeypatch, combine=True), given_noise(monkeypatch, combine=True, share=0.25), strict=True
    ):
        np.testing.assert_allclose(part, whole / 4, rtol=1e-12)
