"""A job registers the scan of a raw folder before it prepares it, and keeps the pictures of a refusal."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from services.core.errors import CaptureInputError
from services.core.events import JobEvent
from services.core.raw.registration import REGISTERED, Registration, lacks_pose
from services.core.records import JobSpec
from services.core.results import PreparedManifest
from services.core.store import open_stage, read_record
from services.pipeline.stages import run_job, stages_of
from tests.support.raw_folders import write_toml
from tests.support.raw_mouth import RawMouth, shared_mouth
from tests.support.toy_stages import DOORS

NAMES = tuple(f"teeth.{axis}" for axis in ("rx", "ry", "rz", "tx", "ty", "tz"))


@pytest.fixture(scope="module")
def mouth(tmp_path_factory: pytest.TempPathFactory) -> RawMouth:
    return shared_mouth(tmp_path_factory)


def test_only_a_raw_folder_with_a_scan_and_no_teeth_lacks_a_pose(mouth: RawMouth, tmp_path: Path) -> None:
    assert lacks_pose(mouth.root)
    raw = tmp_path / "raw"
    shutil.copytree(mouth.root, raw)
    write_toml(raw, {key: value for key, value in mouth.tree.items() if key != "scan"})
    assert not lacks_pose(raw)
    write_toml(raw, mouth.tree)
    (raw / "teeth").mkdir()
    assert not lacks_pose(raw)
    (raw / "teeth").rmdir()
    (raw / "raw.toml").write_text("units = ")
    assert not lacks_pose(raw)
    assert not lacks_pose(tmp_path)


@pytest.mark.slow
def test_a_scan_without_a_pose_is_registered_first(mouth: RawMouth, tmp_path: Path) -> None:
    spec, seen = JobSpec(capture=mouth.root, workers=1), list[JobEvent]()
    run_job(spec, tmp_path, seen.append, doors=DOORS | {"prepare": "services.preprocess.stage:run"})
    assert [event.stage for event in seen if event.kind == "started"] == ["register", "prepare", "fit", "export"]
    assert stages_of(spec, {event.stage for event in seen}) == ("register", "prepare", "fit", "export")
    assert any(event.message.startswith("6 teeth stand in the rig, 0.0") for event in seen)
    assert not (mouth.root / "teeth").exists()

    # The prepared stage has the job's teeth, the raw folder's photographs, and the pose's covariance.
    record = read_record(tmp_path / REGISTERED / "registration.json", Registration)
    prepared = open_stage(tmp_path, "prepared", PreparedManifest)[1]
    assert prepared.fdi == (11, 12, 13, 21, 22, 23)
    assert min(prepared.tooth_pixels) > 1000
    assert prepared.uncertainty is not None
    assert prepared.uncertainty.names == NAMES
    np.testing.assert_array_equal(prepared.uncertainty.matrix, record.uncertainty.matrix)
    assert (tmp_path / REGISTERED / "registration.html").is_file()


def test_a_refusal_leaves_its_pictures_with_the_job(mouth: RawMouth, tmp_path: Path) -> None:
    landmarks = json.loads(json.dumps(mouth.tree["landmark"]))
    seen = [one["pixels"] for one in landmarks]
    for one, pixels in zip(landmarks, seen[1:] + seen[:1], strict=True):
        one["pixels"] = pixels
    raw, job = tmp_path / "raw", tmp_path / "job"
    shutil.copytree(mouth.root, raw)
    write_toml(raw, mouth.tree | {"landmark": landmarks})
    with pytest.raises(CaptureInputError, match=r"landmarks contradict .*job/registration/refused_c0\.png.* show it\."):
        run_job(JobSpec(capture=raw, workers=1), job, doors=DOORS)
    assert (job / "registration" / "refused_c0.png").is_file()
    assert not (job / REGISTERED).exists()
    assert not (job / "prepared").exists()
