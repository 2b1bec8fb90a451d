"""The pose of the scan as unknowns of the fit: how pixels move, how photographs change, and what the report says."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from services.core.geometry import Mesh
from services.core.records import JobSpec
from services.core.results import Estimate
from services.core.stage import LocalContext
from services.fit.checks.instrument.moved import pose_sentences, shift_sentences
from services.fit.coordinates.instrument_errors import errors_of
from services.fit.measurements.blocks import BlockInstrument, PixelBlock, read_block, write_block
from services.fit.measurements.instrument.motion import MAX_SHIFTED, shift_errors_px
from services.fit.measurements.instrument.photographs import error_derivatives, photographed, placed
from services.fit.measurements.instrument.pose import brightenings, displacements
from services.fit.measurements.slopes import image_slopes, motions_of
from services.fit.measurements.view_stack import ViewStack
from services.fit.solve.recombination import Fault
from services.fit.stage import run
from services.transport.scene.recipe import View, single_tooth
from services.transport.scene.rigid_moves import SCAN, moved_camera, rigid
from tests.support.fake_engine import FakeEngine
from tests.support.prepared import SIZE, TRUTH, camera, lights, sphere, write_prepared

Array = NDArray[np.float64]

CENTRE_MM = np.array([0.3, -0.2, 0.5])
STEPS = np.array([1e-4] * 3 + [1e-3] * 3)
"""Steps of differences, rad and mm, over which pixels move by 1e-4 px and images are straight."""


def test_a_point_moves_over_the_image_as_the_projection_of_the_moved_point() -> None:
    points = np.random.default_rng(1).uniform(-4, 4, (20, 3))
    found = displacements(camera("c0"), points, CENTRE_MM)
    for k, step in enumerate(STEPS):
        high, low = (rigid(sign * step * np.eye(6)[k], CENTRE_MM) for sign in (1, -1))
        seen = [camera("c0").project(points @ move[:3, :3].T + move[:3, 3])[0] for move in (high, low)]
        np.testing.assert_allclose(found[k].T, (seen[0] - seen[1]) / (2 * step), rtol=1e-4, atol=1e-5)
        # A camera that is moved instead sees the unmoved points there.
        np.testing.assert_allclose(moved_camera(camera("c0"), high).project(points)[0], seen[0], atol=1e-9)


def test_slopes_are_those_of_a_plane_and_leave_their_own_pixel_out() -> None:
    y, x = np.mgrid[:6, :7].astype(float)
    usable = np.ones((6, 7), dtype=bool)
    usable[2:4, 3] = False
    image = np.where(usable, 1.0 + 0.3 * x - 0.2 * y, 99.0)
    spiked = image.copy()
    spiked[4, 1] = 50.0
    found = image_slopes(image, usable)
    # The nine values around a pixel, but for its own, tell a slope with a sixth of a pixel's variance.
    np.testing.assert_allclose(found[2:, 1:-1, 1], 1 / 6)
    # The three neighbours of a corner are too few.
    enough = np.ones_like(usable)
    enough[::5, ::6] = False
    np.testing.assert_allclose(found[0], np.where(enough, 0.3, 0.0), rtol=1e-9)
    np.testing.assert_allclose(found[1], np.where(enough, -0.2, 0.0), rtol=1e-9)
    np.testing.assert_allclose(image_slopes(spiked, usable)[:2, 4, 1], (0.3, -0.2), rtol=1e-9)
    # One neighbour, or neighbours on one line, tell no slope.
    line = np.zeros_like(usable)
    line[2] = True
    assert not image_slopes(image, line)[:2, 2].any()


def test_a_ball_that_turns_under_its_lights_brightens_as_its_irradiance() -> None:
    # A ball about its centre does not change, and one that shifts sees its lights from elsewhere.
    ball, lights_mm = sphere(4.0), np.array([[30.0, 0.0, -60.0], [0.0, 50.0, -50.0]])
    points_mm, found = brightenings(ball, lights_mm, np.zeros(3))
    nearer = lights_mm[0] / np.linalg.norm(lights_mm[0])
    lit = points_mm @ nearer > 3.0
    # Moving towards a light at 63 mm (distance to the front of the ball) by 1 mm brightens by 2 / 63.
    towards = np.tensordot(nearer, found[3:, 0, lit], 1)
    np.testing.assert_allclose(towards, 2 / 63.2, rtol=0.1)


def seen_block(twist: Array) -> tuple[PixelBlock, FakeEngine, Array]:
    """Block of a ball's pixels, the engine that shows them, and photographs of the ball moved by a twist."""
    recipe = single_tooth(sphere(4.0), None, np.array([one.position_mm for one in lights()]), np.full(6, 1e6))
    engine, one = FakeEngine(recipe), camera("c0")
    y, x = (index.reshape(-1) for index in np.mgrid[: SIZE[1], : SIZE[0]])
    everywhere = np.stack([x, y], axis=-1).astype(np.int32)
    centre_mm = recipe.teeth[0].outer.vertices_mm.mean(axis=0)
    moved = View(moved_camera(one, rigid(twist, centre_mm)), everywhere)
    image = engine._formula(TRUTH, moved)
    slopes = np.array(
        [image_slopes(of.reshape(SIZE[::-1]), np.ones(SIZE[::-1], dtype=bool)).reshape(4, -1) for of in image]
    )
    inside = (np.hypot(x + 0.5 - SIZE[0] / 2, y + 0.5 - SIZE[1] / 2) < 6.0) & (x > 4)
    shape = (6, int(inside.sum()))
    view = ViewStack(
        one, everywhere[inside], image[:, inside], np.ones(shape), np.ones(shape, dtype=bool),
        np.zeros(6, dtype=bool), slopes=slopes.swapaxes(0, 1)[:, :, inside],
    )  # fmt: skip
    (motion,) = motions_of(recipe, (view,))
    # The formula's light does not follow the scan.
    motion = replace(motion, brightening=np.zeros_like(motion.brightening))
    names = tuple(f"light_gain.l{k}" for k in range(6))
    acting = BlockInstrument("gain.green", names, "flare.c0.green", 1.0, tuple(f"shift.c0.l{k}" for k in range(6)))
    none = np.zeros(shape, dtype=bool)
    return (
        PixelBlock(
            View(one, view.pixels), image[:, inside], np.ones(shape), np.ones(shape), none, None, None, acting, motion
        ),
        engine,
        image[:, inside],
    )


def test_columns_of_the_pose_are_differences_of_renders() -> None:
    block, engine, image = seen_block(np.zeros(6))
    columns = error_derivatives(image, block, SCAN).reshape(6, *image.shape)
    for k, step in enumerate(20 * STEPS):
        seen = []
        for sign in (1, -1):
            errors = {SCAN[k]: sign * step}
            seen.append(photographed(engine._formula(TRUTH, placed(block, errors).view), block, errors))
        difference = (seen[0] - seen[1]) / (2 * step)
        # The plane of eight neighbours smooths slopes, which change by a tenth from pixel to pixel; the formula has
        # kinks, where they differ most.
        # Only a shift along the line of sight, which magnifies, changes little.
        size = np.sqrt((difference**2).sum())
        assert size > (0.005 if SCAN[k] == "teeth.tz" else 1.0)
        assert np.sqrt(((columns[k] - difference) ** 2).sum()) < 0.25 * size, SCAN[k]
        assert (columns[k] * difference).sum() / size**2 == pytest.approx(1.0, abs=0.1), SCAN[k]


def test_a_known_shift_of_a_photograph_is_found_from_its_slopes() -> None:
    # Photographs of a ball 0.1 mm to the right, 0.2 px, as shifts of single photographs.
    block, engine, _ = seen_block(np.array([0, 0, 0, 0.1, 0, 0]))
    render = engine._formula(TRUTH, block.view)
    for light in range(6):
        names = [f"shift.c0.l{light}.{axis}" for axis in "xy"]
        columns = error_derivatives(render, block, names).reshape(2, 6, -1)
        assert not columns[:, [k for k in range(6) if k != light]].any()
        change, along = (block.reference - render)[light], columns[0, light]
        found = float(change @ along / (along @ along))
        # The formula's kinks bias a slope by up to a seventh.
        assert found == pytest.approx(0.2, abs=0.03)
        # What the fit compares with the photograph then is the photograph.
        left = photographed(render, block, {names[0]: found}) - block.reference
        assert (left[light] ** 2).sum() < 0.1 * ((render - block.reference)[light] ** 2).sum()


def test_a_block_keeps_how_it_moves(tmp_path: Path) -> None:
    block, _, _ = seen_block(np.zeros(6))
    again = read_block(write_block(tmp_path, block))
    assert again.motion is not None
    assert block.motion is not None
    assert again.instrument == block.instrument
    for name in ("slopes", "slope_noise", "displacement", "brightening", "centre_mm"):
        # Stored with 24 and 11 binary digits.
        np.testing.assert_allclose(getattr(again.motion, name), getattr(block.motion, name), rtol=1e-3, atol=1e-6)


def moved_mesh(mesh: Mesh, twist: Array) -> Mesh:
    move = rigid(twist, mesh.vertices_mm.mean(axis=0))
    return Mesh(mesh.vertices_mm @ move[:3, :3].T + move[:3, 3], mesh.faces)


def test_only_photographs_whose_motion_is_unsure_are_shifted(tmp_path: Path) -> None:
    assert shift_errors_px(tmp_path, 1) == {}
    errors = [0.0, None, 0.2, *np.linspace(0.3, 0.6, MAX_SHIFTED).tolist()]
    images = [{"camera": "c0", "light": f"l{k}", "motion_error_px": own} for k, own in enumerate(errors)]
    (tmp_path / "quality.json").write_text(json.dumps({"images": images}))
    found = shift_errors_px(tmp_path, 2)
    assert len(found) == MAX_SHIFTED
    assert min(found.values()) == pytest.approx(0.15)
    assert ("c0", "l2") not in found
    # With pixels of the fit ten times as wide the smaller errors are too small to be seen
    assert len(shift_errors_px(tmp_path, 10)) == sum(error is not None and error >= 0.5 for error in errors)


def test_the_report_says_where_the_scan_lies_and_when_that_is_too_far() -> None:
    errors = {"green": errors_of("green", ("a",), ("c0",), None, with_scan=True)}

    def told(x_mm: float) -> str:
        sizes = [0.0, 0.0, 0.001, x_mm, 0.0, 0.0]
        own = {
            name: Estimate(value=value, se=0.01 if "t" in name[-2:] else 1e-4, unit="1", determined=True)
            for name, value in zip(SCAN, sizes, strict=True)
        }
        (sentence,) = pose_sentences(errors, {"green": own})
        return sentence

    assert "put the scan 0.04 ± 0.01 mm and 0.06 ± 0.0057° from where" in told(0.04)
    assert "states ± 0.05 mm and ± 0.1°" in told(0.04)
    assert "registered" not in told(0.04)
    assert "4.0 times what the calibration states: check how the scan was registered" in told(-0.2)


def test_a_photograph_that_moved_is_named_once_and_many_as_one_cause() -> None:
    shifts = {f"shift.c0.{light}": 0.1 for light in "abcd"}
    errors = errors_of("green", tuple("abcd"), ("c0",), None, shifts_px=shifts)
    assert errors.se[-1] == pytest.approx(0.1)
    first = errors.names.index("shift.c0.a.x")
    (one,) = shift_sentences("green", (Fault(first, 0.5, 4.0), Fault(first + 1, -0.4, -3.5)), errors)
    assert "the photograph of camera c0 under light a is shifted by 0.50 px, 4.0 times" in one
    many = tuple(Fault(first + 2 * k, 0.5, 4.0 + k) for k in range(3))
    (common,) = shift_sentences("green", many, errors)
    assert "3 shifts of photographs off, most that of the photograph of camera c0 under light c" in common


@pytest.mark.dear("a whole fit by the formula, of a scan that lies aside and a photograph that moved")
def test_a_fit_finds_a_scan_that_lies_aside_and_names_a_photograph_that_moved(tmp_path: Path) -> None:
    scan = rigid(np.array([0.0, 0.0, 0.0, 0.1, 0.08, 0.0]), np.zeros(3))
    further = rigid(np.array([0.0, 0.0, 0.0, 0.35, 0.08, 0.0]), np.zeros(3))

    class Moved(FakeEngine):
        def _formula(self, tissue: object, view: View) -> Array:
            image = super()._formula(tissue, View(moved_camera(view.camera, scan), view.pixels))  # type: ignore[arg-type]
            if view.camera.name == "c1":
                # 0.5 px further to the right under one light.
                image[2] = super()._formula(tissue, View(moved_camera(view.camera, further), view.pixels))[2]  # type: ignore[arg-type]
            return image

    write_prepared(tmp_path, engine=Moved, scan_se=(1e-4, 0.1), motion_error_px=0.1)
    options = {
        "capture": tmp_path, "boundary": "matched", "dentin": "known", "samples_per_pixel": 32, "advise": False,
        "search_candidates": 1000, "max_steps": 6,
    }  # fmt: skip
    report = run(
        JobSpec.model_validate(options), LocalContext(tmp_path), engine="tests.support.fake_engine:QuietFakeEngine"
    )
    found = report.instrument["green"]
    assert [found[name].unit for name in (*SCAN, "shift.c1.l2.x")] == ["rad"] * 3 + ["mm"] * 3 + ["px"]
    # The formula's light is one pattern of 0.12 x + 0.1 y, so it tells shifts across this pattern.
    across = 0.12 * found["teeth.tx"].value + 0.1 * found["teeth.ty"].value
    assert across == pytest.approx(0.12 * 0.1 + 0.1 * 0.08, abs=0.2 * 0.01)
    assert any("put the scan" in sentence for sentence in report.instrument_told)

    shifts = [name for name in found if name.startswith("shift.")]
    # Two cameras under five fitted lights.
    assert len(shifts) == 20
    assert report.instrument_prior["green"][shifts[0]] == pytest.approx(0.1)
    (named,) = [told for told in report.instrument_told if "is shifted by" in told]
    assert "the photograph of camera c1 under light l2 is shifted by" in named
    across = (0.12 * found["shift.c1.l2.x"].value + 0.1 * found["shift.c1.l2.y"].value) / 0.12
    assert across == pytest.approx(0.5, abs=0.1)
    assert np.sqrt(np.mean([found[name].value ** 2 for name in shifts if "c1.l2" not in name])) < 0.1
