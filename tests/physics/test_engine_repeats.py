"""Renders are reproducible: in a repetition, another process, with another number of threads, and in other blocks."""

from __future__ import annotations

import multiprocessing
from dataclasses import fields

import numpy as np
import pytest
from numpy.typing import NDArray

from services.bench.transport.lanes import FixedLanes
from services.core.records import Boundary
from services.transport.engine import Engine
from services.transport.scene.recipe import View
from tests.support.render_once import NAMES, TISSUE, Picture, picture, render_into
from tests.support.small_tooth import camera_at, recipe, whole_view
from tests.support.stained_tooth import stained_recipe

BOUNDARIES: tuple[Boundary, ...] = ("matched", "thin")


def pictures_of_another_process(boundary: Boundary, thread_counts: tuple[int, ...]) -> list[Picture]:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=render_into, args=(theirs, boundary, thread_counts))
    process.start()
    theirs.close()
    try:
        used, results = ours.recv()
    finally:
        process.join(60)
    assert process.exitcode == 0
    assert used == thread_counts
    assert [type(result) for result in results] == [Picture] * len(thread_counts)
    return list(results)


def require_same_bits(first: Picture, second: Picture) -> None:
    assert distance(first.texels, second.texels) <= 1e-12
    for field in fields(Picture):
        if field.name == "texels":
            continue
        np.testing.assert_array_equal(getattr(first, field.name), getattr(second, field.name), err_msg=field.name)


def distance(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Norm of the difference relative to the norm of ``second``."""
    return float(np.linalg.norm(first - second) / np.linalg.norm(second))


@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_a_scene_built_twice_gives_the_same_bits(boundary: Boundary) -> None:
    one, second = picture(Engine(stained_recipe(boundary))), picture(Engine(stained_recipe(boundary)))
    require_same_bits(one, second)
    assert (one.image.sum(axis=1) > 0).all()
    assert (np.abs(one.jacobian).sum(axis=(1, 2)) > 0).all()
    assert (one.orders.sum(axis=(1, 2)) > 0).all()


@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_no_bit_depends_on_which_lane_walked_a_row(boundary: Boundary) -> None:
    scene = stained_recipe(boundary)
    require_same_bits(picture(FixedLanes(scene)), picture(Engine(scene)))


@pytest.mark.dear("Engines in two more processes compile their own kernels.")
@pytest.mark.parametrize("boundary", ["matched", pytest.param("thin", marks=pytest.mark.slow)])
def test_processes_and_thread_counts_agree(boundary: Boundary) -> None:
    (two, one), (two_again, one_again) = (pictures_of_another_process(boundary, (2, 1)) for _ in range(2))
    require_same_bits(one, one_again)
    require_same_bits(two, two_again)
    assert distance(two.image, one.image) <= 1e-5
    assert distance(two.orders, one.orders) <= 1e-5
    for ours, theirs in zip(two.jacobian, one.jacobian, strict=True):
        assert distance(ours, theirs) <= 1e-4
    assert distance(two.shape, one.shape) <= 1e-4
    assert distance(two.texels, one.texels) <= 1e-4


def test_blocks_do_not_change_a_pixel() -> None:
    engine, view = Engine(recipe()), whole_view(camera_at((0.2, 1, 0.1)))
    order = np.random.default_rng(3).permutation(len(view))
    cut = len(view) // 3
    whole = engine.images(TISSUE, view, samples=32, seed=9)
    slopes = engine.jacobian(TISSUE, view, NAMES, samples=32, seed=9).jacobian
    for block in (order[:cut], order[cut:]):
        part = View(view.camera, view.pixels[block])
        alone = engine.images(TISSUE, part, samples=32, seed=9)
        np.testing.assert_array_equal(alone.mean, whole.mean[:, block])
        np.testing.assert_array_equal(alone.variance, whole.variance[:, block])
        np.testing.assert_array_equal(
            engine.jacobian(TISSUE, part, NAMES, samples=32, seed=9).jacobian, slopes[:, :, block]
        )


def test_seeds_and_batches_are_independent() -> None:
    engine, view = Engine(recipe()), whole_view(camera_at((0.2, 1, 0.1)), 2)
    one, two = (engine.images(TISSUE, view, samples=512, seed=seed) for seed in (1, 2))
    lit = one.mean > 0
    assert (one.mean[lit] != two.mean[lit]).mean() > 0.99
    # Differences of two seeds must match their variances, which come from 16 batches each. The 80 values of z are
    # correlated, as the lights share paths; a correct run has an rms outside 0.7 to 1.35 less than once in a thousand.
    z = (one.mean - two.mean)[lit] / np.sqrt(one.variance + two.variance)[lit]
    assert 0.7 <= np.sqrt(np.mean(z**2)) <= 1.35


def test_cameras_have_streams_of_their_own() -> None:
    engine, view = Engine(recipe()), whole_view(camera_at((0.2, 1, 0.1)), 2)
    other = View(view.camera.model_copy(update={"name": "another"}), view.pixels)
    one, two = (engine.images(TISSUE, of, samples=512, seed=1).mean for of in (view, other))
    lit = one > 0
    assert (one[lit] != two[lit]).mean() > 0.99


def test_reshaping_there_and_back_gives_the_same_bits() -> None:
    engine, view = Engine(recipe()), whole_view(camera_at((0.2, 1, 0.1)), 2)
    before = engine.images(TISSUE, view, samples=32, seed=9).mean
    moved = engine.images(TISSUE.with_values({"shape.0": 0.9}), view, samples=32, seed=9).mean
    after = engine.images(TISSUE, view, samples=32, seed=9).mean
    assert np.abs(moved - before).max() > 0
    np.testing.assert_array_equal(after, before)
