"""What the comparison of a virtual laboratory reports about calibration, pose and media, on made-up files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from services.bench.lab import run
from services.bench.lab.comparison import QUANTITIES, Measured, Outcome, outcome, step_errors, verdict
from services.bench.lab.known import VARIANTS, session_from_scan, true_calibration, write_variant
from services.bench.lab.summary_page import lines, write_summary
from services.core.calibration.record import Calibration
from services.core.calibration.uncertainty import CalibrationUncertainty
from services.core.files.meshes import read_teeth, write_mesh
from services.core.geometry import teeth_folder
from services.core.raw.registration import Registration
from services.core.records import JobSpec
from services.core.store import read_record, write_record
from services.phantom.files import medium_truth
from services.phantom.lab.make import LabRecord
from services.phantom.lab.rig import RigSize, true_rig
from services.phantom.subjects import subject_tissues
from tests.support.raw_folders import write_raw_folder
from tests.support.small_tooth import sphere

RIG = true_rig(RigSize((24, 16), 2.0, 2, 2), 64.0, 5)
MOVED_MM = np.array([0.03, 0.04, 0.0])


def random_pose(seed: int) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.random(random_state=seed).as_matrix(), (10.0, -20.0, 5.0)
    return pose


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    """A laboratory whose registration is off by 0.05 mm and whose lights are said to be 1 % too bright in one
    channel.
    """
    mouth = tmp_path / "mouth"
    mouth.mkdir()
    write_raw_folder(mouth)
    world_from_scan, world_from_session = random_pose(1), random_pose(2)
    media = {
        name: {"enamel": medium_truth(tissue.enamel), "dentin": medium_truth(tissue.dentin)}
        for name, tissue in subject_tissues(3, RIG.channels).items()
    }
    told = {"world_from_scan": world_from_scan.tolist(), "world_from_session": world_from_session.tolist()}
    (tmp_path / "truth").mkdir()
    write_record(tmp_path / "truth" / "lab.json", LabRecord.model_validate({"recipe": "", "media": media, **told}))
    write_record(tmp_path / "truth" / "calibration.json", RIG)
    return tmp_path


def test_the_truth_in_the_sessions_frame_is_seen_alike(lab: Path) -> None:
    moved, told = true_calibration(lab), read_record(lab / "truth" / "lab.json", LabRecord)
    scan = np.random.default_rng(0).uniform(-5, 5, (20, 3))
    world, session = (
        scan @ pose[:3, :3].T + pose[:3, 3] for pose in (np.array(told.world_from_scan), session_from_scan(lab))
    )
    for before, after in zip(RIG.cameras, moved.cameras, strict=True):
        np.testing.assert_allclose(after.project(session)[0], before.project(world)[0], atol=1e-6)
    for one, two in zip(RIG.lights, moved.lights, strict=True):
        apart = [
            np.linalg.norm(np.array(light.position_mm) - points[0]) for light, points in ((one, world), (two, session))
        ]
        assert apart[0] == pytest.approx(apart[1], rel=1e-9)


def found_calibration(lab: Path) -> Calibration:
    true = true_calibration(lab)
    lights = tuple(
        light.model_copy(update={"intensity": (light.intensity[0] * 1.01, *light.intensity[1:])})
        for light in true.lights
    )
    uncertainty = CalibrationUncertainty(names=("gain.red",), covariance=((1e-4,),))
    return true.model_copy(update={"lights": lights, "uncertainty": uncertainty})


def write_found(lab: Path) -> None:
    (lab / "calibration").mkdir()
    write_record(lab / "calibration" / "calibration.json", found_calibration(lab))
    pose = session_from_scan(lab)
    mesh = sphere(4.0)
    placed = type(mesh)(mesh.vertices_mm @ pose[:3, :3].T + pose[:3, 3] + MOVED_MM, mesh.faces)
    write_mesh(teeth_folder(lab / "mouth", 11) / "outer.ply", placed)
    write_mesh(lab / "mouth" / "gums.ply", placed)
    pose[:3, 3] += MOVED_MM
    record = {"rig_from_scan": pose.tolist(), "centre_mm": placed.vertices_mm.mean(axis=0).tolist(), "steps": ()}
    uncertainty = CalibrationUncertainty(names=("teeth.tx",), covariance=((1e-3,),))
    record |= {
        "uncertainty": uncertainty,
        "misfit_mm": 0.05,
        "teeth": (11,),
        "repairs": "",
        "inputs": {},
        "pictures": (),
    }
    write_record(lab / "mouth" / "registration.json", Registration.model_validate(record))


def test_each_steps_error_is_what_it_was_made_to_be(lab: Path) -> None:
    write_found(lab)
    told = step_errors(lab)
    assert told.teeth_mm == pytest.approx(0.05, abs=1e-6)
    assert told.teeth_deg == pytest.approx(0, abs=1e-4)
    assert told.lights_mm == pytest.approx(0, abs=1e-6)
    # One channel of three is off by 1 %.
    assert told.intensity == pytest.approx(np.log(1.01) / np.sqrt(3), rel=1e-6)
    assert told.radiance == 0


def test_a_variant_holds_what_is_given_and_the_rest_as_it_was_found(lab: Path) -> None:
    write_found(lab)
    perfect = write_variant(lab, lab / "perfect", VARIANTS["perfect"])
    record = read_record(perfect / "calibration.json", Calibration)
    assert record.lights == true_calibration(lab).lights
    assert record.uncertainty is None
    assert not (perfect / "registration.json").exists()
    (tooth,), (before,) = read_teeth(perfect), read_teeth(lab / "mouth")
    moved = before.outer.vertices_mm - tooth.outer.vertices_mm
    # Single precision of what a PLY holds, some tens of millimetres from the origin.
    np.testing.assert_allclose(moved, np.broadcast_to(MOVED_MM, moved.shape), atol=2e-5)

    lit = write_variant(lab, lab / "lit", VARIANTS["true radiometry"])
    record = read_record(lit / "calibration.json", Calibration)
    assert [light.intensity for light in record.lights] == [light.intensity for light in RIG.lights]
    assert record.uncertainty == found_calibration(lab).uncertainty
    assert (lit / "registration.json").exists()


def test_a_jobs_media_are_held_against_the_truth(lab: Path, tmp_path: Path) -> None:
    job = tmp_path / "job"
    job.mkdir()
    table = {name: {"value": 1.0, "se": 0.5} for name in QUANTITIES}
    (job / "parameters.json").write_text(json.dumps({"green": table}))
    errors = {"held_out_error": {"green": 0.02}, "fit_error": {"green": 0.01}, "converged": True}
    (job / "errors.json").write_text(json.dumps(errors))
    told = outcome(lab, job)
    enamel = subject_tissues(3, ("green",))["green"].enamel
    assert told.media["enamel.sigma_a"].truth == pytest.approx(enamel.sigma * (1 - enamel.alpha))
    assert told.media["enamel.sigma_s_reduced"].truth == pytest.approx(enamel.sigma_s_reduced)
    assert told.media["enamel.sigma_s_reduced"].z == pytest.approx((1.0 - enamel.sigma_s_reduced) / 0.5)


def test_what_is_asked_is_judged_figure_by_figure() -> None:
    def made(error: float, value: float, se: float) -> Outcome:
        media = {name: Measured(value=value, se=se, truth=1.0) for name in QUANTITIES}
        return Outcome(held_out_error=error, fit_error=error, converged=True, media=media)

    asked = verdict(made(0.04, 1.25, 0.1), made(0.03, 1.0, 0.05))
    kept = {what: is_kept for what, (_, _, is_kept) in asked.items()}
    assert not kept["held-out error over that with perfect calibration and pose"]
    assert sum(kept.values()) == 8
    assert asked["enamel.sigma_a: distance from the truth in standard errors"][0] == pytest.approx(2.5)
    assert asked["dentin.sigma_a: ± over that with perfect calibration and pose"][0] == pytest.approx(2.0)


def test_what_is_done_is_kept_and_all_jobs_end_in_one_page(
    lab: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_found(lab)
    ran: list[tuple[JobSpec, Path]] = []

    def fake_job(spec: JobSpec, out: Path, _view: object, _workers: int | None) -> None:
        ran.append((spec, out))
        out.mkdir(parents=True, exist_ok=True)
        table = {name: {"value": 1.0, "se": 0.5} for name in QUANTITIES}
        (out / "parameters.json").write_text(json.dumps({"green": table}))
        error = 0.05 if spec.instrument == "on" else 0.04
        errors = {
            "held_out_error": {"green": error},
            "fit_error": {"green": error},
            "converged": spec.instrument == "on",
        }
        (out / "errors.json").write_text(json.dumps(errors))

    monkeypatch.setattr(run, "run_job", fake_job)
    told = run.measured(lab, 0.13, ["perfect", "true pose"], None, print)
    write_summary(lab, told)
    assert "cameras: boards" not in capsys.readouterr().out
    specs = [spec for spec, _ in ran]
    assert [spec.capture for spec in specs] == [
        lab / "mouth", lab / "comparison" / "perfect" / "mouth", lab / "comparison" / "true-pose" / "mouth"
    ]  # fmt: skip
    assert [spec.instrument for spec in specs] == ["on", "off", "on"]
    assert {(spec.fdi, spec.pixel_step, spec.dentin) for spec in specs} == {(11, 4, "fit")}
    asked = told["asked"]["held-out error over that with perfect calibration and pose"]
    assert asked["value"] == pytest.approx(1.25)
    assert asked["kept"]
    page = (lab / "summary.html").read_text()
    assert "perfect, not converged" in page
    assert page.count("<tr>") == 1 + 3 + 1 + 9 + 6
    assert any("off the truth: teeth, mm 0.05" in line for line in lines(told))
