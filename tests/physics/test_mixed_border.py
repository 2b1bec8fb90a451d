"""A gradual border between enamel and dentin: images compared to stock Mitsuba, which reads albedo and lobe weight from
volumes, and derivatives to the shape compared to differences.

The rule for images is that of ``tests.support.pictures``; a correct engine fails one run in 500, and seeds are fixed.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from services.anatomy.dentin_shape import DentinShape
from services.anatomy.distance import SurfaceDistance
from services.assets.mitsuba.scene import load_scene, nested_scene, render_batches
from services.core.errors import InputError
from services.core.files.meshes import write_mesh
from services.core.geometry import Mesh
from services.transport.engine import Engine
from services.transport.optics.parameters import Medium, Tissue
from services.transport.optics.phase_table import PhaseTable
from services.transport.paths.scores import Scores
from services.transport.platform import prepare_device
from services.transport.scene.mixed_border import MixedBorder
from services.transport.scene.recipe import single_tooth
from tests.support.pictures import BATCHES, pixel_scores, require_same_pictures
from tests.support.small_mouth import MOUTH, mouth_recipe
from tests.support.small_tooth import (
    INTENSITY,
    LIGHTS_MM,
    SEMI_AXES_MM,
    camera_at,
    dentin_shape,
    ellipsoid,
    recipe,
    whole_view,
)

WIDTH_MM = 2.0
# Both media have the same two lobes and differ in their weight and in albedo, because stock Mitsuba can mix these by
# volumes, but not a lobe's g.
TISSUE = Tissue(Medium(1.5, 0.98, 0.9, 0.6, -0.3), Medium(4.0, 0.75, 0.3, 0.6, -0.3))


@pytest.mark.slow
def test_a_gradual_border_looks_as_in_mitsuba(tmp_path: Path) -> None:
    prepare_device()
    outer, core = ellipsoid(SEMI_AXES_MM), ellipsoid(SEMI_AXES_MM - 0.7)
    known = DentinShape.known(core)
    lights = LIGHTS_MM[[1, 3]]
    scene = replace(single_tooth(outer, known, lights, np.full(2, INTENSITY)), border_width_mm=WIDTH_MM)
    camera = camera_at((0.2, 1, 0.1), size=16, span_mm=5.0)
    ours = Engine(scene).images(TISSUE, whole_view(camera), samples=2048, seed=21, batches=BATCHES)

    write_mesh(tmp_path / "outer.ply", outer)
    write_mesh(tmp_path / "dentin.ply", core)
    share = share_of_enamel(core)
    scores = []
    for number, light in enumerate(lights):
        described = nested_scene(
            {"11": (tmp_path / "outer.ply", tmp_path / "dentin.ply")}, TISSUE, (camera,), light, INTENSITY
        )
        for name in ("medium_enamel", "medium_dentin"):
            described[name]["albedo"] = volume(share * TISSUE.enamel.alpha + (1 - share) * TISSUE.dentin.alpha)
            described[name]["phase"]["weight"] = volume(
                1 - (share * TISSUE.enamel.beta + (1 - share) * TISSUE.dentin.beta)
            )
        mean, variance = render_batches(load_scene(described), 0, samples=2048, seed=31 + number, batches=BATCHES)
        scores.append(
            pixel_scores(
                [ours.mean[number].reshape(mean.shape), mean], [ours.variance[number].reshape(mean.shape), variance]
            )
        )
    require_same_pictures(np.stack(scores), least=500)


def share_of_enamel(core: Mesh, cells: int = 64) -> NDArray[np.float64]:
    """l = logistic(8 q / width) at the centres of a box of cells around the tooth, (z, y, x)."""
    axes = [(np.arange(cells) + 0.5) / cells * 10 - 5] * 3
    z, y, x = (grid.ravel() for grid in np.meshgrid(*axes, indexing="ij"))
    points = np.stack([x, y, z], axis=1)
    distance = SurfaceDistance(core).closest(points)[1]
    # The core is a centred ellipsoid, so its equation says whether a point is inside.
    inside = ((points / (SEMI_AXES_MM - 0.7)) ** 2).sum(axis=1) < 1
    q = np.where(inside, -distance, distance)
    return (1 / (1 + np.exp(-8 * q / WIDTH_MM))).reshape(cells, cells, cells)


def volume(values: NDArray[np.float64]) -> dict[str, Any]:
    import mitsuba as mi

    grid = mi.VolumeGrid(values[..., None].astype(np.float32))
    to_world = mi.ScalarTransform4f().translate([-5, -5, -5]).scale(10)
    return {"type": "gridvolume", "grid": grid, "to_world": to_world, "raw": True, "filter_type": "trilinear"}


def test_the_distance_moves_as_the_surface_does() -> None:
    import drjit as dr
    import mitsuba as mi

    prepare_device()
    shape = dentin_shape()
    directions = np.random.default_rng(3).normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    # Choose points near the surface that the first mode has shrunk half-way.
    middle = SEMI_AXES_MM - 0.3 - 0.45
    points = directions * (middle + np.random.default_rng(4).uniform(-0.4, 0.4, (4000, 1)))
    x = mi.Point3f(points.T.astype(np.float32))

    def border_at(c: float) -> MixedBorder:
        border = MixedBorder(1.0)
        border.move(Mesh(shape.vertices_mm((c, 0.0)), shape.base.faces), shape.modes_mm)
        return border

    def distance(border: MixedBorder) -> NDArray[np.float64]:
        share = np.array(border.share(x, mi.Bool(True))[0], dtype=np.float64)
        return np.log(share / (1 - share)) / 8

    step = 0.05
    moved = (distance(border_at(0.5 + step)) - distance(border_at(0.5 - step))) / (2 * step)
    here = border_at(0.5)
    (speed, _), q = (np.array(values) for values in here.motion(x, mi.Bool(True))), distance(here)
    dr.sync_thread()
    # Both are interpolated on a grid of 0.15 mm, with errors of a few hundredths at a point and much less on average;
    # the surface itself has edges.
    band = (np.abs(q) > 0.1) & (np.abs(q) < 0.4)
    assert band.sum() > 1000
    gap = (moved - speed)[band]
    assert abs(gap.mean()) < 0.01 * np.abs(speed[band]).mean()
    assert gap.std() < 0.06


@pytest.mark.parametrize("width_mm", [-0.1, 6.0, np.nan, np.inf])
def test_borders_of_no_possible_width_are_refused(width_mm: float) -> None:
    with pytest.raises(InputError, match="border_width_mm"):
        Engine(replace(recipe("matched"), border_width_mm=width_mm))


def test_no_part_of_a_mouth_with_gradual_borders_has_a_table() -> None:
    # Gums do not mix, but the code that mixes media reads lobes alone.
    engine = Engine(replace(mouth_recipe("matched"), border_width_mm=1.0))
    tabulated = replace(MOUTH, gums=Medium(1, 0.9, table=PhaseTable((0.0, np.pi), (1.0, 1.0))))
    with pytest.raises(InputError, match="phase table; make the border sharp"):
        engine.images(tabulated, whole_view(camera_at((0, 1, 0))), samples=1, seed=1)


@pytest.mark.dear("Each move of the border makes new distances.")
@pytest.mark.parametrize("whole", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_the_mixture_changes_where_the_border_moves(whole: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    # Albedos differ much and extinctions little, so nearly all of the derivative of the images' sum comes from the
    # mixture's albedo, and without this term the test fails.
    if not whole:
        monkeypatch.setattr(Scores, "albedo_slope", lambda *_: mi_zero())
    tissue = Tissue(Medium(1.5, 0.6, 0.9, 0.7, -0.3), Medium(1.2, 0.95, 0.3, 0.5, -0.2), (0.5, 0.4))
    engine, view = Engine(replace(recipe(), border_width_mm=1.2)), whole_view(camera_at((0.2, 1, 0.1)), 1)
    scores = np.array(
        [engine.jacobian(tissue, view, ("shape.0",), samples=256, seed=seed).jacobian.sum() for seed in range(8)]
    )

    def totals(c: float) -> NDArray[np.float64]:
        moved = tissue.with_values({"shape.0": c})
        return np.array([engine.images(moved, view, samples=384, seed=100 + seed).mean.sum() for seed in range(8)])

    differences = (totals(0.6) - totals(0.4)) / 0.2
    gap = scores - differences
    error = gap.std(ddof=1) / np.sqrt(len(gap))
    assert error <= 0.05 * abs(differences.mean())
    # Both grids of distances have errors of a hundredth on average (see the test of distances above). The step makes
    # one of 0.7 %, a third of the change that twice the step makes.
    allowed = stats.t.isf(5e-4, len(gap) - 1) * error + 0.02 * abs(differences.mean())
    assert (abs(gap.mean()) <= allowed) == whole


def mi_zero() -> Any:
    import mitsuba as mi

    return mi.Float(0)


def test_a_gradual_border_mixes_lobes_not_tables() -> None:
    engine = Engine(replace(recipe("matched"), border_width_mm=1.0))
    tabulated = replace(TISSUE, dentin=Medium(1, 0.9, table=PhaseTable((0.0, np.pi), (1.0, 1.0))), shape=(0.5, 0.5))
    with pytest.raises(InputError, match="phase table; make the border sharp"):
        engine.images(tabulated, whole_view(camera_at((0, 1, 0))), samples=1, seed=1)
