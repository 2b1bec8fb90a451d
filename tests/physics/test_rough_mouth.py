"""A rough surface in a mouth: a tooth whose root is in gums, a tooth beside it, and a wall behind both."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from services.core.errors import InputError
from services.transport.engine import Engine
from services.transport.optics.parameters import Medium, Mouth, Tissue
from tests.support.furnace import escaping_weights
from tests.support.pictures import BATCHES, pixel_scores, require_same_pictures
from tests.support.rough_truths import MOUTH_INK, STORED, rough_mouth
from tests.support.small_mouth import MOUTH, mouth_recipe
from tests.support.small_tooth import camera_at, whole_view


@pytest.mark.dear("Light of the wall is noisy, and is subtracted.")
def test_a_mouth_looks_as_in_stock_mitsuba() -> None:
    stored = np.load(STORED)
    mean, variance = (stored[f"{name}/mouth"].astype(np.float64) for name in ("mean", "variance"))
    recipe, view = rough_mouth()
    engine = Engine(recipe, 2)
    whole, black = (
        engine.images(mouth, view, samples=8192, seed=seed, batches=BATCHES)
        for mouth, seed in ((MOUTH, 3), (MOUTH_INK, 4))
    )
    ours, noise = (whole.mean - black.mean).reshape(mean.shape), (whole.variance + black.variance).reshape(mean.shape)
    require_same_pictures(pixel_scores([ours, mean], [noise, variance], block=2), least=64)


def test_white_walks_carry_all_their_weight_out_of_a_mouth() -> None:
    # The wall is left out, because it absorbs. Walks pass from air to teeth and gums, and from one to the other.
    recipe = replace(mouth_recipe("rough"), cavity=None, roughness=0.3)
    white = [Medium(0.5, 1.0, g1=0.5)] * 5
    lanes = escaping_weights(recipe, white, whole_view(camera_at((0.3, 1, 0.25), size=16, span_mm=10)))
    error = lanes.std(ddof=1) / np.sqrt(len(lanes))
    assert error <= 1e-3
    # Without compensation it is 0.8.
    assert abs(lanes.mean() - 1) <= 0.003 + 2 * error


def test_a_wall_behind_black_teeth_is_as_bright_as_without_a_surface() -> None:
    view, matched = whole_view(camera_at((0.3, 1, 0.25), size=12, span_mm=13)), Engine(mouth_recipe("matched"), 2)
    rough = Engine(mouth_recipe("rough"), 2).images(MOUTH_INK, view, samples=2048, seed=5)
    plain, other = (matched.images(MOUTH_INK, view, samples=2048, seed=seed) for seed in (6, 7))
    wall = other.mean > 0.9 * other.mean.max(axis=1, keepdims=True)
    assert wall.sum() > 24
    excess = ((rough.mean - plain.mean) * wall).sum(axis=1)
    error = np.sqrt(((rough.variance + plain.variance) * wall).sum(axis=1))
    # Rough teeth mirror 1 to 2 % to the wall in stock Mitsuba, which matched ones take.
    assert (np.abs(excess) < 0.03 * (plain.mean * wall).sum(axis=1) + 4 * error).all()


def test_gums_like_air_are_refused() -> None:
    with pytest.raises(InputError, match=r"gums_ior = 1 is too close to that of air for a rough surface"):
        Engine(replace(mouth_recipe("rough"), gums_ior=1.0))


def test_aimed_connections_in_a_mouth_give_the_images_of_walks_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    # One tooth is fitted, and the other has its media. Lights through the gums and the neighbour are not aimed at.
    scene, view = rough_mouth()
    scene = replace(scene, teeth=scene.teeth[:1], neighbours=scene.teeth[1:], cavity=None, roughness=0.15)
    clear = Medium(3.0, 0.99, g1=0.7)
    mouth = Mouth((Tissue(clear, Medium(6.0, 0.98, g1=0.6)),), Medium(2.5, 0.9, g1=0.6))
    aimed = Engine(scene, 2).images(mouth, view, samples=2048, seed=1, batches=BATCHES)
    monkeypatch.setattr("services.transport.boundary.rough.Rough.aims", lambda *_: False)
    alone = Engine(scene, 2).images(mouth, view, samples=4096, seed=2, batches=BATCHES)
    shape = (len(aimed.mean), *view.camera.size[::-1])
    means, variances = ([getattr(one, name).reshape(shape) for one in (aimed, alone)] for name in ("mean", "variance"))
    require_same_pictures(pixel_scores(means, variances, block=2), least=48)
