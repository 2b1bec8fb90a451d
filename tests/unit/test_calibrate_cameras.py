"""Lenses and rigs from boards: compared with finite differences, with known truth, and with recordings by others."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.calibrate.cameras.boards import corners_on_board, detect
from services.calibrate.cameras.bundle import Rig, fit_bundle, jacobian, layout_of, project_corners
from services.calibrate.cameras.lens import Lens
from services.calibrate.cameras.models import choose_lens, fit_lens, held_out_squares, of_one_camera
from services.calibrate.cameras.projection import image_grid, projection_covariance, projection_sigma
from services.calibrate.cameras.rotations import pose_matrix, rotation_matrix
from services.calibrate.cameras.sightings import View, joined
from services.calibrate.cameras.start import first_lens, first_rig
from services.core.errors import CaptureInputError
from tests.support.board_sessions import CHESSBOARD, SIZE, charuco, photographed, table_views, true_rig
from tests.support.shared_data import shared_path

CORNERS_OF_A_RECORDING = "calibration/{}/CHARUCO/xy_CHARUCO.csv"
STEREO_BOARDS = Path("/usr/share/doc/opencv-doc/examples/data")
"""Where Debian's package opencv-doc puts its stereo boards."""


def test_derivatives_of_drawn_corners_are_those_of_finite_differences() -> None:
    random = np.random.default_rng(1)
    rig = true_rig(random, n_places=3)
    corners, layout = joined(photographed(rig, 0.0, random)), layout_of(rig)
    values = layout.pack(rig)
    sparse: Any = jacobian(layout, rig, corners, np.ones(3))
    exact = sparse.toarray()
    for column in range(layout.length):
        step = 1e-6 * max(1.0, abs(values[column]))
        sides = []
        for sign in (-1, 1):
            moved = values.copy()
            moved[column] += sign * step
            sides.append(project_corners(layout.unpack(moved, rig), corners).ravel())
        # Error of central differences: step² times the third derivative, and rounding over the step, 1e-13 · 2000 ÷
        # 1e-6.
        assert exact[:, column] == pytest.approx((sides[1] - sides[0]) / (2 * step), rel=1e-6, abs=1e-3)


def test_undistorted_pixels_are_drawn_again() -> None:
    lens = Lens((640, 480), np.array([500.0, 505, 320, 240, -0.2, 0.1, 0.001, 0.002, 0.01, 0.02, 0.03, 0.01]))
    pixels = image_grid(lens.size, 9, 7)
    assert lens.project(lens.undistort(pixels)) == pytest.approx(pixels, abs=1e-6)


@pytest.mark.slow
def test_errors_of_a_rig_are_as_large_as_its_covariance_says() -> None:
    """Whitened errors of four sessions, 4 · 84 parameters: their rms has a standard error of 0.04."""
    whitened = []
    for seed in range(4):
        random = np.random.default_rng(seed)
        rig = true_rig(random, n_places=8)
        views = photographed(rig, 0.1, random)
        # The start is far from the truth in the values that the boards must determine.
        lenses = [
            Lens(SIZE, lens.values * np.where(np.arange(8) < 2, 1.02, np.where(np.arange(8) < 4, 1.01, 0)))
            for lens in rig.lenses
        ]
        fit = fit_bundle(views, first_rig(views, lenses, ["left", "middle", "right"]))
        assert fit.converged
        error = fit.layout.pack(fit.rig) - fit.layout.pack(rig)
        scale = np.sqrt(np.diag(fit.covariance))
        factor = np.linalg.cholesky(fit.covariance / np.outer(scale, scale))
        whitened.append(np.linalg.solve(factor, error / scale))
    assert 0.88 < np.sqrt(np.mean(np.square(whitened))) < 1.12


def test_bad_corners_are_named_and_do_no_harm() -> None:
    random = np.random.default_rng(3)
    rig = true_rig(random, n_places=6)
    views = photographed(rig, 0.1, random)
    bad = views[4].pixels.copy()
    bad[[2, 7]] += [[3.0, -2.0], [0.0, 9.0]]
    views[4] = replace(views[4], pixels=bad)
    fit = fit_bundle(views, first_rig(views, rig.lenses, ["left", "middle", "right"]))
    wrong = np.flatnonzero(~fit.inliers)
    assert fit.corners.view[wrong].tolist() == [4, 4]
    assert (wrong - np.flatnonzero(fit.corners.view == 4)[0]).tolist() == [2, 7]
    # Some 1,700 coordinates less 78 parameters: a standard error of 1.8 %.
    assert fit.sigma_px == pytest.approx(0.1, rel=0.05)


def test_what_a_lens_draws_wrong_is_as_large_as_its_uncertainty_says() -> None:
    """Errors of projection less the mean motion of the boards, over 12 sessions and 20 pixels of one lens."""
    ratios = []
    for seed in range(12):
        random = np.random.default_rng(100 + seed)
        rig = true_rig(random, n_places=8)
        alone = Rig(rig.lenses[:1], rig.cameras[:1], rig.places)
        views = photographed(alone, 0.2, random)
        fit = fit_bundle(views, alone, robust=False)
        grid = image_grid(SIZE, 5, 4)
        points = 450 * rig.lenses[0].undistort(grid)
        world = (points - rig.cameras[0][3:]) @ rotation_matrix(rig.cameras[0][:3])
        seen = []
        for true, found in zip(alone.places, fit.rig.places, strict=True):
            on_board = np.linalg.inv(pose_matrix(true)) @ np.column_stack([world, np.ones(20)]).T
            seen.append((pose_matrix(fit.rig.cameras[0]) @ pose_matrix(found) @ on_board)[:3].T)
        off = fit.rig.lenses[0].project(np.mean(seen, axis=0)) - grid
        ratios.append(np.linalg.norm(off, axis=1) / projection_sigma(fit, 0, grid, 450 * 1.02))
    # The length of a vector of two coordinates over the larger σ: between 1 and √2 in rms, known to some 15 % from 12
    # sessions.
    assert 0.75 < np.sqrt(np.mean(np.square(ratios))) < 1.65


# The third camera's boards hardly determine its lens, so that its fit takes four seconds.
@pytest.mark.parametrize(
    ("camera", "rms_px"), [(0, 0.34), (1, 0.50), pytest.param(2, 0.82, marks=pytest.mark.slow), (3, 0.36)]
)
def test_single_cameras_of_a_recording_reach_its_errors(camera: int, rms_px: float) -> None:
    folder = shared_path("data/charuco-rig") / "intrinsic"
    views = table_views(folder / CORNERS_OF_A_RECORDING.format("intrinsic"))
    good = of_one_camera([view for view in views if view.camera == camera and len(view.pixels) >= 6])
    lens = first_lens(good, (1280, 720), "radial-tangential-5", str(camera))
    fit = fit_bundle(good, first_rig(good, [lens], [str(camera)]), robust=False)
    # The published figure has two digits.
    assert fit.rms_px() < rms_px + 0.005


def test_a_rig_of_a_recording_reaches_its_errors() -> None:
    folder = shared_path("data/charuco-rig") / "post_optimization"
    views = table_views(folder / CORNERS_OF_A_RECORDING.format("extrinsic"))
    assert sum(len(view.pixels) for view in views) == 2169
    stored = tomllib.loads((folder / "camera_array.toml").read_text())["cameras"]
    lenses, centres = [], []
    for camera in (stored[key] for key in "0123"):
        K, rotation = np.array(camera["matrix"]), np.array(camera["rotation"])
        pinhole = [K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5]
        lenses.append(Lens((1280, 720), np.array([*pinhole, *camera["distortions"]])))
        centres.append(-1e3 * rotation.T @ np.array(camera["translation"]))
    fit = fit_bundle(views, first_rig(views, lenses, list("0123")), lenses_fixed=True, robust=False)
    assert fit.rms_px() < 1.715
    found = [-rotation_matrix(pose[:3]).T @ pose[3:] for pose in fit.rig.cameras]
    pairs = [(a, b) for a in range(4) for b in range(a)]
    off = [np.linalg.norm(found[a] - found[b]) - np.linalg.norm(centres[a] - centres[b]) for a, b in pairs]
    assert np.abs(off).max() < 5


def test_boards_in_photographs_are_found_and_calibrate_a_camera() -> None:
    import cv2

    folder = shared_path("data/aruco-boards")
    board = charuco((5, 7))
    views = []
    for number in range(4):
        found = detect(cv2.imread(str(folder / f"img_0{number}.jpg"), cv2.IMREAD_GRAYSCALE), board)
        assert (len(found.markers), len(found.ids)) == (17, 24)
        views.append(View(0, number, found.corners_mm, found.pixels, found.ids, f"img_0{number}"))
    fit = fit_lens(views, (640, 480), "radial-tangential-5", "camera")
    # In the published principal point, pixel centres are at integers.
    assert fit.rms_px() == pytest.approx(0.1878, abs=1e-3)
    assert fit.rig.lenses[0].values[:4] == pytest.approx([457.3, 461.3, 317.7, 276.1], abs=0.2)
    hidden = detect(cv2.imread(str(folder / "chocclusion_original.jpg"), cv2.IMREAD_GRAYSCALE), board)
    assert (len(hidden.markers), len(hidden.ids)) == (13, 16)
    single = cv2.imread(str(folder / "singlemarkersoriginal.jpg"), cv2.IMREAD_GRAYSCALE)
    markers = detect(single, charuco((12, 17), type="aruco")).markers
    assert sorted(markers.tolist()) == [23, 40, 62, 98, 124, 203]


@pytest.mark.slow
def test_held_out_boards_are_drawn_at_least_as_well_as_by_opencv() -> None:
    """Over both cameras and four ways to split 13 boards; single splits differ by up to 3 % either way, and one by 27
    %.
    """
    import cv2

    if not STEREO_BOARDS.is_dir():
        pytest.skip("Debian's package opencv-doc is not installed")
    board = CHESSBOARD.model_copy(update={"squares": (10, 7), "square_mm": 1.0})
    squares = []
    for side in ("left", "right"):
        views: list[View] = []
        for path in sorted(STEREO_BOARDS.glob(f"{side}??.jpg")):
            found = detect(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), board)
            views.append(View(0, len(views), found.corners_mm, found.pixels, found.ids, path.name))
        assert [len(view.ids) for view in views] == [54] * 13
        first, last, odd, even = slice(0, 7), slice(6, None), slice(0, None, 2), slice(1, None, 2)
        for train, test in ((first, slice(7, None)), (last, slice(0, 6)), (odd, even), (even, odd)):
            ours = choose_lens(views[train], (640, 480), side).lens
            theirs = first_lens(views[train], (640, 480), "radial-tangential-5", side)
            squares.append([held_out_squares(views[test], lens).mean() for lens in (ours, theirs)])
    ours_px, theirs_px = np.sqrt(np.mean(squares, axis=0))
    assert ours_px <= theirs_px


def test_the_distortion_model_is_the_one_that_the_lens_has() -> None:
    random = np.random.default_rng(5)
    rig = true_rig(random, n_places=15)
    views = [view for view in photographed(rig, 0.1, random) if view.camera == 1]
    choice = choose_lens(views, SIZE, "middle", models=("pinhole", "radial-tangential-4", "radial-tangential-5"))
    assert choice.lens.model == "radial-tangential-4"
    assert choice.held_out_px["pinhole"] > 1.5 * choice.held_out_px["radial-tangential-4"]


def test_of_few_boards_the_model_is_held() -> None:
    random = np.random.default_rng(8)
    views = [view for view in photographed(true_rig(random, n_places=4), 0.1, random) if view.camera == 1]
    choice = choose_lens(views, SIZE, "middle")
    assert (choice.lens.model, choice.held_out_px) == ("radial-tangential-4", {})
    with pytest.raises(CaptureInputError, match="Camera middle shows 2 boards"):
        choose_lens(views[:2], SIZE, "middle")


def test_corners_lie_on_the_plate_as_opencv_counts_them() -> None:
    corners = corners_on_board(CHESSBOARD)
    assert corners[:2].tolist() == [[0, 0, 0], [12, 0, 0]]
    assert len(corners) == 48
    assert corners_on_board(charuco((5, 7)))[0].tolist() == [40, 40, 0]


def test_a_board_of_markers_that_opencv_lacks_is_refused() -> None:
    with pytest.raises(CaptureInputError, match=r"dictionary DICT_9X9_1, which OpenCV lacks; it has .*DICT_5X5_100"):
        corners_on_board(charuco((5, 7), "DICT_9X9_1"))


def test_a_board_of_more_markers_than_its_dictionary_has_is_refused() -> None:
    with pytest.raises(CaptureInputError, match="shows 72 markers and dictionary DICT_4X4_50 has 50"):
        corners_on_board(charuco((12, 12), "DICT_4X4_50"))


def test_a_camera_that_shares_no_board_is_named() -> None:
    random = np.random.default_rng(7)
    rig = true_rig(random, n_places=6)
    views = [
        view for view in photographed(rig, 0.1, random) if (view.camera == 2) == (view.place >= 4) or view.camera == 1
    ]
    apart = [view for view in views if not (view.camera == 1 and view.place >= 4)]
    with pytest.raises(CaptureInputError, match="right sees no board together with the other cameras"):
        first_rig(apart, rig.lenses, ["left", "middle", "right"])


def test_lens_and_uncertainty_of_projection_are_those_of_mrcal() -> None:
    """mrcal's own answer to the same corners, made by ``projection_uncertainty(what="covariance")`` of its Debian
    package 2.2.
    """
    table = json.loads((Path(__file__).parents[1] / "data" / "mrcal_chessboard.json").read_text())
    corners = corners_on_board(CHESSBOARD)
    seen = np.array(table["corners_px"]) + 0.5
    views = [View(0, n, corners, pixels, np.arange(48), f"view {n}") for n, pixels in enumerate(seen)]
    lens = first_lens(views, SIZE, "radial-tangential-4", "camera")
    fit = fit_bundle(views, first_rig(views, [lens], ["camera"]), robust=False)
    theirs = np.array(table["intrinsics"])
    theirs[2:4] += 0.5
    errors = np.sqrt(np.diag(fit.covariance)[fit.layout.lens_columns(0)])
    # Two solvers' stopping rules: a thousandth of an error bar.
    assert (fit.rig.lenses[0].values - theirs) / errors == pytest.approx(0, abs=1e-3)
    ours = projection_covariance(fit, 0, np.array(table["pixels"]) + 0.5, table["distance_mm"])
    # mrcal divides squared residuals by their number and not by their degrees of freedom.
    counted = (table["rms_of_a_coordinate_px"] / fit.sigma_px[0]) ** 2
    assert ours * counted == pytest.approx(np.array(table["covariance_px2"]), rel=2e-3, abs=1e-7)
