"""The engine renders only what a view needs: lights that it does not list give zero, and the others give the same bits
as in a scene without them. Kernels contain no code of features that are off.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from services.bench.transport.skip import Case, cases, kernel_operations
from services.slab.simulate import Layer, accumulate
from services.transport.engine import Engine
from services.transport.optics.parameters import Medium, Tissue
from tests.support.small_tooth import LIGHTS_MM, camera_at, recipe, whole_view

NAMES = ("enamel.sigma", "dentin.alpha", "shape.1")
TISSUE = Tissue(Medium(2, 0.95, 0.8, 0.6, -0.3), Medium(3, 0.8, 0.7, 0.6, -0.3), (0.5, 0.4))


@pytest.fixture(scope="module")
def engine() -> Engine:
    return Engine(recipe())


@pytest.mark.parametrize("seen", [(1, 4), (4, 0)])
def test_lights_that_are_not_listed_are_zero_and_change_no_bit(engine: Engine, seen: tuple[int, int]) -> None:
    scene, view = recipe(), whole_view(camera_at((0.2, 1, 0.1)))
    smaller = Engine(
        replace(scene, light_positions_mm=LIGHTS_MM[list(seen)], light_intensities=scene.light_intensities[list(seen)])
    )
    some, unseen = replace(view, lights=seen), [k for k in range(len(LIGHTS_MM)) if k not in seen]
    image, alone = (one.images(TISSUE, v, samples=16, seed=9) for one, v in ((engine, some), (smaller, view)))
    slope, slope_alone = (
        one.jacobian(TISSUE, v, NAMES, samples=16, seed=9) for one, v in ((engine, some), (smaller, view))
    )
    edges = np.array([0, 3, 40])
    orders, orders_alone = (
        one.order_images(TISSUE, v, bin_edges=edges, samples=16, seed=9) for one, v in ((engine, some), (smaller, view))
    )
    for ours, theirs, axis in (
        (image.mean, alone.mean, 0),
        (image.variance, alone.variance, 0),
        (slope.jacobian, slope_alone.jacobian, 1),
        (slope.jacobian_variance, slope_alone.jacobian_variance, 1),
        (orders, orders_alone, 1),
    ):
        assert ours.shape[axis] == len(LIGHTS_MM)
        assert not np.take(ours, unseen, axis=axis).any()
        np.testing.assert_array_equal(np.take(ours, seen, axis=axis), theirs)
        assert theirs.any()


FEATURES = (
    "scores",
    "shape",
    "dentin",
    "second lobe",
    "phase table",
    "thin faces",
    "stains",
    "order bins",
    "unseen lights",
    "masked pixels",
)


@pytest.fixture(scope="module")
def features() -> Iterator[dict[str, Case]]:
    found = {case.name: case for case in cases()}
    assert set(found) == set(FEATURES)
    # Every count of operations collects garbage first, which takes long in a process that holds many modules.
    gc.collect()
    gc.freeze()
    yield found
    gc.unfreeze()


@pytest.mark.parametrize("feature", FEATURES)
def test_what_is_off_is_not_in_the_kernel(features: dict[str, Case], feature: str) -> None:
    case = features[feature]
    off, without, on = (kernel_operations(call, 2) for call in (case.off, case.without, case.on))
    assert off == without
    # Lights and pixels are data of a kernel, not code, so more of them need not change it.
    assert on >= off if feature in FEATURES[-2:] else on > off


@pytest.mark.parametrize("feature", FEATURES[:-2])
def test_what_is_off_changes_no_bit(features: dict[str, Case], feature: str) -> None:
    case = features[feature]
    np.testing.assert_array_equal(case.off(2, 3).mean, case.without(2, 3).mean)


SLAB = Layer(sigma=2, alpha=0.9, g1=0.5, thickness_mm=1)
SLAB_FEATURES: dict[str, dict[str, Any]] = {
    "oblique beam": {"mu_incident": 0.5},
    "exit cosines": {"exit_cosines": (0.5,)},
    "rings": {"ring_edges_mm": (0.5,)},
}


def slab_operations(**options: Any) -> int:
    return kernel_operations(lambda *_: accumulate((SLAB,), lambda _: 0.0, ior=1.5, boundary="smooth", **options), 16)


@pytest.mark.parametrize("feature", SLAB_FEATURES)
def test_a_slab_pays_only_for_what_is_asked_of_it(feature: str, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = slab_operations(**SLAB_FEATURES[feature])
    # The kernel without these features must not even construct the class ``Exits``.
    monkeypatch.delattr("services.transport.paths.walk.Exits")
    assert slab_operations() < asked
