"""The rough dielectric surface: energy, derivatives, and images of stock Mitsuba."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from services.core.errors import InputError
from services.transport.engine import Engine
from services.transport.optics.ggx_albedo import ANGLES, albedo_tables
from services.transport.optics.parameters import Medium, Tissue
from services.transport.platform import prepare_device
from services.transport.scene.recipe_files import read_recipe, write_recipe
from tests.support.furnace import escaping_weights
from tests.support.pictures import BATCHES, pixel_scores, require_same_pictures
from tests.support.rough_truths import CASES, NARROW_CASE, STORED, TISSUE, RoughTruth, ball, incisor, scene_recipe, view
from tests.support.small_tooth import camera_at, whole_view
from tests.support.z_scores import student_to_normal


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


@pytest.mark.parametrize("leaving", [False, True])
def test_the_score_of_roughness_is_the_derivative_of_the_logarithm(leaving: bool) -> None:
    prepare_device()
    import drjit as dr
    import mitsuba as mi

    from services.transport.boundary.rough import Rough

    count, step, rng = 4096, 0.004, mi.PCG32(size=4096, initstate=3)
    below = mi.warp.square_to_uniform_hemisphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
    light = mi.warp.square_to_uniform_hemisphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
    omega, normal = below if leaving else -below, mi.Vector3f(0, 0, 1)
    value, score = Rough(1.63, 0.3, compensated=False).towards(omega, normal, light)
    up, down = (
        np.array(Rough(1.63, 0.3 + h, compensated=False).towards(omega, normal, light)[0]) for h in (step, -step)
    )
    seen = np.array(value + dr.zeros(mi.Float, count)) > 1e-3
    assert seen.sum() > count / 10
    slope = (up[seen] - down[seen]) / (2 * step * np.array(value)[seen])
    # Third derivatives times the step squared, and roundings of 1e-7 over the step; scores reach 20.
    np.testing.assert_allclose(np.array(score)[seen], slope, rtol=5e-3, atol=5e-3)


def test_the_score_of_the_compensation_is_its_derivative() -> None:
    step = 0.05
    _, scores = albedo_tables(0.3, 1.63)
    above, below = (np.log(albedo_tables(0.3 * np.exp(sign * step), 1.63)[0]) for sign in (1, -1))
    # From the dense side the critical angle leaves an error of 1e-3 in a table's values, which is divided by the step.
    np.testing.assert_allclose(scores, (above - below) / (2 * step), atol=0.02)
    np.testing.assert_allclose(scores[0], (above - below)[0] / (2 * step), atol=1e-3)


@pytest.mark.parametrize("leaving", [False, True])
def test_facets_lose_as_much_light_as_those_of_stock_mitsuba(leaving: bool) -> None:
    prepare_device()
    import drjit as dr
    import mitsuba as mi

    from services.transport.boundary.rough import Rough

    # Diffuse light from one side; stock Mitsuba's weight is what one scattering leaves of it.
    count, rng, mode = 2**18, mi.PCG32(size=2**18, initstate=7), mi.TransportMode.Importance
    arriving = mi.warp.square_to_cosine_hemisphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.wi = mi.Vector3f(arriving.x, arriving.y, -arriving.z if leaving else arriving.z)
    u, v = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
    _, weight = mi.load_dict(Rough.mitsuba(1.63, roughness=0.3)).sample(mi.BSDFContext(mode), si, u, v)
    left = np.array(weight).reshape(-1)
    cosines = np.linspace(0, 1, ANGLES) ** 2
    table = np.trapezoid(2 * cosines * albedo_tables(0.3, 1.63)[0][int(leaving)], cosines)
    # Some 0.958 and 0.823; the rule of trapezia over this table errs by 1e-5.
    assert abs(left.mean() - table) < 4 * left.std() / np.sqrt(count) + 1e-4


def scores(truth: RoughTruth, samples: int) -> NDArray[np.float64]:
    """z-scores (lights, H / 2, W / 2) of blocks of 2 x 2 pixels against the stored images."""
    stored = np.load(STORED)
    mean, variance = (stored[f"{name}/{truth.name}"].astype(np.float64) for name in ("mean", "variance"))
    ours = Engine(truth.recipe, 2).images(truth.tissue, truth.view, samples=samples, seed=3, batches=BATCHES)
    return pixel_scores([ours.mean.reshape(mean.shape), mean], [ours.variance.reshape(mean.shape), variance], block=2)


def test_a_ball_looks_as_in_stock_mitsuba() -> None:
    require_same_pictures(np.concatenate([scores(ball(*case), 1024) for case in CASES]), least=48)


def test_a_ball_of_a_narrow_lobe_looks_as_in_stock_mitsuba() -> None:
    # The standard error of the whole image is 1.4 % for stock Mitsuba, and 2.6 % here.
    require_same_pictures(scores(ball(*NARROW_CASE), 8192), least=20)


@pytest.mark.dear("A real tooth has some ten walks of the ball in each.")
def test_the_incisor_looks_as_in_stock_mitsuba() -> None:
    # The standard error of a light's whole image is 0.5 % for stock Mitsuba, and 1.8 % here.
    require_same_pictures(scores(incisor(), 4096), least=20)


def test_one_light_of_several_and_a_stored_scene_give_the_same_image(tmp_path: Path) -> None:
    recipe = scene_recipe(0.3, 1.33)
    again = read_recipe(write_recipe(tmp_path, recipe))
    assert (again.boundary, again.roughness, again.multiple_scattering) == ("rough", 0.3, False)
    both = Engine(recipe, 2).images(TISSUE, view(), samples=4096, seed=3)
    one = Engine(again, 2).images(TISSUE, replace(view(), lights=(1,)), samples=4096, seed=4)
    assert np.all(one.mean[0] == 0)
    difference = one.mean[1].sum() - both.mean[1].sum()
    error = np.sqrt(one.variance[1].sum() + both.variance[1].sum())
    # Another light's image would be seen.
    assert abs(both.mean[0].sum() - both.mean[1].sum()) > 8 * error
    assert abs(difference) < 4 * error


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


def test_gradients_that_need_straight_light_are_refused() -> None:
    engine = Engine(scene_recipe(0.15, 1.63))
    with pytest.raises(InputError, match="boundary = rough has not the gradient to stains"):
        engine.stain_gradient(TISSUE, view(), np.zeros((2, 64)), seed=1, samples=16)
    with pytest.raises(InputError, match="boundary = rough has not the gradient to the dentin's shape"):
        engine.shape_gradient(TISSUE, view(), np.zeros((2, 64)), seed=1, samples=16)


def test_white_walks_carry_all_their_weight_out_of_a_closed_surface() -> None:
    recipe = replace(scene_recipe(0.15, 1.63), multiple_scattering=True)
    start = whole_view(camera_at((0.2, 1, 0.1), size=16, span_mm=2.0))
    lanes = escaping_weights(recipe, [Medium(1.0, 1.0, g1=0.5)], start)
    error = lanes.std(ddof=1) / np.sqrt(len(lanes))
    assert error <= 1e-3
    # Without compensation it is 0.85.
    assert abs(lanes.mean() - 1) <= 0.003 + 2 * error


@pytest.mark.dear("Differences need many paths, five seeds of them.")
def test_derivatives_are_differences_of_images() -> None:
    medium, seeds, paths = Medium(2.0, 0.97, g1=0.4), range(1, 6), 2048
    tissue, scene = Tissue(medium, medium), replace(scene_recipe(0.3, 1.5), multiple_scattering=True)
    engine = Engine(scene, 2)
    steps = {"enamel.sigma": 0.25, "enamel.alpha": 0.01, "enamel.g1": 0.1, "roughness": 0.06}

    def totals(engine: Engine, tissue: Tissue) -> NDArray[np.float64]:
        return np.stack([engine.images(tissue, view(), seed=seed, samples=paths).mean.sum(axis=1) for seed in seeds])

    scores = np.stack(
        [engine.jacobian(tissue, view(), tuple(steps), seed=seed, samples=paths).jacobian.sum(axis=2) for seed in seeds]
    )
    z, found = [], {}
    for number, (name, step) in enumerate(steps.items()):
        sides = []
        for change in (step, -step):
            if name == "roughness":
                sides.append(totals(Engine(replace(scene, roughness=0.3 + change), 2), tissue))
            else:
                field = name.removeprefix("enamel.")
                moved = replace(medium, **{field: getattr(medium, field) + change})
                sides.append(totals(engine, Tissue(moved, moved)))
        # Both sides have the same random numbers, and so has the score.
        deviation = (sides[0] - sides[1]) / (2 * step) - scores[:, number]
        error = deviation.std(axis=0, ddof=1) / np.sqrt(len(seeds))
        z.append(student_to_normal(deviation.mean(axis=0) / error, np.full(2, len(seeds) - 1.0)))
        found[name] = np.abs(scores[:, number].mean(axis=0)) / error
    # Of 8 values one exceeds 4 by chance once in 2,000 runs.
    assert np.abs(z).max() < 4
    # Half the size of the score of alpha, and another sign of those of sigma and of roughness, would be 4 off or more;
    # the tests of scores above are finer for roughness.
    assert found["enamel.alpha"].min() > 10
    assert found["enamel.sigma"].max() > 5
    assert found["roughness"].max() > 2
