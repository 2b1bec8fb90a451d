"""Mistakes in a calibration session are found and named; a good session gives no false alarm."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

from services.calibrate.cameras.boards import detect, opencv_board
from services.calibrate.lights.listed import align_list
from services.calibrate.session.boards import CamerasStep
from services.calibrate.session.missed import why_missed
from services.calibrate.session.photos import Black
from services.calibrate.session.spheres import IntensityStep, LightsStep
from services.calibrate.session.suspicions import suspicions
from services.core.raw.records import RawFolder
from services.core.raw.targets import Board
from tests.support.array_session import N_LIGHTS, NAMES, ArraySession, array_session, exchanged, told_of
from tests.support.board_sessions import charuco
from tests.support.sphere_sessions import dome_lights


@pytest.fixture(scope="module")
def good() -> ArraySession:
    return array_session(0)


@pytest.fixture(scope="module")
def cameras(good: ArraySession) -> CamerasStep:
    return good.cameras()


@pytest.fixture(scope="module")
def lights(good: ArraySession, cameras: CamerasStep) -> LightsStep:
    return good.lights(cameras)


@pytest.fixture(scope="module")
def intensity(good: ArraySession, lights: LightsStep) -> IntensityStep:
    return good.intensity(lights)


def test_a_good_session_is_accused_of_nothing(
    good: ArraySession, cameras: CamerasStep, lights: LightsStep, intensity: IntensityStep
) -> None:
    assert told_of(good, cameras, lights, intensity, good.colours()) == []


@pytest.mark.slow
def test_twenty_good_sessions_are_accused_of_nothing() -> None:
    """The seeds differ from those with which the thresholds were chosen."""
    for seed in range(200, 220):
        session = array_session(seed)
        cameras = session.cameras()
        lights = session.lights(cameras)
        assert told_of(session, cameras, lights, session.intensity(lights), session.colours()) == [], seed


# Boards.


def image_of(board: Board) -> np.ndarray:
    """The board with a margin; a tenth of a square is 12 pixels."""
    columns, rows = board.squares
    drawn = opencv_board(board).generateImage((100 * columns, 100 * rows))
    return np.pad(drawn, 60, constant_values=255)


ASYMMETRIC = charuco((7, 6))


@pytest.mark.parametrize(
    ("seen", "told", "sentence"),
    [
        ("mirrored", ASYMMETRIC, "the image is mirrored; export it as the camera saw it"),
        ("plain", charuco((6, 7)), r"board plate has squares = \[7, 6\], not \[6, 7\]; correct raw.toml"),
        ("plain", charuco((7, 6), legacy_pattern=True), "has legacy_pattern = false; correct raw.toml"),
        ("plain", charuco((7, 6), dictionary="DICT_4X4_100"), "nothing of board plate shows: check that the board"),
        ("cut off", ASYMMETRIC, "markers and [0-5] corners of board plate show: it is cut off, hidden or out of focus"),
    ],
)
def test_why_a_board_was_not_found(seen: str, told: Board, sentence: str) -> None:
    image = image_of(ASYMMETRIC)
    image = np.ascontiguousarray({"mirrored": image[:, ::-1], "plain": image, "cut off": image[:, :280]}[seen])
    found = detect(image, told)
    if len(found.ids) >= 6:
        pytest.fail(f"OpenCV finds {len(found.ids)} corners all the same")
    assert re.search(sentence, why_missed(image, told, found))


def test_frames_of_two_places_under_each_others_names(good: ArraySession) -> None:
    spoiled = replace(good, boards=exchanged(good.boards, 3, 6))
    told = told_of(spoiled, spoiled.cameras())
    assert f"Frame {good.boards[3].name} shows the board as it lay for {good.boards[6].name}" in told[0]
    assert len(told) == 2


def test_frames_of_two_cameras_under_each_others_names(good: ArraySession) -> None:
    spoiled = replace(good, boards=exchanged(good.boards, 3, 4))
    told = told_of(spoiled, spoiled.cameras())
    assert any("is what camera middle sees and not left; frames of two cameras are interchanged" in one for one in told)


def test_a_board_that_moved_between_two_cameras(good: ArraySession) -> None:
    moved = replace(good.boards[4], pixels=good.boards[4].pixels + np.array([25.0, 10.0]))
    spoiled = replace(good, boards=(*good.boards[:4], moved, *good.boards[5:]))
    told = told_of(spoiled, spoiled.cameras())
    sentence = f"Most corners of {moved.name} fit no pose: the board or the camera moved there between photographs"
    assert [one.partition(";")[0] for one in told] == [sentence]


def test_boards_that_all_face_the_camera_alike(cameras: CamerasStep, good: ArraySession) -> None:
    wide = cameras.fit.covariance.copy()
    column = cameras.fit.layout.lens_columns(1)[0]
    wide[column, column] = (0.03 * cameras.fit.rig.lenses[1].values[0]) ** 2
    told = told_of(good, replace(cameras, fit=replace(cameras.fit, covariance=wide)))
    assert len(told) == 1
    assert "focal length of camera middle to 3.0% only: they all face it alike; tilt them" in told[0]


def test_a_board_without_corners_is_told_once_a_reason(good: ArraySession, cameras: CamerasStep) -> None:
    missed = (("a.png", "the image is mirrored"), ("b.png", "the image is mirrored"), ("c.png", "nothing shows"))
    told = told_of(good, replace(cameras, missed=missed))
    assert told == [
        "2 frames show no board, among them a.png: the image is mirrored.",
        "Frame c.png shows no board: nothing shows.",
    ]


# Spheres and lights.


def test_a_wrong_radius_or_a_wrong_square(good: ArraySession, cameras: CamerasStep) -> None:
    spoiled = replace(good, mirrors=tuple(replace(view, radius_mm=view.radius_mm * 1.04) for view in good.mirrors))
    told = told_of(spoiled, cameras, spoiled.lights(cameras))
    assert any("measure the sphere's radius_mm and the board's square_mm again" in one for one in told)


def test_a_sphere_that_moved_between_cameras(good: ArraySession, cameras: CamerasStep) -> None:
    moved = replace(good.mirrors[4], outline_px=good.mirrors[4].outline_px + np.array([0.0, 12.0]))
    spoiled = replace(good, mirrors=(*good.mirrors[:4], moved, *good.mirrors[5:]))
    told = told_of(spoiled, cameras, spoiled.lights(cameras))
    assert any("does not fit those of the other cameras: it moved" in one and "s1" in one for one in told)


def under_other_lights(good: ArraySession, cameras: tuple[int, ...], names: dict[int, int]) -> ArraySession:
    """The session with the mirror sphere's photographs at place 1 under other lights' names, in some cameras."""
    mirrors = [
        replace(view, lights=np.array([names.get(light, light) for light in view.lights.tolist()]))
        if view.place == 1 and view.camera in cameras
        else view
        for view in good.mirrors
    ]
    return replace(good, mirrors=tuple(mirrors))


def test_two_lights_under_each_others_names_at_one_place(good: ArraySession, cameras: CamerasStep) -> None:
    spoiled = under_other_lights(good, (0, 1, 2), {1: 4, 4: 1})
    told = [one for one in told_of(spoiled, cameras, spoiled.lights(cameras)) if "key light" in one]
    files = ", ".join(f"{camera}_s1_L{light}" for camera in NAMES for light in (4, 1))
    assert told == [
        f"At place ball, s1 the frames of lights L1 and L4 are interchanged; correct the key light of {files}."
    ]


def test_a_frame_of_a_mirror_sphere_under_another_lights_name(good: ArraySession, cameras: CamerasStep) -> None:
    mirrors = []
    for view in under_other_lights(good, (2,), {1: 4, 4: 9}).mirrors:
        kept = view.lights != 9
        mirrors.append(replace(view, lights=view.lights[kept], highlights_px=view.highlights_px[kept]))
    spoiled = replace(good, mirrors=tuple(mirrors))
    told = told_of(spoiled, cameras, spoiled.lights(cameras))
    assert told == ["Frame right_s1_L4 shows the highlight of light L1; correct its key light."]


def test_one_light_under_two_names(good: ArraySession, cameras: CamerasStep) -> None:
    mirrors = []
    for view in good.mirrors:
        first, second = (np.flatnonzero(view.lights == n) for n in (0, 1))
        pixels = view.highlights_px.copy()
        keep = np.ones(len(view.lights), dtype=bool)
        if len(first) and len(second):
            pixels[second] = pixels[first]
        else:
            keep[second] = False
        mirrors.append(replace(view, lights=view.lights[keep], highlights_px=pixels[keep]))
    spoiled = replace(good, mirrors=tuple(mirrors))
    told = told_of(spoiled, cameras, spoiled.lights(cameras))
    assert any("Lights L0 and L1 lie" in one and "photographed under two names" in one for one in told)


def test_a_reflection_of_something_else(good: ArraySession, cameras: CamerasStep) -> None:
    view = good.mirrors[0]
    pixels = view.highlights_px.copy()
    pixels[2] += [9.0, -7.0]
    spoiled = replace(good, mirrors=(replace(view, highlights_px=pixels), *good.mirrors[1:]))
    told = told_of(spoiled, cameras, spoiled.lights(cameras))
    assert len(told) == 1
    assert f"The highlight of light L{view.lights[2]} in left_s0_L{view.lights[2]} is" in told[0]


def test_a_light_that_was_off(good: ArraySession, cameras: CamerasStep, lights: LightsStep) -> None:
    told = told_of(good, cameras, replace(lights, no_highlight=("s0-L3.png",)))
    assert told == ["1 frames show no highlight, among them s0-L3.png: was the light on?"]


def relisted(good: ArraySession, lights: LightsStep, listed: np.ndarray) -> LightsStep:
    found = np.full((N_LIGHTS, 3), np.nan)
    found[lights.fit.lights] = lights.fit.positions_mm
    return replace(lights, aligned=align_list(listed, found))


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (lambda listed: listed / 25.4, "25.4 times as far apart as raw.toml lists them: check the unit"),
        (
            lambda listed: listed[[1, 0, 2, 3, 4, 5]],
            "Light L0 shines where the list has L1; their names are interchanged",
        ),
        (lambda listed: listed + 300 * (np.arange(6) == 4)[:, None], "Light L4 lies .* mm from where the list has it"),
    ],
)
def test_a_list_that_is_wrong(
    good: ArraySession,
    cameras: CamerasStep,
    lights: LightsStep,
    spoil: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    sentence: str,
) -> None:
    told = told_of(good, cameras, relisted(good, lights, spoil(good.listed_mm)))
    assert any(re.search(sentence, one) for one in told), told


def test_a_list_of_a_left_handed_frame(good: ArraySession, cameras: CamerasStep, lights: LightsStep) -> None:
    """Twelve lights, as the six of the session may be almost in one plane, which is its own mirror image."""
    random = np.random.default_rng(5)
    true = dome_lights(12, random)
    listed = true + random.normal(0, 4, true.shape)
    right, left = (align_list(one, true) for one in (listed, listed * [1, 1, -1]))
    assert right is not None
    assert not right.is_mirrored
    told = told_of(good, cameras, replace(lights, aligned=left))
    assert len(told) == 1
    assert "is of a left-handed frame" in told[0]


def exchanged_white(good: ArraySession, one: int, two: int) -> ArraySession:
    """The session with the first camera's first photographs under two lights exchanged."""
    white = list(good.white)
    white[one], white[two] = (
        replace(white[one], values=white[two].values),
        replace(white[two], values=white[one].values),
    )
    return replace(good, white=tuple(white))


def test_a_white_sphere_under_another_light(good: ArraySession, cameras: CamerasStep, lights: LightsStep) -> None:
    spoiled = exchanged_white(good, 0, 3)
    told = told_of(spoiled, cameras, lights, spoiled.intensity(lights))
    assert told == [
        f"The white sphere under light L{a} in camera left is shaded as by light L{b}; correct the light of this frame."
        for a, b in ((0, 3), (3, 0))
    ]


def test_a_white_sphere_of_which_the_named_light_reaches_little(
    good: ArraySession, cameras: CamerasStep, lights: LightsStep
) -> None:
    # The two lights nearest to each other: with any others, the side on which the named light shines would be dark. One
    # of them lights so little of what this camera sees that the shading names no light, and the brightness tells.
    where = lights.fit.positions_mm
    apart = np.linalg.norm(where[:, None] - where, axis=2) + 1e9 * np.eye(N_LIGHTS)
    one, two = (int(n) for n in np.unravel_index(int(apart.argmin()), apart.shape))
    spoiled = exchanged_white(good, one, two)
    told = told_of(spoiled, cameras, lights, spoiled.intensity(lights))
    # One of the two may be within the scatter that the other causes.
    assert told
    assert {sentence.partition(" is ")[0] for sentence in told} <= {
        f"The white sphere under light L{n} in camera left" for n in (one, two)
    }
    assert all(
        "another light was on, or its exposure, gain or level is not what raw.toml says" in sentence
        for sentence in told
    )


def test_two_lights_under_each_others_names_on_all_mirror_spheres(good: ArraySession, cameras: CamerasStep) -> None:
    other = np.arange(N_LIGHTS)
    other[[0, 3]] = 3, 0
    mirrors = tuple(replace(view, lights=other[view.lights]) for view in good.mirrors)
    lights = replace(good, mirrors=mirrors).lights(cameras)
    told = told_of(good, cameras, replace(lights, aligned=None), good.intensity(lights))
    assert [one.partition(":")[0] for one in told] == [
        "White spheres under light L0 are shaded as by L3, and those under L3 as by L0"
    ]


def test_a_white_sphere_of_a_wrong_exposure(good: ArraySession, cameras: CamerasStep, lights: LightsStep) -> None:
    white = (*good.white[:7], replace(good.white[7], values=good.white[7].values * 2), *good.white[8:])
    spoiled = replace(good, white=white)
    told = told_of(spoiled, cameras, lights, spoiled.intensity(lights))
    assert [one.partition(":")[0] for one in told] == ["The white sphere under light L1 in camera middle is +100 % off"]
    # The wrong photograph is left out and does no harm: lights are the same as without it, to their own ± of 0.06 %.
    found, without = (np.log(one.intensity(lights).fit.intensity) for one in (spoiled, good))
    assert np.abs(found - without).max() < 6e-4


# Charts, black frames and files.


@pytest.mark.parametrize(
    ("order", "name"),
    [
        (np.arange(24)[::-1], "turned by 180°"),
        (np.arange(24).reshape(4, 6)[:, ::-1].ravel(), "mirrored left to right"),
        (np.arange(24).reshape(4, 6)[::-1].ravel(), "mirrored top to bottom"),
    ],
)
def test_a_chart_in_another_order(good: ArraySession, cameras: CamerasStep, order: np.ndarray, name: str) -> None:
    spoiled = replace(good, rgb=good.rgb[order])
    told = told_of(spoiled, cameras, colours=spoiled.colours())
    assert len(told) == 1
    assert f"patches in camera left fit far better {name}" in told[0]


def test_a_mosaic_with_red_for_blue(good: ArraySession, cameras: CamerasStep) -> None:
    spoiled = replace(good, rgb=good.rgb[:, ::-1])
    (told,) = told_of(spoiled, cameras, colours=spoiled.colours())
    assert "colours in camera left are right with red and blue interchanged; correct mosaic, or the order of" in told


def test_a_chart_with_overexposed_patches(good: ArraySession, cameras: CamerasStep) -> None:
    rgb = good.rgb.copy()
    rgb[[5, 18]] = np.nan
    fitted = good.colours()
    (told,) = told_of(good, cameras, colours=replace(fitted, rgb={"left": rgb}))
    assert told.startswith(
        "2 of 24 patches of the chart in camera left are saturated or outside the image, the first of"
    )
    assert "patch 6" in told


def test_exposures_in_milliseconds(good: ArraySession, cameras: CamerasStep) -> None:
    frames = [SimpleNamespace(**(vars(frame) | {"exposure_s": 20.0})) for frame in good.folder.frame]
    folder = SimpleNamespace(**(vars(good.folder) | {"frame": frames}))
    (told,) = suspicions(cast("RawFolder", folder), cameras, None)
    assert told.startswith(f"{len(frames)} frames are said to be exposed for 10 s and longer, among them")
    assert "give exposure_s in seconds" in told


def test_black_frames_that_are_not_black(good: ArraySession, cameras: CamerasStep) -> None:
    told = list(suspicions(good.folder, cameras, None, black={"left": Black(900.0, 3.0), "right": Black(64.0, 2.0)}))
    assert told == [
        "Black frames of camera left have 900 counts of 4095: light fell in; take them again with the lens covered."
    ]


def test_one_photograph_in_two_files(good: ArraySession, cameras: CamerasStep) -> None:
    one, two = good.boards[0].name, good.boards[5].name
    told = told_of(good, cameras, inputs={one: "ab", two: "ab", good.boards[2].name: "cd", "chart.csv": "cd"})
    assert told == [f"Files {one} and {two} hold the same photograph; export the second again, or list it once."]
