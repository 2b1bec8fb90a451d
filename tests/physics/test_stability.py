"""Numerical stress tests: limits of the parameter space, difficult scenes, and regressions of defects found there."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.typing import NDArray

from services.anatomy.dentin_shape import DentinShape
from services.bench.stability.corners import MATCHED, REGIONS, SMOOTH, THIN, Corners, draw
from services.bench.stability.difficult_scenes import Scene, check_scene, ellipsoid, scenes, with_slivers
from services.bench.stability.formula_errors import FORMULAS
from services.bench.stability.run import WHITE, as_table, formula_rows, stress_plan, trace, walk_rows
from services.core.errors import InputError, MeshError
from services.core.geometry import Mesh
from services.slab.simulate import Layer, simulate_slab, specular_share
from services.transport.engine import Engine
from services.transport.lighting.lights import DARKEST_CHANCE, ShadowRay
from services.transport.optics.parameters import Medium, Tissue
from services.transport.paths.connections import Connections, LookupCheck
from services.transport.platform import prepare_device
from services.transport.scene.nesting import winding_number
from services.transport.scene.recipe import SceneRecipe, single_tooth
from tests.support.slab_tables import total_cases
from tests.support.small_tooth import INTENSITY, LIGHTS_MM, SEMI_AXES_MM, camera_at, dentin_shape, whole_view
from tests.support.z_scores import LARGEST_Z, require_unbiased, z_scores

SETS = 2200
STEPS = 512


@pytest.fixture(scope="module", autouse=True)
def _device() -> None:
    prepare_device()


@pytest.fixture(scope="module")
def corners() -> Corners:
    return draw(SETS, seed=11)


def test_formulas_hold_in_every_corner(corners: Corners) -> None:
    rows = formula_rows(corners)
    assert len(rows) == len(FORMULAS) * len(REGIONS)
    assert sum(row.non_finite for row in rows) == 0
    # Each bound counts the roundings of its formula (``Formula.reason``).
    assert [(row.quantity, row.region, row.error) for row in rows if row.bound is None or row.error > row.bound] == []


def test_no_shadow_ray_is_cast_where_its_weight_would_be_0_over_0(monkeypatch: pytest.MonkeyPatch) -> None:
    # Such a weight, NaN, reached the images on CUDA; LLVM's code made 0 of it. So mark it by infinity, and let no
    # transmittance be 0.
    original = Connections._connect_by_maps

    def marked(self: Connections, *args: Any) -> tuple[LookupCheck, mi.PCG32]:
        check, rng = original(self, *args)
        underflows = check.importance * DARKEST_CHANCE < float(np.finfo(np.float32).tiny)
        check.weight = dr.select(underflows & (check.total > 0), mi.Float(float("inf")), check.weight)
        return check, rng

    def transmittance(ray: ShadowRay) -> mi.Float:
        return dr.prod([*ray.surface, dr.maximum(dr.exp(-ray.depth), 1e-37)])

    monkeypatch.setattr(Connections, "_connect_by_maps", marked)
    monkeypatch.setattr(ShadowRay, "transmittance", transmittance)
    tissue = Tissue(Medium(1.0, 0.999, g1=0.8), Medium(70.0, 0.9999, g1=0.9))
    outer, dentin = ellipsoid(SEMI_AXES_MM), DentinShape.known(dentin_shape().base)
    engine = Engine(single_tooth(outer, dentin, LIGHTS_MM, np.full(len(LIGHTS_MM), INTENSITY)))
    images = engine.images(tissue, whole_view(camera_at((0.2, 1, 0.1))), samples=256, seed=3)
    assert np.isfinite(images.mean).all()


def test_the_walk_holds_in_every_corner(corners: Corners) -> None:
    rows = walk_rows(corners, most_steps=STEPS)
    assert [row.region for row in rows] == [*REGIONS, WHITE]
    assert sum(row.non_finite for row in rows) == 0
    # Energy never grows, and none is lost in white sets. Of these 13 values, a correct run has one beyond 4.5 standard
    # errors once in 10,000 runs.
    for row in rows:
        assert row.gain is not None
        assert row.gain_error is not None
        assert row.gain <= LARGEST_Z * row.gain_error, row.region
    white = rows[-1]
    assert white.gain is not None
    assert white.gain_error is not None
    assert white.gain >= -LARGEST_Z * white.gain_error
    assert white.gain_error <= 3e-3
    assert as_table(rows).count("\n") >= len(rows)


@pytest.mark.parametrize("boundary", [MATCHED, THIN, SMOOTH])
def test_a_lane_is_the_walk_that_a_slab_of_its_own_takes(corners: Corners, boundary: int) -> None:
    from services.transport.boundary.models import slab_boundary
    from services.transport.paths.starts import SlabStart
    from services.transport.paths.walk import Walk
    from services.transport.scene.geometry import SlabGeometry
    from services.transport.scene.media import Media

    lanes = trace(corners, paths=4, most_steps=STEPS, seed=5)
    brightest = (
        lanes.totals[:, :2].min(axis=1)
        * corners.diffuse
        * (corners.boundary == boundary)
        * (corners.beta < 1).any(axis=0)
    )
    number = int(brightest.argmax())
    assert brightest[number] > 0.01
    ior = float(corners.ior[number])
    faces = slab_boundary({MATCHED: "matched", THIN: "thin", SMOOTH: "smooth"}[boundary], ior)
    start = SlabStart(SETS, 5, diffuse=True, boundary=faces)
    geometry = SlabGeometry(corners.width_mm[:, number].tolist(), moving_border=True)
    media = Media([column[number] for column in corners.media()])
    totals, derivatives = Walk(geometry, media, None, start, stress_plan(STEPS), faces).run(4).arrays()
    # The same random numbers take the same path; the two kernels round some sums differently.
    np.testing.assert_allclose(lanes.totals[number], totals[number] / 4, rtol=1e-5)
    np.testing.assert_allclose(
        lanes.derivatives[:, number], np.stack(derivatives)[:, number, :2] / 4, rtol=1e-4, atol=1e-6
    )


def test_slab_tables_as_lanes_of_one_kernel() -> None:
    copies, cases = 128, total_cases()
    slabs = [case.layers[0] for case in cases]
    table = [
        (m.alpha, m.g1, m.thickness_mm, case.ior, case.boundary == "smooth", case.source == "diffuse")
        for m, case in zip(slabs, cases, strict=True)
    ]
    alpha, g, thickness, ior, smooth, diffuse = np.repeat(np.array(table), copies, axis=0).T

    def both(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.stack([values, values])

    # Light meets the first layer without forced collisions, so this layer is made too thin to matter.
    film = 1e-6 * np.minimum(thickness, 1)
    sets = Corners(
        region=np.zeros(len(alpha), dtype=np.int64), sigma=both(np.ones_like(alpha)), absorbed=both(1 - alpha),
        beta=both(np.ones_like(alpha)), g1=both(g), g2=both(0 * g), width_mm=np.stack([film, thickness]),
        boundary=np.where(smooth == 1, SMOOTH, MATCHED), ior=ior, diffuse=diffuse == 1,
    )  # fmt: skip
    totals = trace(sets, paths=8, most_steps=1 << 20, seed=6, gradient=False).totals.reshape(len(cases), copies, 3)
    assert totals[:, :, 2].max() == 0
    mean, error = totals[:, :, :2].mean(axis=1), totals[:, :, :2].std(axis=1, ddof=1) / np.sqrt(copies)
    mean[:, 0] += [specular_share(case.ior, case.source) for case in cases]
    truth = np.concatenate([case.values for case in cases])
    # Transmittances near 1 have only rounding errors. One of 1e-4 through a deep slab is one path in ten thousand, so
    # its estimated error is useless and it is left out.
    error = np.maximum(error, 1e-6)
    resolved = (truth > 1e-3) | np.array([[slab.thickness_mm < 1] for slab in slabs])
    assert resolved.sum() == 64
    assert error.max() <= 2e-2
    require_unbiased(z_scores(mean[resolved], truth[resolved], error[resolved]), independent=len(cases))


@pytest.mark.parametrize("scene", tuple(scenes()), ids=lambda scene: scene.name)
def test_difficult_scenes_render(scene: Scene) -> None:
    check = check_scene(scene, samples=64, seed=3)
    assert check.negative == 0
    # Four scenes must look like another one under five lights each, which gives one false alarm in 7000 runs.
    assert check.z is None or check.z <= LARGEST_Z


def test_slivers_leave_the_surface_where_it_was() -> None:
    plain = ellipsoid(np.array([3.0, 2.0, 4.0]))
    split = with_slivers(plain)
    assert len(split.faces) > 1.5 * len(plain.faces)
    assert (split.edge_counts() == 2).all()
    assert split.signed_volume_mm3() == pytest.approx(plain.signed_volume_mm3(), rel=1e-9)


def test_sets_out_of_range_are_refused(corners: Corners, monkeypatch: pytest.MonkeyPatch) -> None:
    from services.transport.paths.walk import Walk

    monkeypatch.setattr(Walk, "run", lambda *_: pytest.fail("a kernel ran"))
    wrong = {
        "sigma": (0.0, -1e4, 1e39, np.nan, np.inf), "alpha": (-1e-7, 1 + 1e-6, np.nan),
        "beta": (-1e-7, 1 + 1e-6, np.nan), "g1": (1.0, -1.0, 1 - 1e-9, 1.0001, np.nan), "g2": (1.0, 1e-9 - 1, -np.inf),
        "thickness_mm": (0.0, -1e-3, np.nan),
    }  # fmt: skip
    media, rng = corners.media(), np.random.default_rng(7)
    for number in rng.integers(0, SETS, 200):
        layers = [
            Layer(sigma=m.sigma, alpha=m.alpha, beta=m.beta, g1=m.g1, g2=m.g2, thickness_mm=width)
            for m, width in zip((column[number] for column in media), corners.width_mm[:, number].tolist(), strict=True)
        ]
        field, layer = str(rng.choice(list(wrong))), int(rng.integers(2))
        layers[layer] = layers[layer].model_copy(update={field: float(rng.choice(wrong[field]))})
        with pytest.raises(InputError, match=rf"^layer {layer + 1}\.{field} = .*[;,].*\.$"):
            simulate_slab(tuple(layers), gradient=True)


def test_black_layers_end_and_tell_what_albedo_would_bring() -> None:
    # Between two media without scattering, the border's secondary walk has no direction and must end at once.
    import mitsuba as mi

    from services.transport.scene.border import BorderScattering, no_crossing
    from services.transport.scene.geometry import SlabGeometry
    from services.transport.scene.media import Media

    crossing = no_crossing(1)
    crossing.before, crossing.after = mi.UInt32(1), mi.UInt32(2)
    black = BorderScattering(
        SlabGeometry((1.0, 1.0), moving_border=True), Media([Medium(1, 0), Medium(2, 0)]), crossing
    )
    assert float(black.balance(mi.Vector3f(0, 0, 1))[0]) == 0
    layer = Layer(sigma=1, alpha=0, thickness_mm=0.5)
    assert (
        simulate_slab((layer, layer.model_copy(update={"sigma": 2.0})), gradient=True, rel_error=0.1, max_seconds=1).R
        < 1e-20
    )

    # Single scattering, integrated over depth and direction, gives dR/dalpha at albedo 0, which is not 0.
    nodes, weights = np.polynomial.legendre.leggauss(100)
    cosine = (nodes + 1) / 2
    truth = np.sum(weights / 4 * cosine / (1 + cosine) * -np.expm1(-(1 + 1 / cosine)))
    for alpha in (0.0, 1e-6):
        result = simulate_slab((Layer(sigma=1, alpha=alpha, thickness_mm=1),), gradient=True, rel_error=0.02)
        assert result.dR_se["alpha"] <= 0.01 * truth
        # The next order of scattering changes it by a term of the size of alpha.
        assert abs(result.dR["alpha"] - truth) <= LARGEST_Z * result.dR_se["alpha"] + 1e-5


def test_dentin_has_room_inside_enamel() -> None:
    axes = np.array([3.0, 2.0, 4.0])
    outer = ellipsoid(axes)

    def scene(dentin: Mesh) -> SceneRecipe:
        return single_tooth(outer, DentinShape.known(dentin), LIGHTS_MM, np.ones(5))

    centred = ellipsoid(axes - 0.3)
    shifted = Mesh(centred.vertices_mm + np.array([0.0, 0.5, 0.0]), centred.faces)
    for dentin, part in (
        (outer, "touches"), (ellipsoid(axes - 5e-5), "touches"),
        (shifted, "passes through"), (ellipsoid(axes + 0.5), "passes through"),
    ):  # fmt: skip
        with pytest.raises(MeshError, match=part):
            Engine(scene(dentin))
    Engine(scene(ellipsoid(axes - 2e-4)))
    inside = np.array([[0, 0, 0], [2.9, 0, 0], [3.1, 0, 0], [0, 0, 40.0]])
    np.testing.assert_allclose(winding_number(outer, inside), [1, 1, 0, 0], atol=1e-9)


def test_light_does_not_scatter_where_no_surface_is_ahead(monkeypatch: pytest.MonkeyPatch) -> None:
    # Coincident surfaces hide one another. A path outside that counts as inside must not scatter in endless enamel,
    # which would be 100 times too bright.
    monkeypatch.setattr("services.transport.scene.mesh_geometry.require_nested", lambda *_: None)
    outer = ellipsoid(np.array([3.0, 2.0, 4.0]))
    known = DentinShape.known(outer)
    enamel, dentin, view = Medium(3, 0.99, g1=0.8), Medium(8, 0.98, g1=0.7), whole_view(camera_at((0, 1, 0)))
    intensities = np.full(5, 1e5)
    coincident = (
        Engine(single_tooth(outer, known, LIGHTS_MM, intensities))
        .images(Tissue(enamel, dentin), view, samples=64, seed=1)
        .mean.sum()
    )
    alone = Engine(single_tooth(outer, None, LIGHTS_MM, intensities))
    either = [alone.images(Tissue(medium, medium), view, samples=64, seed=2).mean.sum() for medium in (enamel, dentin)]
    assert 0.5 * min(either) < coincident < 1.5 * max(either)


def test_lights_beyond_single_precision_are_refused() -> None:
    outer = ellipsoid(np.array([3.0, 2.0, 4.0]))
    for positions, intensity, part in (
        (LIGHTS_MM * 1e18, 1.0, "mm away"),
        (LIGHTS_MM, 1e-40, "intensity = 1e-40"),
        (LIGHTS_MM, 1e35, "intensity = 1e\\+35"),
    ):
        with pytest.raises(InputError, match=part):
            Engine(single_tooth(outer, None, positions, np.full(5, intensity)))
