"""An asset says what it was made from and for what the person agreed, and an edit by hand is noticed."""

from __future__ import annotations

import hashlib
import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from services.assets.exporters import export_to
from services.core.consent import ABSENT, Consent, require_allowed
from services.core.errors import CaptureInputError, ConsentError, CorruptStoreError, MissingStageError
from services.core.provenance.hash_list import require_unedited, write_hash_list
from services.core.provenance.inputs import hashed_inputs, recorded_inputs
from services.core.provenance.record import PROVENANCE, Provenance
from services.core.raw.folder import parse_raw_folder
from services.core.records import FolderCapture, JobSpec, RigSpec
from services.core.store import read_record, write_record
from services.transport.provenance import options_of, provenance_of
from tests.support.folder_captures import prepare, write_folder, write_tree
from tests.unit.test_exporters import published

NOW = datetime(2026, 6, 1, 12, tzinfo=UTC)
CONSENT = {"uses": ["research", "teaching"], "until": "2026-12-31"}
RAW = """
units = "mm"
[consent]
uses = ["research"]
until = {until}
[[camera]]
name = "c0"
size = [4, 4]
[[frame]]
camera = "c0"
file = "a.npy"
kind = "black"
exposure_s = 0.1
"""


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_a_preparation_lists_what_it_read(tmp_path: Path) -> None:
    tree = write_folder(tmp_path / "capture")
    write_tree(tmp_path / "capture", tree | {"consent": CONSENT, "subject": "P07"})
    (tmp_path / "capture" / "other.txt").write_text("not read")
    prepare(tmp_path / "capture", tmp_path / "job")
    inputs = recorded_inputs(tmp_path / "job" / "prepared")
    assert inputs is not None
    photographs = {image["file"] for image in tree["images"]}
    read = [*photographs, "capture.json", "teeth/11/outer.ply"]
    expected = {name: sha256(tmp_path / "capture" / name) for name in read}
    assert {one.name: one.sha256 for one in inputs.files} == expected
    assert {one.name for one in inputs.files if one.is_photograph} == photographs
    assert inputs.consent == Consent.model_validate(CONSENT)
    assert inputs.subject == "P07"


def test_masks_and_calibrations_are_inputs_and_masks_show_the_person(tmp_path: Path) -> None:
    write_folder(tmp_path / "capture")
    (tmp_path / "job" / "masks").mkdir(parents=True)
    (tmp_path / "job" / "masks" / "front@all.png").write_bytes(b"outline")
    (tmp_path / "rig.json").write_bytes(b"{}")
    spec = JobSpec(capture=tmp_path / "capture", calibration=tmp_path / "rig.json")
    found = {one.name: one for one in hashed_inputs(spec, tmp_path / "job")}
    assert found["masks/front@all.png"].is_photograph
    assert not found["calibration/rig.json"].is_photograph


def test_provenance_tells_options_versions_and_seeds_but_no_folder_and_no_name(tmp_path: Path) -> None:
    rig = RigSpec(mouth=Path("/secret/mouth"), dome="10.0.0.7:502", assessment=None)
    (tmp_path / "subject.txt").write_text("P07\n")
    told = provenance_of(JobSpec(rig=rig, seed=7, boundary="matched"), tmp_path, None, NOW)
    text = told.model_dump_json()
    assert "/secret" not in text
    assert "10.0.0.7" not in text
    assert told.seeds == {"job": 7, "simulated cameras": 0}
    assert told.options["boundary"] == "matched"
    assert told.options["max_steps"] == 12  # also those that were not given
    assert {"dentine", "numerics", "python", "numpy", "mitsuba"} <= told.versions.keys()
    assert told.consent_said == ABSENT
    assert told.subject == "P07"
    assert options_of(JobSpec(capture=Path("/secret/tooth")))["capture"] == "tooth"


@pytest.mark.parametrize(
    ("use", "day", "said"),
    [
        ("advertising", 1, "for research, teaching and not for advertising"),
        (None, 32, "ended on 2026-12-31"),
        ("research", 32, "ended on 2026-12-31"),
        ("teaching", 31, None),
        (None, 1, None),
    ],
)
def test_consent_is_for_its_uses_and_until_its_last_day(use: str | None, day: int, said: str | None) -> None:
    now = datetime(2026, 12, day, 23, 59, tzinfo=UTC) if day < 32 else datetime(2027, 1, 1, 0, 1, tzinfo=UTC)
    consent = Consent.model_validate(CONSENT)
    if said is None:
        require_allowed(consent, use, now)
        return
    with pytest.raises(ConsentError, match=said):
        require_allowed(consent, use, now)


def test_dates_of_consent_are_read_from_toml_and_json_and_others_are_named(tmp_path: Path) -> None:
    for until in ("2026-12-31", '"2026-12-31"'):
        consent = parse_raw_folder(RAW.format(until=until).encode(), "raw.toml").consent
        assert consent is not None
        assert consent.until.isoformat() == "2026-12-31"
    with pytest.raises(CaptureInputError, match=r"^raw\.toml: consent: until: 'soon' is no date; write year, month"):
        parse_raw_folder(RAW.format(until='"soon"').encode(), "raw.toml")
    with pytest.raises(CaptureInputError, match="is no date; write year, month and day as in 2027-01-31"):
        parse_raw_folder(RAW.format(until="2026-12-31T10:00:00").encode(), "raw.toml")
    tree = write_folder(tmp_path)
    write_tree(tmp_path, tree | {"consent": {"uses": ["research"], "until": "31.12.2026"}})
    with pytest.raises(CaptureInputError, match=r"consent\.until: '31\.12\.2026' is no date") as refused:
        read_record(tmp_path / "capture.json", FolderCapture)
    assert refused.value.message.count(". ") == 0


def exported(root: Path, consent: dict[str, Any] | None) -> Path:
    """A job's folder with an asset that says where it comes from, and the capture with its consent."""
    capture = root / "capture"
    tree = write_folder(capture)
    write_tree(capture, tree if consent is None else tree | {"consent": consent})
    job = published(root / "job", rig={"views": {}})
    spec = JobSpec(capture=capture)
    write_record(job / "job.json", spec)
    prepare(capture, root / "other")
    write_record(
        job / "asset" / PROVENANCE, provenance_of(spec, job, recorded_inputs(root / "other" / "prepared"), NOW)
    )
    write_hash_list(job / "asset", "asset")
    manifest = json.loads((job / "asset" / "manifest.json").read_text())
    (job / "asset" / "manifest.json").write_text(json.dumps(manifest | {"record": {"files": []}}))
    return job


@pytest.mark.parametrize("exporter", ["gltf", "blender"])
def test_an_export_carries_its_provenance_and_its_hashes(tmp_path: Path, exporter: str) -> None:
    job = exported(tmp_path, {"uses": ["research"], "until": "9999-01-01"})
    (folder,) = export_to(job, (exporter,), use="research")
    told = read_record(folder / PROVENANCE, Provenance)
    assert (told.use, told.exporter) == ("research", exporter)
    assert told.consent_said == "Consent for research, until 9999-01-01."
    assert {one.name for one in told.inputs or () if one.is_photograph} >= {"front_left.npy"}
    assert require_unedited(folder) == ()


def test_the_capture_of_today_says_what_is_allowed(tmp_path: Path) -> None:
    job = exported(tmp_path, {"uses": ["research"], "until": "9999-01-01"})
    with pytest.raises(ConsentError, match="for research and not for film"):
        export_to(job, ("gltf",), use="film")
    tree = json.loads((tmp_path / "capture" / "capture.json").read_text())
    write_tree(tmp_path / "capture", tree | {"consent": {"uses": ["research"], "until": "2020-01-01"}})
    with pytest.raises(ConsentError, match="ended on 2020-01-01"):
        export_to(job, ("gltf",))
    assert not (job / "asset-gltf").exists()


def test_an_edit_a_removal_and_an_addition_are_told_apart(tmp_path: Path) -> None:
    (folder,) = export_to(published(tmp_path), ("gltf",))
    (folder / "render.png").write_bytes(b"")
    assert require_unedited(folder) == ("render.png",)
    text = (folder / "asset.gltf").read_text()
    (folder / "asset.gltf").write_text(text.replace("tooth_11_enamel", "tooth_12_enamel"))
    with pytest.raises(CorruptStoreError, match=r"asset\.gltf was edited since the asset was written; restore it, or"):
        require_unedited(folder)
    (folder / "asset.gltf").unlink()
    with pytest.raises(CorruptStoreError, match=r"asset\.gltf was removed since"):
        require_unedited(folder)
    (folder / "manifest.json").write_text("{}")
    with pytest.raises(CorruptStoreError, match=r"manifest\.json cannot be read"):
        require_unedited(folder)
    (folder / "manifest.json").unlink()
    with pytest.raises(MissingStageError, match="nothing says whether it was edited"):
        require_unedited(folder)
