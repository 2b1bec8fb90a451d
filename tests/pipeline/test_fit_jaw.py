"""A jaw's fit through the stage's ``run``: all teeth with gums and wall, a tooth that fails, a hidden tooth, and the
stored results.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.assets.fitted_job import fitted_teeth
from services.assets.stage import export
from services.core.errors import CaptureInputError, DentineError, InputError, SettingsError
from services.core.records import JobSpec
from services.core.results import FitReport, PreparedManifest
from services.core.stage import LocalContext, StageEvent
from services.core.store import open_stage
from services.fit.coordinates.priors import SHAPE
from services.fit.stage import ENGINE, run
from services.fit.stages.jaw.schedule import TIED_SD
from services.transport.platform import prepare_device
from services.transport.thickness import enamel_thickness_mm
from tests.support.prepared import without_time
from tests.support.small_jaw import FDI, TRUE_GUMS, TRUE_REFLECTANCE, TRUE_TEETH, jaw_spec, write_prepared_jaw

FAKE = "tests.support.fake_mouth:FakeMouthEngine"
FITTED, FAILED, TIED = ("11", "12"), "21", "22"
PRECISE = {"samples_per_pixel": 128, "max_samples_per_pixel": 2048}
"""Options under which held-out errors lie well below 2 %; with the usual ones noise alone makes them as large."""


def spec_for(root: Path, **options: Any) -> JobSpec:
    return jaw_spec(root, **({"samples_per_pixel": 64, "max_samples_per_pixel": 512} | options))


def fit(root: Path, attempt: int = 1, events: list[StageEvent] | None = None, **options: Any) -> FitReport:
    return run(
        spec_for(root, **options),
        LocalContext(root, attempt, events.append if events is not None else None),
        engine=FAKE,
    )


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, FitReport, list[StageEvent]]:
    root, events = tmp_path_factory.mktemp("jaw"), list[StageEvent]()
    write_prepared_jaw(root, FAKE, dark=(21,), hidden=(22,))
    return root, fit(root, events=events, **PRECISE), events


def test_teeth_that_are_seen_are_found_within_their_errors(finished: tuple[Path, FitReport, list[StageEvent]]) -> None:
    _, report, _ = finished
    for fdi in FITTED:
        tooth = report.teeth[fdi]
        assert (tooth.state, tooth.sentence) == ("fitted", "")
        assert tooth.held_out_error["green"] < 0.02
        for part in ("enamel", "dentin"):
            for leaf in ("sigma_s_reduced", "alpha_reduced"):
                estimate = tooth.parameters["green"][f"{part}.{leaf}"]
                truth = getattr(TRUE_TEETH[int(fdi)].medium(part), leaf)
                assert estimate.se is not None
                # For one fit at one seed, errors are at most 4.5 of its standard errors.
                assert abs(estimate.value - truth) < 4.5 * estimate.se, (fdi, part, leaf, estimate)
    table = report.parameters["green"]
    for name, truth in (("gums.alpha_reduced", TRUE_GUMS.alpha_reduced), ("cavity.reflectance", TRUE_REFLECTANCE)):
        assert abs(table[name].value - truth) < 4.5 * (table[name].se or 0.0), (name, table[name])


def test_a_failed_tooth_does_not_sink_the_jaw(finished: tuple[Path, FitReport, list[StageEvent]]) -> None:
    _, report, _ = finished
    assert report.converged, report.advice
    tooth = report.teeth[FAILED]
    assert tooth.state == "failed"
    assert "Tooth 21 is dark" in tooth.sentence
    assert tooth.sentence in report.advice
    assert "green" not in tooth.fit_error


def test_hidden_and_failed_teeth_are_held_near_the_others_and_marked(
    finished: tuple[Path, FitReport, list[StageEvent]],
) -> None:
    _, report, _ = finished
    assert report.teeth[TIED].state == "tied"
    assert "hidden or masked in every image" in report.teeth[TIED].sentence
    for fdi in (TIED, FAILED):
        for part in ("enamel", "dentin"):
            found = report.teeth[fdi].parameters["green"][f"{part}.sigma_s_reduced"]
            others = [
                np.log(report.teeth[other].parameters["green"][f"{part}.sigma_s_reduced"].value) for other in FITTED
            ]
            # No fitted pixel of the formula depends on these quantities, so they stay at their prior: the median of the
            # two front teeth in the last stage.
            assert np.log(found.value) == pytest.approx(np.mean(others), abs=TIED_SD["sigma"])
            assert not found.determined
            assert found.se == pytest.approx(TIED_SD["sigma"] * found.value, rel=0.01)


def test_steps_of_single_teeth_come_before_those_of_the_whole(
    finished: tuple[Path, FitReport, list[StageEvent]],
) -> None:
    root, report, events = finished
    steps = [e.data for e in events if e.kind == "step"]
    assert [s["step"] for s in steps] == list(range(1, report.steps + 1))
    teeth = [s["tooth"] for s in steps]
    assert set(teeth) == {11, 12, None}
    assert teeth.index(None) == len(teeth) - teeth[::-1].index(12)
    stages = {s["stage"] for s in steps if s["tooth"] is None}
    # The last stage runs again where the prior of the instrument's errors has changed the result much.
    assert stages - {"again"} == {"start.0", "start.1", "start.2", "joint", "exact"}
    folder, stored = open_stage(root, "fit", FitReport)
    assert stored == report
    assert len(json.loads((folder / "history.json").read_text())) == report.steps
    assert all(e.done is None or 0 <= e.done <= 1 for e in events)


def test_enamel_of_one_mouth_has_one_mean_cosine(finished: tuple[Path, FitReport, list[StageEvent]]) -> None:
    tables = [tooth.parameters["green"] for tooth in finished[1].teeth.values()]
    assert len({round(table["enamel.mean_cosine"].value, 9) for table in tables}) == 1
    assert all(table["enamel.mean_cosine"].se for table in tables)
    assert {table["dentin.mean_cosine"].se for table in tables} == {None}


def test_export_names_every_tooth(finished: tuple[Path, FitReport, list[StageEvent]]) -> None:
    root, report, _ = finished
    manifest = export(spec_for(root), LocalContext(root))
    assert {f"teeth/{fdi}/{part}.ply" for fdi in FDI for part in ("outer", "dentin")} | {
        "gums.ply",
        "cavity.ply",
        "scene_green.xml",
    } <= set(manifest.files)
    parameters = json.loads((root / "parameters.json").read_text())["green"]
    assert parameters["12.dentin.sigma"] == report.teeth["12"].parameters["green"]["dentin.sigma"].model_dump()
    assert {"gums.sigma", "cavity.reflectance"} <= parameters.keys()
    assert json.loads((root / "errors.json").read_text())["teeth"]["21"]["state"] == "failed"
    prepare_device()
    import mitsuba as mi

    mi.set_variant("llvm_ad_mono")
    scene = mi.load_file(str(root / "asset" / "scene_green.xml"), optimize=False, width_0=20, height_0=16)
    image = np.array(mi.render(scene, sensor=0, spp=16))
    assert np.isfinite(image).all()
    assert image.mean() > 0
    page = (root / "report.html").read_text()
    assert "Jaw of 4 teeth" in page
    assert report.teeth[FAILED].sentence in page


def test_interrupted_fit_resumes_and_ends_with_the_same_answer(
    finished: tuple[Path, FitReport, list[StageEvent]], tmp_path: Path
) -> None:
    _, report, _ = finished
    write_prepared_jaw(tmp_path, FAKE, dark=(21,), hidden=(22,))
    joint = next(e.data["step"] for e in finished[2] if e.kind == "step" and e.data["tooth"] is None)

    class StoppedError(Exception):
        pass

    for attempt, stop_at in enumerate((3, joint), start=1):

        def stop(event: StageEvent, stop_at: int = stop_at) -> None:
            if event.kind == "step" and event.data["step"] == stop_at:
                raise StoppedError

        with pytest.raises(StoppedError):
            run(spec_for(tmp_path, **PRECISE), LocalContext(tmp_path, attempt, stop), engine=FAKE)
    events: list[StageEvent] = []
    assert without_time(fit(tmp_path, attempt=3, events=events, **PRECISE)) == without_time(report)
    assert min(e.data["step"] for e in events if e.kind == "step") == joint + 1


@pytest.mark.dear("Blend weights are found by all stages of a jaw's fit, of photographs with little noise.")
def test_dentin_of_every_tooth_that_is_seen_is_fitted(tmp_path: Path) -> None:
    truth: tuple[float, ...] = (1.0, 0.0, 1.0)
    # This engine's renders are too noisy to estimate a shape together with errors of the instrument;
    # test_jaw_instrument.py fits those errors.
    options: dict[str, Any] = {
        "dentin": "fit", "max_samples_per_pixel": 1024, "max_steps": 3, "search_candidates": 400, "instrument": "off"
    }  # fmt: skip
    write_prepared_jaw(tmp_path, FAKE, (11, 12, 21), hidden=(21,), shape=truth, noise=0.003, samples=20_000)
    report = fit(tmp_path, **options)
    # Sixty pixels determine a weight to 0.2 to 0.5, and the weak prior halves that. So all six together are required to
    # be nearer to the truth than at the start.
    found = np.array([report.teeth[fdi].shape for fdi in ("11", "12")])
    assert np.sqrt(((found - truth) ** 2).mean()) < 0.75 * np.sqrt(((SHAPE[0] - np.array(truth)) ** 2).mean()), found
    for fdi in ("11", "12"):
        tooth = report.teeth[fdi]
        for k, (weight, true) in enumerate(zip(tooth.shape, truth, strict=True)):
            estimate = tooth.parameters["green"][f"shape.{k}"]
            assert estimate.value == weight
            assert estimate.se is not None
            assert abs(weight - true) < 4.5 * estimate.se
        assert tooth.enamel_thickness is not None
        assert tooth.enamel_thickness.se is not None
    # The hidden tooth keeps the initial shape, and its thickness is unknown.
    assert report.teeth["21"].shape == (SHAPE[0],) * 3
    assumed = report.teeth["21"].enamel_thickness
    assert assumed is None or (assumed.se is None and not assumed.determined)
    (prepared, manifest), spec = open_stage(tmp_path, "prepared", PreparedManifest), spec_for(tmp_path, **options)
    first, _, _ = fitted_teeth(prepared, manifest, spec, report)
    assert first.dentin is not None
    thickness = enamel_thickness_mm(first.outer.vertices_mm, first.dentin)
    assert 0.1 < thickness.mean() < 2.0


@pytest.mark.slow
def test_engine_finds_teeth_gums_and_wall_together(tmp_path: Path) -> None:
    # The two teeth have no dentin, so that a few hundred pixels determine every number. The photographs have another
    # seed and 1 % of sensor noise.
    write_prepared_jaw(tmp_path, ENGINE, (11, 12), dentin=False)
    # The instrument of these photographs is perfect, and the limits below are for noise alone.
    spec = jaw_spec(
        tmp_path, dentin="none", samples_per_pixel=64, max_samples_per_pixel=256, max_steps=4, search_candidates=1600,
        instrument="off"
    )  # fmt: skip
    report = run(spec, LocalContext(tmp_path))
    found = {
        name: report.parameters["green"][name]
        for name in ("gums.sigma_s_reduced", "gums.alpha_reduced", "cavity.reflectance")
    }
    truth = {
        "gums.sigma_s_reduced": TRUE_GUMS.sigma_s_reduced,
        "gums.alpha_reduced": TRUE_GUMS.alpha_reduced,
        "cavity.reflectance": TRUE_REFLECTANCE,
    }
    for fdi in ("11", "12"):
        for leaf in ("sigma_s_reduced", "alpha_reduced"):
            found[f"{fdi}.{leaf}"] = report.teeth[fdi].parameters["green"][f"enamel.{leaf}"]
            truth[f"{fdi}.{leaf}"] = getattr(TRUE_TEETH[int(fdi)].enamel, leaf)
    for name, estimate in found.items():
        assert estimate.determined, (name, estimate)
        assert estimate.se is not None
        # For one fit at one seed, errors are at most 4.5 of its standard errors, which must be small enough for a
        # meaningful test.
        assert abs(estimate.value - truth[name]) < 4.5 * estimate.se, (name, truth[name], estimate)
        assert estimate.se < 0.15 * estimate.value, (name, estimate)
    assert report.held_out_error["green"] < 0.05


@pytest.mark.parametrize(
    ("prepared", "options", "kind", "words"),
    [
        ({"fdi": (11,)}, {}, CaptureInputError, "at least two teeth"),
        ({"fdi": (11, 12)}, {"kind": "tooth"}, CaptureInputError, "set kind to 'jaw'"),
        ({"fdi": (11, 12)}, {"lobes": 2}, SettingsError, "lobes = 1, not 2"),
        ({"fdi": (11, 12)}, {"held": {"enamel.sigma": 4.5}}, SettingsError, "held = {}, not {'enamel.sigma': 4.5}"),
        ({"fdi": (11, 12)}, {"stains": True}, SettingsError, "stains = False"),
        ({"fdi": (11, 12)}, {"solver": "adam"}, SettingsError, "solver = 'gauss-newton'"),
        ({"fdi": (11, 12)}, {"loss": "robust"}, SettingsError, "loss = 'l2'"),
        ({"fdi": (11, 12), "dark": (11, 12)}, {}, InputError, "No tooth of the jaw can be fitted"),
    ],
)
def test_what_cannot_be_a_jaw_is_refused_in_one_sentence(
    tmp_path: Path, prepared: dict[str, Any], options: dict[str, Any], kind: type[DentineError], words: str
) -> None:  # fmt: skip
    write_prepared_jaw(tmp_path, FAKE, **prepared)
    with pytest.raises(kind) as caught:
        fit(tmp_path, **options)
    assert words in caught.value.message
    assert caught.value.message.count(". ") == 0
