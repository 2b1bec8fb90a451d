"""A job of kind slab: from its options to results, asset and report, and its refusals."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from services.api.presets import find_preset
from services.assets.provenance.reproduction import changed_inputs, changed_results, job_again, open_asset
from services.core.errors import CaptureInputError, JobCancelledError, SettingsError
from services.core.provenance.asset import load_asset
from services.core.records import JOB_FILE, JobSpec
from services.core.results import AssetManifest
from services.core.settings import job_from_tree
from services.core.stage import CANCEL_FLAG, LocalContext, StageEvent
from services.core.store import open_stage, write_record
from services.pipeline.stages import run_job, stages_of
from services.slab.cell.dictionary import ANGLES_RAD, hg_values
from services.slab.dictionaries.hg import COSINES
from services.slab.options import SlabOptions
from services.slab.results.result import SlabFit
from services.slab.results.stored import JOURNAL, read_result
from services.slab.results.tabphase import tabphase_values
from services.slab.schedule import WavelengthTask, run_wavelengths
from services.slab.solve.checkpoint import Checkpoint
from services.slab.stage import CHECKPOINT, export, run
from services.tasks.engine_host import InProcessHost
from services.tasks.executors import LocalExecutor
from services.transport.platform import prepare_device
from tests.support.recording_executor import RecordingExecutor
from tests.support.small_slab import TRUTHS, made_up_fit, write_cell, write_folder


def require_truths(root: Path, *wavelengths_nm: float) -> None:
    """Assert that coefficients are within 4.5 of their standard errors. One correct value in 100,000 is not; the
    standard errors themselves are known to some per cent.
    """
    told = json.loads((root / "parameters.json").read_text())
    assert set(told) == {f"{nm:g}" for nm in wavelengths_nm}
    for nm in wavelengths_nm:
        sigma_s, g = TRUTHS[nm]
        for name, truth in (("sigma_s", sigma_s), ("sigma_s_reduced", sigma_s * (1 - g))):
            found = told[f"{nm:g}"][name]
            assert found["unit"] == "1/mm"
            assert abs(found["value"] - truth) <= 4.5 * found["se"] <= 0.4 * truth


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cell's folder with one wavelength."""
    return write_cell(tmp_path_factory.mktemp("slab"), 532.0)


@pytest.fixture(scope="module")
def spec(folder: Path) -> JobSpec:
    """A job with a fiftieth of the default number of paths."""
    return JobSpec(kind="slab", capture=folder, effort=0.02, seed=4)


@pytest.fixture(scope="module")
def job(spec: JobSpec, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the job after it has run."""
    root = tmp_path_factory.mktemp("job")
    run(spec, LocalContext(root))
    export(spec, LocalContext(root))
    return root


def test_results_hold_what_the_cell_holds_by_wavelength(job: Path) -> None:
    require_truths(job, 532.0)
    index = json.loads((job / "parameters.json").read_text())["532"]["index"]
    assert index["value"] == pytest.approx(1.33, rel=1e-9)
    assert 0 < index["se"] < 1e-3
    phase = json.loads((job / "phase.json").read_text())["532"]
    assert {len(phase[name]) for name in ("theta_deg", "value_per_sr", "se_per_sr", "determined")} == {len(ANGLES_RAD)}
    assert json.loads((job / "errors.json").read_text())["532"]["held_out_error"] < 0.1


def test_the_report_opens_alone_and_shows_phase_functions_and_images(job: Path) -> None:
    page = (job / "report.html").read_text()
    assert not re.search(r"(?:src|href)=.(?!data:)", page)
    assert page.count('<polygon class="band"') == 1
    assert page.count("<img ") == 3 * 4
    assert page.index("held out") < page.index(">fitted<")
    assert "shot noise of 1 % at a pixel" in page


def test_the_asset_says_what_it_was_made_from_and_can_be_made_again(
    job: Path, spec: JobSpec, folder: Path, tmp_path: Path
) -> None:
    write_record(job / JOB_FILE, spec)
    asset = open_asset(job)
    told = asset.provenance
    assert (told.source, told.seeds, told.options["effort"]) == (folder.name, {"job": 4}, 0.02)
    assert told.inputs is not None
    assert {one.name for one in told.inputs if not one.is_photograph} == {"slab.json"}
    assert any(one.is_photograph for one in told.inputs)
    again = job_again(asset, None, None)
    assert again == spec
    assert changed_inputs(asset, again, tmp_path) == []
    # The numbers that a second run gives are compared one by one.
    run(again, LocalContext(tmp_path / "again"))
    export(again, LocalContext(tmp_path / "again"))
    count, found = changed_results(asset.folder, tmp_path / "again" / "asset")
    assert count > 20
    assert found == []
    shutil.copytree(folder, tmp_path / "changed")
    (tmp_path / "changed" / "slab.json").write_text((folder / "slab.json").read_text() + " ")
    changed = again.model_copy(update={"capture": tmp_path / "changed"})
    assert changed_inputs(asset, changed, tmp_path) == ["Input slab.json is another file."]


def test_phase_functions_are_pictures_that_stand_alone(job: Path) -> None:
    picture = ElementTree.fromstring((job / "phase_532.svg").read_text())
    assert picture.tag == "{http://www.w3.org/2000/svg}svg"
    assert [part.get("class") for part in picture if part.tag.endswith("}polyline")] == ["series s0"]
    (band,) = (part for part in picture if part.tag.endswith("}polygon"))
    assert len((band.get("points") or "").split()) == 2 * len(ANGLES_RAD)
    labels = {part.text for part in picture if part.tag.endswith("}text")}
    assert {"0.05", "0.1", "0.2", "0.5"} <= labels  # of a phase function from 0.01 to 0.8 per sr
    assert "prefers-color-scheme:dark" in (picture[0].text or "")


def test_a_job_tells_of_each_wavelength_that_is_done(job: Path, spec: JobSpec, tmp_path: Path) -> None:
    told: list[StageEvent] = []
    run(spec, LocalContext(copied_checkpoint(job, tmp_path), attempt=2, listener=told.append))
    (event,) = (event for event in told if event.kind == "progress")
    assert event.data == {"wavelength_nm": 532.0, "wavelengths": 1}
    assert event.message.startswith("532 nm: σs ")


def test_the_table_is_in_the_order_of_mitsubas_cosines() -> None:
    cosines = np.linspace(-1, 1, len(tabphase_values(hg_values(0.6))))
    values = tabphase_values(hg_values(0.6))
    assert values[-1] == pytest.approx(hg_values(0.6)[0])
    # With tents of 0.9 degrees in place of the formula, g and the norm have errors of less than 1e-4.
    assert 2 * np.pi * np.trapezoid(values, cosines) == pytest.approx(1, abs=1e-3)
    assert 2 * np.pi * np.trapezoid(values * cosines, cosines) == pytest.approx(0.6, abs=1e-3)


def test_stock_mitsuba_loads_and_renders_the_asset(job: Path) -> None:
    prepare_device()
    import drjit as dr
    import mitsuba as mi

    asset, manifest = open_stage(job, "asset", AssetManifest)
    numbers = {"parameters.json", "phase.json", "errors.json", "provenance.json"}
    assert set(manifest.files) == {"tabphase_532.txt", "slab_532.xml", *numbers}
    scene = mi.load_file(str(asset / "slab_532.xml"), optimize=False)
    image = np.array(mi.render(scene, spp=4, seed=1))
    assert np.isfinite(image).all()
    assert 0 < image[32, 32, 0] < 1.5  # under light of radiance 1 from all directions
    # The plug-in's samples have the mean cosine of parameters.json, so forward is not exchanged with backward.
    phase = mi.load_dict({"type": "tabphase", "values": (asset / "tabphase_532.txt").read_text()})
    interaction, count = dr.zeros(mi.MediumInteraction3f, 100_000), 100_000
    interaction.wi = mi.Vector3f(0, 0, 1)
    interaction.sh_frame = mi.Frame3f(interaction.wi)
    draws = mi.PCG32(size=count)
    where = mi.Point2f(draws.next_float32(), draws.next_float32())
    drawn, *_ = phase.sample(mi.PhaseFunctionContext(), interaction, mi.Float(0.5), where)
    mean = float(dr.mean(dr.dot(drawn, -interaction.wi))[0])
    told = json.loads((job / "parameters.json").read_text())["532"]["g"]["value"]
    assert mean == pytest.approx(told, abs=0.01)  # 5 standard errors of 100,000 draws


def copied_checkpoint(job: Path, root: Path) -> Path:
    """Copy the checkpoint of an attempt that was killed after its wavelength was done; returns the new folder."""
    shutil.copytree(job / CHECKPOINT, root / CHECKPOINT)
    return root


def stored_fits(job: Path) -> list[dict[str, Any]]:
    """The fits that the job published."""
    fits: list[dict[str, Any]] = json.loads((job / "fit" / "manifest.json").read_text())["record"]["fits"]
    return fits


def test_a_new_attempt_takes_the_wavelengths_that_are_done(job: Path, spec: JobSpec, tmp_path: Path) -> None:
    again = run(spec, LocalContext(copied_checkpoint(job, tmp_path), attempt=2))
    assert [json.loads(fit.model_dump_json()) for fit in again.fits] == stored_fits(job)  # including core-seconds


@pytest.mark.slow
def test_a_wavelength_whose_result_is_torn_is_fitted_again_to_the_last_digit(
    job: Path, spec: JobSpec, tmp_path: Path
) -> None:
    journal = copied_checkpoint(job, tmp_path) / CHECKPOINT / "532" / JOURNAL
    lines = journal.read_bytes().splitlines(keepends=True)
    journal.write_bytes(lines[0] + lines[-2][:-9])
    again = run(spec, LocalContext(tmp_path, attempt=2)).fits[0]
    assert json.loads(again.parameters.model_dump_json()) == stored_fits(job)[0]["parameters"]
    assert again.core_seconds != stored_fits(job)[0]["core_seconds"]


@pytest.mark.parametrize("spread", [False, True])
def test_a_cancel_ends_the_fit_between_two_blocks(spread: bool, spec: JobSpec, tmp_path: Path) -> None:
    assert spec.capture is not None
    (tmp_path / CANCEL_FLAG).touch()
    task = WavelengthTask(spec.capture, 532.0, SlabOptions(effort=0.05), tmp_path / "532", tmp_path / CANCEL_FLAG)
    with pytest.raises(JobCancelledError):
        list(run_wavelengths(RecordingExecutor(8) if spread else LocalExecutor(InProcessHost()), [task], workers=1))
    assert not (tmp_path / "532").exists()


def test_many_workers_go_on_with_a_cut_wavelength_and_give_the_answer_of_one(
    job: Path, spec: JobSpec, tmp_path: Path
) -> None:
    class CutShortError(Exception):
        pass

    def cut_short(_wavelength_nm: float, checkpoint: Checkpoint) -> None:
        if checkpoint.stage == 1:
            raise CutShortError

    assert spec.capture is not None
    options = SlabOptions(seed=spec.seed, effort=spec.effort)
    task = WavelengthTask(spec.capture, 532.0, options, tmp_path / "532", tmp_path / CANCEL_FLAG)
    first, second = RecordingExecutor(8), RecordingExecutor(8)
    with pytest.raises(CutShortError):
        list(run_wavelengths(first, [task], workers=1, on_checkpoint=cut_short))
    stored: list[Checkpoint] = []
    told = run_wavelengths(second, [task], workers=1, on_checkpoint=lambda _, checkpoint: stored.append(checkpoint))
    assert list(told) == [task.place]
    # A fit from the start would report stage 0 first.
    assert first.ran
    assert len(set(second.ran)) == len(second.ran) > 100  # each block a task of its own
    assert {checkpoint.stage for checkpoint in stored} == {1}
    result = read_result(task.place)
    assert result is not None
    for name in ("parameters", "phase", "errors"):
        assert json.loads(getattr(result, name).model_dump_json()) == stored_fits(job)[0][name]
    (images,) = task.place.glob("fit-*.npz")
    assert {one.name for one in task.place.iterdir()} == {JOURNAL, images.name}


def test_sums_too_large_to_travel_stay_on_their_worker(folder: Path, tmp_path: Path) -> None:
    told = json.loads((folder / "slab.json").read_text())
    told["pixels"] |= {"columns": 512, "rows": 512}
    root, run_on = write_folder(tmp_path / "cell", told, np.full((8, 8), 0.01)), RecordingExecutor(8)
    task = WavelengthTask(root, 532.0, SlabOptions(), tmp_path / "532", tmp_path / CANCEL_FLAG)
    with pytest.raises(CaptureInputError, match="on the folder's grid"):  # because these images are smaller
        list(run_wavelengths(run_on, [task], workers=1))
    assert run_on.ran == ["532"]


def test_a_wavelength_is_told_before_the_next_one_is_fitted(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = json.loads((folder / "slab.json").read_text())
    others = [image | {"wavelength_nm": 635.0, "file": f"635_{image['file']}"} for image in told["images"]]
    root = write_folder(tmp_path / "cell", told | {"wavelengths_nm": [532.0, 635.0], "images": told["images"] + others})
    order: list[str] = []

    def fit(task: WavelengthTask, *_: object) -> Path:
        order.append(f"fitted {task.wavelength_nm:g}")
        return task.place

    class Told(LocalContext):
        def report(self, event: StageEvent) -> None:
            if event.kind == "progress":
                order.append(f"told {event.data['wavelength_nm']:g} at {event.done}")

    def stored_result(place: Path) -> SlabFit:
        return made_up_fit(float(place.name))

    monkeypatch.setattr("services.slab.schedule.fit_wavelength", fit)
    monkeypatch.setattr("services.slab.results.stored.read_result", stored_result)
    monkeypatch.setattr("services.slab.results.stored.copy_result_images", lambda *_: None)
    run(JobSpec(kind="slab", capture=root), Told(tmp_path / "job"))
    assert order == ["fitted 532", "told 532 at 0.5", "fitted 635", "told 635 at 1.0"]


def test_a_folder_of_no_slab_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CaptureInputError, match=r"holds no slab\.json, which a job of kind slab is fitted from"):
        run(JobSpec(kind="slab", capture=tmp_path), LocalContext(tmp_path / "job"))


def test_a_fault_of_the_last_wavelength_is_told_before_the_first_is_fitted(folder: Path, tmp_path: Path) -> None:
    told = json.loads((folder / "slab.json").read_text())
    write_folder(tmp_path / "cell", told)
    np.save(tmp_path / "cell" / told["images"][-1]["file"], np.zeros((3, 3)))
    with pytest.raises(CaptureInputError, match=told["images"][-1]["file"]):
        run(JobSpec(kind="slab", capture=tmp_path / "cell"), LocalContext(tmp_path / "job"))
    assert not (tmp_path / "job" / CHECKPOINT).exists()


def test_a_job_by_a_dictionary_tells_of_its_atoms(job: Path, spec: JobSpec, tmp_path: Path) -> None:
    # This test checks which results are reported; tests/unit/test_slab_dictionaries.py checks their values.
    assert spec.capture is not None
    lobes = spec.model_copy(update={"dictionary": "hg", "effort": 0.01})
    run(lobes, LocalContext(copied_checkpoint(job, tmp_path), attempt=2))  # the tents' checkpoint is not used
    export(lobes, LocalContext(tmp_path, attempt=2))
    told = load_asset(tmp_path).parameters["532"]
    assert {name for name in told if name.startswith("atoms.")} == {f"atoms.g={g:g}" for g in COSINES}
    page = (tmp_path / "report.html").read_text()
    assert "<h2>Dictionary hg, 532 nm</h2>" in page
    heaviest = max((name for name in told if name.startswith("atoms.")), key=lambda name: told[name].value)
    assert f"<td>{heaviest.replace('atoms.g=', 'σs of g ')}</td>" in page


def test_a_slab_goes_through_no_capture_and_no_preparation(spec: JobSpec) -> None:
    assert stages_of(spec) == ("fit", "export")
    assert find_preset("slab").options == {"kind": "slab"}


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"kind": "slap"}, "there is no kind of job 'slap'; the kinds are tooth, jaw, object, slab"),
        (
            {"kind": "slab", "dentin": "none"},
            "a job of kind slab has no option 'dentin'; it has capture, dictionary, effort",
        ),
        ({"kind": "slab", "dictionary": "vmf"}, "dictionary 'vmf' is not known; known are hg, mie, table, tents"),
        ({"kind": "slab", "dictionary": "mie"}, "dictionary = mie needs particle_index"),
        ({"kind": "jaw", "dictionary": "hg"}, "a job of kind jaw has no option 'dictionary'"),
        ({"kind": "slab", "rig": {"mouth": "demo"}, "capture": None}, "a job of kind slab has no option 'rig'"),
        ({"kind": "jaw", "effort": 2.0}, "a job of kind jaw has no option 'effort'; it has accept_calibration"),
        ({"kind": "slab", "effort": 0}, "0.01 or more"),
    ],
)
def test_options_that_a_kind_does_not_have_are_refused(
    options: dict[str, object], sentence: str, tmp_path: Path
) -> None:
    with pytest.raises(SettingsError, match=re.escape(sentence)):
        job_from_tree({"capture": "cell"} | options, tmp_path, "JOB.toml")


def test_options_of_a_slab_are_read_again_as_they_were_stored(spec: JobSpec) -> None:
    assert JobSpec.model_validate_json(spec.model_dump_json()) == spec


@pytest.mark.slow
@pytest.mark.parametrize("wavelengths_nm", [tuple(TRUTHS), (532.0,)])
def test_wavelengths_are_fitted_on_two_workers_as_they_are_on_one(
    wavelengths_nm: tuple[float, ...], tmp_path: Path
) -> None:
    # Two wavelengths run on one worker each, and the blocks of a single wavelength run on both.
    (cell := tmp_path / "cell").mkdir()
    write_cell(cell, *wavelengths_nm)
    asset = run_job(JobSpec(kind="slab", capture=cell, effort=0.02, workers=2), tmp_path / "two")
    assert asset.converged
    require_truths(tmp_path / "two", *wavelengths_nm)
    run_job(JobSpec(kind="slab", capture=cell, effort=0.02, workers=1), tmp_path / "one")
    for name in ("parameters.json", "phase.json", "errors.json"):
        assert (tmp_path / "one" / name).read_text() == (tmp_path / "two" / name).read_text()
