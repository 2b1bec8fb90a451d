"""The same question gives the same answer: twice, in another process, at another thread count, and cut into other blocks."""

from __future__ import annotations

import multiprocessing

import numpy as np
from numpy.typing import NDArray

from services.fit.transport.engine import Engine
from services.fit.transport.recipe import View
from tests.support.render_once import NAMES, TISSUE, picture, render_into
from tests.support.small_tooth import camera_at, recipe, whole_view

Picture = tuple[NDArray[np.float64], NDArray[np.float64]]


def picture_of_another_process(threads: int) -> Picture:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=render_into, args=(theirs, threads))
    process.start()
    theirs.close()
    try:
        result: Picture = ours.recv()
    finally:
        process.join(60)
    assert process.exitcode == 0
    return result


def test_a_scene_built_twice_gives_the_same_bits() -> None:
    first, second = picture(Engine(recipe("thin"))), picture(Engine(recipe("thin")))
    np.testing.assert_array_equal(first[0], second[0])
    np.testing.assert_array_equal(first[1], second[1])
    assert np.abs(first[0]).sum() > 0
    assert (np.abs(first[1]).sum(axis=(1, 2)) > 0).all()


def test_processes_and_thread_counts_agree() -> None:
    one, again, two = (picture_of_another_process(threads) for threads in (1, 1, 2))
    np.testing.assert_array_equal(one[0], again[0])
    np.testing.assert_array_equal(one[1], again[1])
    assert np.linalg.norm(two[0] - one[0]) <= 1e-5 * np.linalg.norm(one[0])
    for ours, theirs in zip(two[1], one[1], strict=True):
        assert np.linalg.norm(ours - theirs) <= 1e-4 * np.linalg.norm(theirs)


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
        np.testing.assert_array_equal(engine.jacobian(TISSUE, part, NAMES, samples=32, seed=9).jacobian, slopes[:, :, block])


def test_seeds_and_batches_are_independent() -> None:
    engine, view = Engine(recipe()), whole_view(camera_at((0.2, 1, 0.1)), 2)
    one, two = (engine.images(TISSUE, view, samples=512, seed=seed) for seed in (1, 2))
    lit = one.mean > 0
    assert (one.mean[lit] != two.mean[lit]).mean() > 0.99
    # Differences of two seeds are as large as their variances say: an rms z from 16 batches a side. 80 values, one light's
    # correlated with another's through common paths: 0.7 to 1.35 leaves an honest run out less than once in a thousand.
    z = (one.mean - two.mean)[lit] / np.sqrt(one.variance + two.variance)[lit]
    assert 0.7 <= np.sqrt(np.mean(z**2)) <= 1.35


def test_reshaping_there_and_back_gives_the_same_bits() -> None:
    engine, view = Engine(recipe()), whole_view(camera_at((0.2, 1, 0.1)), 2)
    before = engine.images(TISSUE, view, samples=32, seed=9).mean
    moved = engine.images(TISSUE.with_values({"shape.0": 0.9}), view, samples=32, seed=9).mean
    after = engine.images(TISSUE, view, samples=32, seed=9).mean
    assert np.abs(moved - before).max() > 0
    np.testing.assert_array_equal(after, before)
