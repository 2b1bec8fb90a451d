"""A raw folder of calibration frames whose truth is known: from its files to the record and the report."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from typer.testing import CliRunner

from services.calibrate.cameras.printing import board_pdf, board_rectangles
from services.calibrate.session.flats import measure_vignetting, relative_square
from services.calibrate.session.judge import judge
from services.calibrate.session.photos import Channels, Photos, black_of
from services.calibrate.session.record import uncertainty_of
from services.calibrate.session.report_page import write_report
from services.calibrate.session.run import Session, calibrate, write_session
from services.calibrate.session.spheres import LightsStep, find_lights
from services.calibrate.stage import calibrate as calibrate_job
from services.cli.app import build_app
from services.core.calibration.record import Calibration, require_consistent
from services.core.errors import CaptureInputError
from services.core.raw.folder import read_raw_folder
from services.core.raw.records import RawFolder
from services.core.raw.targets import Board
from services.core.records import JobSpec
from services.core.results import AssetManifest
from services.core.stage import LocalContext, StageEvent
from services.core.store import open_stage, read_record
from services.phantom.lab.rig import Lens, RigSize, in_session_frame, true_rig
from services.phantom.lab.sensor import Sensor
from services.phantom.lab.session import BOARD, XYZ_FROM_SENSOR
from services.phantom.lab.session import write_session as write_virtual_session
from services.pipeline.stages import run_job
from tests.support.board_sessions import CHESSBOARD, charuco


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, Calibration]]:
    """The folder, and the true rig in the frame of its first board."""
    root, sensor = tmp_path_factory.mktemp("session"), Sensor(mosaic="none")
    rig = true_rig(RigSize((640, 480), 0.13, 2, 4), sensor.black, 1)
    first_board = write_virtual_session(root, rig, sensor, 1, n_boards=6, n_mirror=2, n_white=1)
    yield root, in_session_frame(rig, first_board)
    shutil.rmtree(root)


@pytest.fixture(scope="module")
def session(made: tuple[Path, Calibration]) -> Session:
    return calibrate(made[0])


@pytest.mark.slow
def test_cameras_are_where_they_were(made: tuple[Path, Calibration], session: Session) -> None:
    truth, fit = made[1], session.cameras.fit
    for number, camera in enumerate(truth.cameras):
        assert fit.rms_px(number) < 0.12
        # Points around the teeth are projected to where the true camera shows them, within four times the largest ±.
        points = np.random.default_rng(0).uniform(-20, 20, (50, 3)) + np.array([31.5, 24.5, 0.0])
        fitted = session.cameras.posed_cameras[number]
        off = np.linalg.norm(fitted.project(points) - Lens(camera).project(points), axis=1)
        assert off.max() < 0.4


@pytest.mark.dear("It makes the images of a calibration and calibrates from them, for all tests of this file.")
def test_lights_are_as_far_off_as_their_errors_say(made: tuple[Path, Calibration], session: Session) -> None:
    assert session.lights is not None
    fit = session.lights.fit
    error = (fit.positions_mm - [light.position_mm for light in made[1].lights]).ravel()
    covariance = fit.covariance[:12, :12]
    # Twelve values: a rms of whitened errors beyond 1.7 has a chance below 0.1 %.
    assert np.sqrt(np.mean(np.linalg.solve(np.linalg.cholesky(covariance), error) ** 2)) < 1.7
    assert fit.outliers == ()


def test_colours_are_the_sensors(session: Session) -> None:
    assert session.colours is not None
    for fit in session.colours.fits.values():
        assert fit.matrix == pytest.approx(XYZ_FROM_SENSOR, abs=0.01)
        assert np.median(fit.held_out) < 1


def test_the_record_is_one_that_jobs_read(made: tuple[Path, Calibration], session: Session, tmp_path: Path) -> None:
    write_session(session, tmp_path)
    write_report(session, tmp_path)
    record = read_record(tmp_path / "calibration.json", Calibration)
    require_consistent(record, "it")
    assert record.uncertainty is not None
    names = record.uncertainty.names
    assert {"camera.c0.rx", "camera.c1.cy", "light.L3.z", "light_gain.L2.blue"} <= set(names)
    # Errors of gains and positions are correlated: a light that is believed nearer is found dimmer.
    gains, places = names.index("light_gain.L0.red"), names.index("light.L0.x")
    assert np.abs(record.uncertainty.matrix[gains, places : places + 3]).max() > 0
    # The white standard's 1 % is the same in all channels, and the gain of the photographs is known no better.
    red, blue = names.index("gain.red"), names.index("gain.blue")
    assert 1e-4 < record.uncertainty.matrix[red, red] < 1.2e-4
    assert record.uncertainty.matrix[red, blue] == pytest.approx(1e-4)
    assert record.limits is not None
    assert {one.unit for one in record.limits} == {"px", "mm", "%", ""}
    assert np.mean([light.intensity for light in record.lights], axis=0) == pytest.approx(1)
    assert record.inputs is not None
    assert "raw.toml" in record.inputs
    page = (tmp_path / "report.html").read_text()
    assert page.count("<svg") == 2 * 2 + 1 + 2
    assert not re.search(r"(src|href)=", page)
    assert '"corners"' in (tmp_path / "residuals.json").read_text()

    # A calibration that is written over another keeps that one.
    write_session(session, tmp_path)
    assert read_record(tmp_path / "calibration.previous.json", Calibration) == record


def with_lights(session: Session, root: Path, folder: RawFolder) -> LightsStep:
    photos = Photos(root, folder)
    cameras = session.cameras
    found = find_lights(photos, cameras.posed_cameras, cameras.camera_covariance, cameras.distance_mm)
    assert found is not None
    return found


def suspicions(session: Session, folder: RawFolder, lights: LightsStep) -> str:
    uncertainty = uncertainty_of(folder, session.cameras, lights, None)
    return " ".join(judge(folder, session.cameras, lights, None, None, uncertainty).suspicions)


def test_a_good_session_raises_no_suspicion(session: Session) -> None:
    assert session.judgement.suspicions == ()


@pytest.mark.slow
def test_a_wrong_radius_is_named(made: tuple[Path, Calibration], session: Session) -> None:
    folder = read_raw_folder(made[0])
    spheres = tuple(
        one.model_copy(update={"radius_mm": one.radius_mm * (1.05 if one.kind == "mirror" else 1)})
        for one in folder.sphere
    )
    wrong = folder.model_copy(update={"sphere": spheres})
    assert "measure the sphere's radius_mm and the board's square_mm again" in suspicions(
        session, wrong, with_lights(session, made[0], wrong)
    )


@pytest.mark.slow
def test_one_light_under_two_names_is_named(made: tuple[Path, Calibration], session: Session) -> None:
    folder = read_raw_folder(made[0])
    frames = []
    for frame in folder.frame:
        if frame.light == "L1" and frame.kind == "mirror-sphere":
            continue
        frames.append(frame)
        if frame.light == "L0" and frame.kind == "mirror-sphere":
            frames.append(frame.model_copy(update={"light": "L1"}))
    twice = folder.model_copy(update={"frame": tuple(frames)})
    told = suspicions(session, twice, with_lights(session, made[0], twice))
    assert "Lights L0 and L1 lie 0.0 mm apart" in told


def test_a_sphere_that_is_not_there_is_named(made: tuple[Path, Calibration], session: Session) -> None:
    folder = read_raw_folder(made[0])
    black = next(frame for frame in folder.frame if frame.kind == "black" and frame.camera == "c0")
    frames = tuple(
        frame.model_copy(update={"file": black.file})
        if frame.kind == "mirror-sphere" and frame.camera == "c0"
        else frame
        for frame in folder.frame
    )
    with pytest.raises(CaptureInputError, match=r"camera c0\) shows no whole outline of sphere mirror"):
        with_lights(session, made[0], folder.model_copy(update={"frame": frames}))


def test_a_folder_without_boards_is_refused(made: tuple[Path, Calibration]) -> None:
    from services.calibrate.session.boards import calibrate_cameras

    folder = read_raw_folder(made[0])
    frames = tuple(frame for frame in folder.frame if frame.kind != "board")
    with pytest.raises(CaptureInputError, match="no frame of kind board; photograph a board"):
        calibrate_cameras(Photos(made[0], folder.model_copy(update={"frame": frames})))


@pytest.mark.parametrize(
    "board", [BOARD, CHESSBOARD, charuco((5, 8), legacy_pattern=True), charuco((4, 3), type="aruco")]
)
def test_a_printed_board_is_opencvs(board: Board) -> None:
    import cv2

    from services.calibrate.cameras.boards import opencv_board

    scale = 10
    columns, rows = board.squares
    width, height = (round(n * board.square_mm * scale) for n in (columns, rows))
    ours = np.full((height, width), 255, dtype=np.uint8)
    for x, y, w, h in board_rectangles(board):
        corner, end = (round(x * scale), round(y * scale)), (round((x + w) * scale), round((y + h) * scale))
        ours[corner[1] : end[1], corner[0] : end[0]] = 0
    if board.type == "chessboard":
        found, _ = cv2.findChessboardCornersSB(cv2.copyMakeBorder(ours, 200, 200, 200, 200, 0, value=255), (8, 6))
        assert found
        return
    made = opencv_board(board)
    if board.type == "aruco":
        assert board.marker_mm is not None
        width, height = (
            width - round((board.square_mm - board.marker_mm) * scale),
            height - round((board.square_mm - board.marker_mm) * scale),
        )
        ours = ours[:height, :width]
    theirs = made.generateImage((width, height))
    # OpenCV draws markers to whole pixels, so cells' edges may differ by one.
    assert np.mean(ours != theirs) < 0.02


def test_a_pdf_has_the_boards_size() -> None:
    content = board_pdf(BOARD.model_copy(update={"square_mm": 12.0, "marker_mm": 9.0}))
    box = re.search(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", content)
    assert box is not None
    assert [float(one) * 25.4 / 72 for one in box.groups()] == pytest.approx([128, 114], abs=1e-3)
    start = int(content.split(b"startxref\n")[1].split(b"\n")[0])
    assert content[start:].startswith(b"xref")


def test_the_command_writes_a_board(tmp_path: Path) -> None:
    ran = CliRunner().invoke(build_app(), ["board", "--out", str(tmp_path / "b.pdf"), "--squares", "7", "5"])
    assert ran.exit_code == 0
    assert (tmp_path / "b.pdf").read_bytes().startswith(b"%PDF")
    assert "squares = [7, 5]" in ran.output


class EvenPhotos:
    """Photographs of an even source through a lens with dark corners; replaces files."""

    def __init__(self, fall: tuple[float, float, float], saturated: bool = False) -> None:
        size, principal = (400, 300), np.array([205.0, 148.0])
        x, y = np.meshgrid(np.arange(400) + 0.5, np.arange(300) + 0.5)
        q = relative_square(np.stack([x.ravel(), y.ravel()], axis=1), size, principal).reshape(300, 400, 1)
        light = 1 + q * (fall[0] + q * (fall[1] + q * fall[2]))
        noise = np.random.default_rng(0).normal(1, 0.01, (300, 400, 3))
        self.seen = Channels((light * noise * [900, 800, 700]).astype(np.float32), 1, np.full((300, 400), saturated))
        frame = SimpleNamespace(file="flat.npy", camera="c0")
        camera = SimpleNamespace(size=size)
        self.folder = SimpleNamespace(frames_of=lambda *_: (frame,), camera_named=lambda _: camera)

    def channels(self, _: object) -> Channels:
        return self.seen


def test_the_fall_of_light_is_that_of_the_lens() -> None:
    true, q = (-0.35, 0.08, -0.02), np.linspace(0, 1, 20)
    a, b, c = measure_vignetting(cast("Photos", EvenPhotos(true)), "c0", np.array([205.0, 148.0])) or (0, 0, 0)
    found, expected = (1 + q * (k[0] + q * (k[1] + q * k[2])) for k in ((a, b, c), true))
    # A cell of 8 x 8 pixels with 1 % noise has 0.13 %, and some 1,800 of them share four numbers.
    assert found == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize(
    ("fall", "saturated", "named"),
    [((-0.3, 0, 0), True, "is saturated in 100.0%"), ((-1.2, 0, 0), False, "fall to nothing at the image's edge")],
)
def test_a_bad_flat_field_is_named(fall: tuple[float, float, float], saturated: bool, named: str) -> None:
    with pytest.raises(CaptureInputError, match=named):
        measure_vignetting(cast("Photos", EvenPhotos(fall, saturated)), "c0", np.array([205.0, 148.0]))


def test_black_frames_tell_their_noise_without_the_sensors_pattern() -> None:
    random = np.random.default_rng(2)
    pattern = random.normal(0, 10, (60, 80, 1))
    frames = [np.round(64 + pattern + random.normal(0, 2, (60, 80, 3))).astype(np.uint16) for _ in range(5)]
    black = black_of(iter(frames))
    # 14,400 values, four degrees of freedom each: the standard error of the noise is 2 / √(2 · 57,600) = 0.006.
    assert black.noise == pytest.approx(2, abs=0.03)
    assert black.counts == pytest.approx(np.mean(frames), abs=1e-3)
    # One frame cannot separate the fixed pattern from noise, so their sum is reported.
    assert black_of(iter(frames[:1])).noise == pytest.approx(104**0.5, rel=0.03)


def test_a_job_publishes_the_record_and_its_report(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[StageEvent] = []

    def found(root: Path, tell: Callable[[str], None]) -> Session:
        tell("cameras: boards, lenses, poses")
        return session

    monkeypatch.setattr("services.calibrate.session.run.calibrate", found)
    spec = JobSpec(kind="calibration", capture=tmp_path / "session")
    calibrate_job(spec, LocalContext(tmp_path / "job", 1, told.append))
    folder, manifest = open_stage(tmp_path / "job", "asset", AssetManifest)
    assert manifest.files == ("calibration.json", "residuals.json")
    assert "<html" in (tmp_path / "job" / "report.html").read_text()
    assert manifest.held_out_error is None, "nothing was fitted to images"
    assert read_record(folder / "calibration.json", Calibration).limits == session.judgement.recorded
    assert manifest.converged == (session.judgement.broken == ())
    assert [event.kind for event in told] == ["started", "progress", "finished"]
    assert session.judgement.advice in told[-1].message


@pytest.mark.slow
def test_a_job_of_kind_calibration_runs_as_any_other(made: tuple[Path, Calibration], tmp_path: Path) -> None:
    asset = run_job(JobSpec(kind="calibration", capture=made[0]), tmp_path / "job")
    assert asset.files == ("calibration.json", "residuals.json")
    assert (tmp_path / "job" / "report.html").exists()
