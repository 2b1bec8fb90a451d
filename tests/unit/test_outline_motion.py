"""Motion by the outline of a tooth: translucent teeth of stock Mitsuba stay, and moved ones are found."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from services.core.geometry import Camera, Light
from services.core.results import FrameRecord
from services.preprocess.stabilisation.motion import MIN_REACH_PX, Displacement, Scene, ViewMotion
from services.preprocess.stabilisation.null_hypothesis import MOVED_PX, decided
from services.preprocess.stabilisation.outline import OutlineMatcher, OutlineShift
from services.preprocess.views.projection import Footprint, project
from services.preprocess.views.source import View
from services.preprocess.views.window import Window
from tests.support.truths import Truth, read

AGREED = ((0.0, 0.0), (0.0, 0.0))


@cache
def canine() -> Truth:
    return read("canine")


def lights() -> list[Light]:
    return [Light.model_validate(light) for light in canine().description["lights"]]


def first_camera() -> Camera:
    return Camera.model_validate(canine().description["cameras"][0])


def surfaces(camera: Camera) -> Footprint:
    return project(camera, [canine().meshes["outer"]])


def shift_of(image: np.ndarray, light: int, sought_from: Camera | None = None) -> OutlineShift:
    camera = sought_from or first_camera()
    matcher = OutlineMatcher(camera, [0], surfaces(camera).mesh == 0, MIN_REACH_PX, surfaces)
    return matcher.match(image, lights()[light].position_mm)


def displacements(images: np.ndarray) -> list[Displacement]:
    camera = first_camera()
    width, height = camera.size
    view = View(0, camera, Window(0, height, 0, width), camera, surfaces(camera))
    frames = [
        FrameRecord(index=k, kind="light", light=one.name, exposure_s=0.05, level=1, time_s=k, readback=(0, 0, 0))
        for k, one in enumerate(lights())
    ]
    motion = ViewMotion(view, [[0]], frames, "auto")
    found = dict(motion.measure(range(len(frames)), lambda frame: images[frame.index], Scene(lights(), surfaces)))
    return [motion.at(frame, found) for frame in frames]


def test_a_change_of_light_moves_no_translucent_tooth() -> None:
    """28 pixels high under eight lights from all sides: matching the edges of the shading moved such images by up to
    two pixels.
    """
    found = displacements(canine().mean["c0"])
    assert [move.median_px for move in found] == [0.0] * 8
    assert all(0.1 <= move.error_px <= MOVED_PX and not move.uncertain for move in found)


def test_moved_images_are_found_among_still_ones() -> None:
    """Whole pixels move an image exactly; the tolerance is three of the errors that static images of this tooth leave
    by component (0.13 px), for two components.
    """
    images = np.array(canine().mean["c0"])
    images[3], images[6] = (np.roll(images[k], shift, axis=(0, 1)) for k, shift in ((3, (2, 0)), (6, (-1, 1))))
    found = displacements(images)
    assert [k for k, move in enumerate(found) if move.median_px > 0] == [3, 6]
    for k, true in ((3, (0, 2)), (6, (1, -1))):
        assert np.linalg.norm(found[k].coefficients[0, 0] - true) < 0.39 * np.sqrt(2)


def test_the_scan_may_stand_aside_of_all_images() -> None:
    """Only the motion between images is taken out; where the scan stands is the fit's to find."""
    found = displacements(np.roll(canine().mean["c0"], (1, 2), axis=(1, 2)))
    assert [move.median_px for move in found] == [0.0] * 8


def test_an_image_without_an_outline_is_masked_among_others_and_moves_nothing() -> None:
    images = np.array(canine().mean["c0"])
    y, x = np.indices(images[2].shape)
    images[2] = 1 + 0.5 * np.sin(0.8 * x) * np.cos(0.7 * y)
    found = displacements(images)
    assert [move.uncertain for move in found] == [k == 2 for k in range(8)]
    assert found[2].error_px >= MOVED_PX
    assert {move.median_px for move in found} == {0.0}


def test_where_no_image_shows_an_outline_nothing_moves_or_is_masked() -> None:
    flat = np.ones_like(canine().mean["c0"])
    assert all(move.median_px == 0 and not move.uncertain and move.error_px >= MOVED_PX for move in displacements(flat))


def test_a_body_of_a_few_pixels_tells_nothing() -> None:
    camera = first_camera()
    visible = np.zeros(camera.size[::-1], dtype=bool)
    visible[10:14, 10:15] = True
    matcher = OutlineMatcher(camera, [0], visible, MIN_REACH_PX, surfaces)
    assert matcher.match(canine().mean["c0"][0], lights()[0].position_mm).error_px == np.inf


def test_gain_and_black_level_do_not_matter() -> None:
    image = canine().mean["c0"][1]
    camera = first_camera()
    matcher = OutlineMatcher(camera, [0], surfaces(camera).mesh == 0, MIN_REACH_PX, surfaces)
    plain = matcher.match(image, lights()[1].position_mm)
    counts = matcher.match(7.3 * image / image.max() + 0.25, lights()[1].position_mm, level=0.25)
    assert counts.shift_px == pytest.approx(plain.shift_px, abs=1e-4)


def test_both_halves_of_an_outline_have_to_agree() -> None:
    """A highlight beside the outline draws one half of it along."""
    shifts, errors = np.array([[0.0, 0], [2.0, 0], [2.0, 0]]), np.full(3, 0.1)
    arcs = np.array([AGREED, ((2.0, 0), (1.8, 0)), ((3.9, 0), (0.1, 0))])
    found, error = decided(shifts, errors, arcs)
    assert found.tolist() == [[0, 0], [2, 0], [0, 0]]
    assert error[2] == pytest.approx(np.sqrt(2 + 0.1**2 + 0.1**2 / 2), rel=0.01)


def test_a_motion_within_its_errors_is_none_and_widens_no_error() -> None:
    shifts = np.array([[0.0, 0], [0.7, 0], [0.7, 0.0], [0.0, 0.3]])
    found, error = decided(shifts, np.array([0.1, 0.1, 0.4, 0.1]), np.repeat(shifts[:, None], 2, axis=1))
    # The second is moved; the third's own error explains as much
    assert np.flatnonzero(np.abs(found).any(axis=1)).tolist() == [1]
    assert (error >= 0.1).all()


def test_an_image_that_is_hardly_known_is_no_reference_and_no_worse_than_an_unknown_one() -> None:
    shifts = np.array([[0.0, 0], [1.0, 0], [1.1, 0]])
    found, error = decided(shifts, np.array([1e3, 0.1, 0.1]), np.repeat(shifts[:, None], 2, axis=1))
    assert not found.any()
    assert error[0] == MOVED_PX


def test_images_of_which_nothing_is_known_stay() -> None:
    shifts = np.array([[0.0, 0], [1.0, 0], [1.1, 0], [3.0, 0]])
    found, error = decided(shifts, np.array([np.inf, 0.1, 0.1, 0.1]), np.repeat(shifts[:, None], 2, axis=1))
    # The first known image is the reference
    assert np.flatnonzero(np.abs(found).any(axis=1)).tolist() == [3]
    assert found[3] == pytest.approx([1.95, 0])
    assert error[0] >= MOVED_PX


def test_a_light_from_behind_tells_nothing() -> None:
    """Of such a light an opaque tooth shows a bright crescent, whose width its gloss sets."""
    camera = first_camera()
    matcher = OutlineMatcher(camera, [0], surfaces(camera).mesh == 0, MIN_REACH_PX, surfaces)
    sight = np.array(camera.camera_from_world)[2, :3]
    behind = tuple((300 * sight).tolist())
    assert matcher.match(canine().mean["c0"][0], behind).error_px > 100
