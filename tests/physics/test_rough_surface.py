"""The rough dielectric surface: energy, derivatives, and images of stock Mitsuba."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from services.core.errors import InputError
from services.transport.engine import Engine
from services.transport.platform import prepare_device
from tests.support.pictures import BATCHES, pixel_scores, require_same_pictures
from tests.support.rough_truths import CASES, STORED, TISSUE, scene_recipe, view
from tests.support.small_mouth import mouth_recipe


def escaping_weight(cosine: NDArray[np.float32], roughness: float, ior: float, *, leaving: bool) -> NDArray[np.float32]:
    """Weights (N,) of walks that meet a compensated face at these cosines."""
    prepare_device()
    import drjit as dr
    import mitsuba as mi

    from services.transport.boundary.rough import Rough
    from services.transport.scene.geometry import Hit, SlabGeometry

    yes, cosine_of = mi.Bool(True), mi.Float(cosine)
    omega = mi.Vector3f(dr.sqrt(1 - dr.square(cosine_of)), 0, cosine_of if leaving else -cosine_of)
    hit = Hit(mi.Float(1), yes, mi.Normal3f(0, 0, 1), yes, mi.Bool(False), mi.UInt32(0), mi.UInt32(0), mi.Point2f(0))
    rng = mi.PCG32(size=len(cosine), initstate=5)
    geometry = SlabGeometry((1.0,), moving_border=False)
    met = Rough(ior, roughness).meet(geometry, omega, mi.UInt32(0), hit, yes, mi.Bool(False), rng)
    return np.array(met.weight)


@pytest.mark.parametrize("leaving", [False, True])
@pytest.mark.parametrize(("roughness", "ior"), [(0.05, 1.33), (0.15, 1.63), (0.3, 1.63)])
def test_a_lossless_face_gives_all_light_back_or_through_at_every_angle(
    roughness: float, ior: float, leaving: bool
) -> None:
    # 24 cosines, of which the first four graze, with 2^16 walks each.
    cosines = np.concatenate([[0.001, 0.003, 0.01, 0.03], np.linspace(0.05, 0.999, 20)]).astype(np.float32)
    weights = escaping_weight(np.repeat(cosines, 2**16), roughness, ior, leaving=leaving).reshape(24, -1)
    error = weights.std(axis=1, ddof=1) / 256
    # A furnace is 1 within 0.003, and this many values lie within 4 standard errors of it.
    assert np.all(np.abs(weights.mean(axis=1) - 1) <= 0.003 + 4 * error)
    assert np.abs(weights.mean() - 1) <= 0.001


def test_images_are_those_of_stock_mitsuba() -> None:
    stored = np.load(STORED)
    scores = []
    for roughness, ior in CASES:
        mean, variance = (stored[f"{name}/{roughness}"].astype(np.float64) for name in ("mean", "variance"))
        ours = Engine(scene_recipe(roughness, ior), 2).images(TISSUE, view(), samples=1024, seed=3, batches=BATCHES)
        scores.append(
            pixel_scores([ours.mean.reshape(mean.shape), mean], [ours.variance.reshape(mean.shape), variance], 2)
        )
    require_same_pictures(np.concatenate(scores), least=48)


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"roughness": 0.0}, r"roughness = 0 must lie in 0\.02 to 1; give the GGX roughness"),
        ({"roughness": float("nan")}, "roughness = nan must lie in"),
        ({"ior": 1.001}, r"ior = 1\.001 is too close to that of air"),
        ({"ior": 0.9}, r"ior = 0\.9 must be at least 1"),
    ],
)
def test_what_is_no_rough_surface_is_refused(changed: dict[str, float], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        Engine(replace(scene_recipe(0.15, 1.63), **changed))  # type: ignore[arg-type]


def test_a_rough_mouth_is_refused() -> None:
    with pytest.raises(InputError, match="boundary = rough is made for one tooth"):
        Engine(replace(mouth_recipe("thin"), boundary="rough"))


def test_gradients_that_need_straight_light_are_refused() -> None:
    engine = Engine(scene_recipe(0.15, 1.63))
    with pytest.raises(InputError, match="boundary = rough has not the gradient to stains"):
        engine.stain_gradient(TISSUE, view(), np.zeros((2, 64)), seed=1, samples=16)
    with pytest.raises(InputError, match="boundary = rough has not the gradient to the dentin's shape"):
        engine.shape_gradient(TISSUE, view(), np.zeros((2, 64)), seed=1, samples=16)
