"""Tabulated phase functions: values and sampling in single precision, and slabs and a tooth compared to references that
do not use the project's tables.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from services.anatomy.dentin_shape import DentinShape
from services.assets.mitsuba.scene import load_scene, nested_scene, render_batches
from services.core.errors import InputError
from services.core.files.meshes import write_mesh
from services.slab.simulate import Layer, simulate_slab
from services.transport.engine import Engine
from services.transport.optics.parameters import Medium, Tissue
from services.transport.optics.phase_table import PhaseTable, tent_weights
from services.transport.platform import prepare_device
from services.transport.scene.recipe import single_tooth
from tests.support.exit_tables import angular_cases
from tests.support.phase_tables import (
    TENT_SPACING_RAD,
    cumulative,
    density,
    henyey_greenstein,
    over_equal_angles,
    over_equal_cosines,
)
from tests.support.pictures import BATCHES, pixel_scores, require_same_pictures
from tests.support.slab_tables import simulate, total_cases
from tests.support.small_tooth import INTENSITY, LIGHTS_MM, SEMI_AXES_MM, camera_at, dentin_shape, ellipsoid, whole_view
from tests.support.z_scores import require_unbiased, z_scores

TABLES = {
    "isotropic": over_equal_angles(2, {}, floor=3.0),
    "forward tent": over_equal_angles(200, {0: 1.0}),
    "backward tent": over_equal_angles(200, {-1: 1.0}),
    "inner tent": over_equal_angles(200, {17: 1.0}),
    "rings with nothing between": over_equal_angles(200, {0: 0.5, 30: 2.0, 31: 1.0, 120: 0.1, -2: 0.3}),
    "peak of thousands on a floor": over_equal_angles(200, {0: 5000.0, 1: 300.0, 2: 20.0}, floor=0.01),
    "two nodes": PhaseTable((0.0, math.pi), (0.0, 1.0)),
    "a peak of a thousandth of a degree": PhaseTable((0.0, 2e-5, math.pi), (1.0, 0.0, 0.0)),
}
SAMPLES = 1 << 20
CELLS = 256
FALSE_ALARM = 1e-6
"""False-alarm rate of each chi-square test; seeds are fixed."""


@pytest.fixture(scope="module", autouse=True)
def _device() -> None:
    prepare_device()


def directions(angle_rad: NDArray[np.float64], azimuth_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack(
        [np.sin(angle_rad) * np.cos(azimuth_rad), np.sin(angle_rad) * np.sin(azimuth_rad), np.cos(angle_rad)]
    )


@pytest.mark.parametrize("name", TABLES)
def test_tables_are_normalised_and_know_their_mean(name: str) -> None:
    table = TABLES[name]
    angle = np.unique(
        np.concatenate([np.linspace(0, math.pi, 20001), np.geomspace(1e-7, 1e-2, 20000), table.angles_rad])
    )
    assert abs(cumulative(table, np.array([math.pi]))[0] - 1) < 1e-12
    # Integrated by parts, the mean cosine is 1 minus the integral of (1 - F) sin; the trapezoidal rule is exact to
    # 1e-7.
    mean = 1 - np.trapezoid((1 - cumulative(table, angle)) * np.sin(angle), angle)
    assert table.mean_cosine == pytest.approx(mean, abs=1e-6)


def test_a_dictionary_of_tents_adds_up() -> None:
    # Any table is a mixture of normalised tents, with proportions of value times weight.
    nodes = np.linspace(0, math.pi, 200)
    weights = tent_weights(nodes)
    assert weights.sum() == pytest.approx(4 * math.pi, rel=1e-13)
    assert weights[0] == pytest.approx(math.pi * (1 - math.cos(TENT_SPACING_RAD)), rel=1e-12)
    table = TABLES["peak of thousands on a floor"]
    assert weights @ np.array(table.values) == pytest.approx(1, rel=1e-13)
    tents = [over_equal_angles(200, {n: 1.0}) for n in range(200)]
    mean = sum(
        weight * value * tent.mean_cosine for weight, value, tent in zip(weights, table.values, tents, strict=True)
    )
    assert table.mean_cosine == pytest.approx(mean, rel=1e-12)
    assert max(TABLES["forward tent"].values) == pytest.approx(1 / weights[0]) == pytest.approx(2554.4, rel=1e-4)


@pytest.mark.parametrize("name", TABLES)
def test_values_in_a_kernel(name: str) -> None:
    import mitsuba as mi

    from services.transport.scene.phase_tables import PhaseTables

    table = TABLES[name]
    rng = np.random.default_rng(5)
    angle = np.concatenate(
        [rng.uniform(0, math.pi, 4000), 10 ** rng.uniform(-6, 0, 2000), math.pi - 10 ** rng.uniform(-6, 0, 2000)]
    )
    before = np.broadcast_to(np.array([[0.6], [0.0], [0.8]]), (3, len(angle)))
    turned = directions(angle, rng.uniform(0, 2 * math.pi, len(angle)))
    frame = np.array([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])
    columns = [mi.Vector3f(np.ascontiguousarray(v, dtype=np.float32)) for v in (before, frame @ turned)]
    kernel = PhaseTables([None, table])
    ours = np.array(kernel.density(mi.UInt32(2), *columns), dtype=np.float64)
    # Rounded directions have errors of up to 3e-7 rad, so compare to the table's range over that angle.
    near = np.stack([density(table, np.clip(angle + shift, 0, math.pi)) for shift in (-3e-7, 0, 3e-7)])
    slack = 1e-5 * near.max(axis=0) + 1e-6 * max(table.values) * (near.max(axis=0) > 0)
    assert (ours >= near.min(axis=0) - slack).all()
    assert (ours <= near.max(axis=0) + slack).all()


def test_nodes_closer_than_single_precision_stay_finite() -> None:
    import mitsuba as mi

    from services.transport.scene.phase_tables import PhaseTables

    kernel = PhaseTables([PhaseTable((0.0, math.pi / 2 - 1e-9, math.pi / 2 + 1e-9, math.pi), (1.0, 2.0, 2.0, 1.0))])
    sideways = kernel.density(mi.UInt32(1), mi.Vector3f(0, 0, 1), mi.Vector3f(1, 0, 0))
    assert np.array(sideways) == pytest.approx(2 / (6 * math.pi), rel=1e-6)


@pytest.mark.parametrize("name", TABLES)
def test_sampled_angles_have_the_distribution_of_the_table(name: str) -> None:
    import drjit as dr
    import mitsuba as mi

    from services.transport.scene.phase_tables import PhaseTables

    table = TABLES[name]
    rng = mi.PCG32(SAMPLES, initstate=3)
    omega = dr.normalize(mi.Vector3f(rng.next_float32() - 0.5, rng.next_float32() - 0.5, rng.next_float32() - 0.5))
    tables = PhaseTables([table, None])
    turned = tables.sample(mi.UInt32(1), omega, rng.next_float32(), rng.next_float32())
    value = np.array(tables.density(mi.UInt32(1), omega, turned))
    before, after = np.array(omega, dtype=np.float64), np.array(turned, dtype=np.float64)
    half = np.linalg.norm(after - before, axis=0) / 2
    angle = 2 * np.where(
        half < 0.7, np.arcsin(np.minimum(half, 1)), np.arccos(np.minimum(np.linalg.norm(after + before, axis=0) / 2, 1))
    )

    # Angles at which the table is zero are hit only by rounding of a direction at their edge.
    assert np.count_nonzero(value == 0) <= 1e-4 * SAMPLES
    # The distribution function maps the angle to a uniform variable. The narrowest peak is as narrow as the rounding of
    # directions, so its cells are wide.
    cells = 4 if "thousandth" in name else CELLS
    uniform = cumulative(table, angle)
    counts = np.bincount(np.minimum((uniform * cells).astype(int), cells - 1), minlength=cells)
    assert stats.chisquare(counts).pvalue > FALSE_ALARM
    # The azimuth is uniform.
    side = np.cross(before.T, [0.0, 0.0, 1.0])
    across = np.einsum("ij,ij->i", after.T, side / np.linalg.norm(side, axis=1, keepdims=True))
    assert abs(across.mean()) <= 4.5 * across.std() / math.sqrt(SAMPLES) + 1e-7


@pytest.mark.parametrize("tolerance", [2e-3, pytest.param(1e-3, marks=pytest.mark.slow)])
def test_tabulated_lobes_reproduce_slab_totals(tolerance: float) -> None:
    # Two walks with phase functions of distance d differ in at most a share d of their scatterings, of which there are
    # (1 - R - T) alpha / (1 - alpha) on average. The tables are so fine that this is below a tenth of a standard error.
    rows = (
        "a=0.9 g=0.75 tau=2 n=1 ",
        "a=0.8 g=-0.9 tau=2 n=1 ",
        "a=0.9 g=-0.99 tau=5 n=1 ",
        "a=0.98 g=0.96 tau=6 n=1.631 ",
    )
    cases = [case for case in total_cases() if case.name.startswith(rows) and case.source == "normal"]
    assert len(cases) == len(rows)
    scores = []
    for number, case in enumerate(cases):
        (layer,) = case.layers
        table, distance = henyey_greenstein(layer.g1, spacing=0.002)
        scatterings = layer.alpha / (1 - layer.alpha) * (1 - case.values[0].sum())
        tabulated = replace(case, layers=(layer.model_copy(update={"table": table, "g1": 0.0}),))
        sums = simulate(tabulated, lambda sums: float(sums.standard_error().max() * 3 / tolerance), seed=901 + number)
        assert scatterings * distance < 0.1 * sums.standard_error().max()
        scores.append(z_scores(sums.mean(), case.values, sums.standard_error()))
    require_unbiased(np.concatenate(scores), independent=len(cases))


@pytest.mark.parametrize("tolerance", [0.02, pytest.param(0.01, marks=pytest.mark.slow)])
def test_connections_know_the_table(tolerance: float) -> None:
    # Compare to radiances of van de Hulst's slab; the table's own error is 2e-6.
    for number, case in enumerate(angular_cases(tolerance)):
        if case.layer.g1 != 0:
            table, _ = henyey_greenstein(case.layer.g1, spacing=0.002)
            tabulated = replace(case, layer=case.layer.model_copy(update={"table": table, "g1": 0.0}))
            require_unbiased(tabulated.scores(tabulated.simulate(921 + number)), independent=1)


@pytest.mark.parametrize("size", [8, pytest.param(16, marks=pytest.mark.slow)])
def test_a_tabulated_tooth_looks_as_in_mitsuba(size: int, tmp_path: Path) -> None:
    prepare_device()
    # The table has equal steps of the cosine, as Mitsuba's tabphase needs, with a forward lobe, a gap and a backward
    # lobe.
    cosine = np.linspace(1, -1, 41)
    values = np.where(cosine > 0.3, (cosine - 0.3) ** 2, 0) + np.where(cosine < -0.6, 0.1 * (-0.6 - cosine), 0)
    lobes = Medium(4.0, 0.85, 0.8, 0.5, -0.2)
    tissue = Tissue(Medium(1.5, 0.95, table=over_equal_cosines(values)), lobes)
    outer, core = ellipsoid(SEMI_AXES_MM), dentin_shape().vertices_mm((0.5, 0.4))
    dentin = DentinShape.known(type(outer)(core, outer.faces))
    write_mesh(tmp_path / "outer.ply", outer)
    write_mesh(tmp_path / "dentin.ply", dentin.base)
    camera, light = camera_at((0.2, 1, 0.1), size=size, span_mm=5.0), LIGHTS_MM[1]
    scene = single_tooth(outer, dentin, light[None], np.array([INTENSITY]))
    ours = Engine(scene).images(tissue, whole_view(camera), samples=2048, seed=931, batches=BATCHES)
    stock = nested_scene(
        {"11": (tmp_path / "outer.ply", tmp_path / "dentin.ply")},
        Tissue(Medium(1.5, 0.95), lobes),
        (camera,),
        light,
        INTENSITY,
    )
    stock["medium_enamel"]["phase"] = {
        "type": "tabphase",
        "values": ", ".join(f"{value:.9g}" for value in values[::-1]),
    }
    mean, variance = render_batches(load_scene(stock), 0, samples=2048, seed=941, batches=BATCHES)
    scores = pixel_scores([ours.mean.reshape(mean.shape), mean], [ours.variance.reshape(mean.shape), variance])
    require_same_pictures(scores, least=size**2 - 6)


@pytest.mark.parametrize(
    ("angles", "values", "part"),
    [
        ((0.0,), (1.0,), "1 values at 1 angles"),
        ((0.0, math.pi), (1.0, 1.0, 1.0), "3 values at 2 angles"),
        ((0.0, math.pi), (1.0, -0.5), "at 180 degrees is -0.5"),
        ((0.0, math.pi), (math.nan, 0.5), "at 0 degrees is nan"),
        ((0.0, math.pi), (math.inf, 0.5), "at 0 degrees is inf"),
        ((0.0, 1.0, math.pi), (0.0, 0.0, 0.0), "are zero"),
        ((0.0, 1.0), (1.0, 1.0), "from 0 to pi"),
        ((0.1, math.pi), (1.0, 1.0), "from 0 to pi"),
        ((0.0, 1.0, 1.0, math.pi), (1.0, 1.0, 1.0, 1.0), "from 0 to pi"),
        ((0.0, math.nan, math.pi), (1.0, 1.0, 1.0), "from 0 to pi"),
    ],
)
def test_tables_that_make_no_sense_are_refused(angles: tuple[float, ...], values: tuple[float, ...], part: str) -> None:
    with pytest.raises(InputError) as caught:
        PhaseTable(angles, values)
    sentence = str(caught.value)
    assert part in sentence
    assert sentence.endswith(".")
    assert sentence.count(". ") == 0


def test_a_layers_table_comes_from_plain_numbers_and_has_no_lobes_to_derive() -> None:
    plain: dict[str, Any] = {
        "sigma": 1,
        "alpha": 0.9,
        "thickness_mm": 1,
        "table": {"angles_rad": [0, 1, 3.14159265], "values": [4, 2, 0]},
    }
    layer = Layer.model_validate(plain)
    assert layer.table == PhaseTable((0.0, 1.0, math.pi), (4.0, 2.0, 0.0))
    result = simulate_slab((layer,), gradient=True, rel_error=0.05, max_seconds=5)
    assert set(result.dR) == {"sigma", "alpha"}
    with pytest.raises(InputError, match="from 0 to pi"):
        Layer.model_validate(plain | {"table": {"angles_rad": [0, 1], "values": [4, 2]}})


def test_derivatives_to_lobes_that_a_table_replaces_are_refused() -> None:
    scene = single_tooth(ellipsoid(SEMI_AXES_MM), None, LIGHTS_MM, np.full(len(LIGHTS_MM), INTENSITY))
    tissue = Tissue(Medium(1.5, 0.95, table=TABLES["isotropic"]), Medium(1.0, 0.5))
    view = whole_view(camera_at((0, 1, 0)))
    with pytest.raises(InputError, match=r"Medium 1 has a phase table in place of lobes, and so no g1; ask"):
        Engine(scene).jacobian(tissue, view, ("enamel.g1",), samples=4, seed=1)
    assert Engine(scene).jacobian(tissue, view, ("enamel.sigma",), samples=4, seed=1).jacobian.any()


def test_a_table_is_refused_where_only_lobes_can_be_written() -> None:
    with pytest.raises(InputError, match=r"An exported scene cannot hold a phase table; fit lobes to it first\."):
        nested_scene(
            {}, Tissue(Medium(1.5, 0.95, table=TABLES["isotropic"]), Medium(1.0, 0.5)), (), (0.0, 0.0, 1.0), 1.0
        )
