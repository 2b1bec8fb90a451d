"""Fits with a formula engine to photographs whose instrument had errors: the estimated errors and the effect on ±."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from services.assets.stage import export
from services.core.calibration.uncertainty import TWIST
from services.core.records import JobSpec
from services.core.results import Estimate, FitReport, PreparedManifest
from services.core.stage import LocalContext
from services.core.store import MANIFEST, open_stage
from services.fit.measurements.observations import Observations, read_channel
from services.fit.measurements.view_stack import ViewStack
from services.fit.solve.covariance import Uncertainty, uncertainty
from services.fit.stage import run
from services.tasks.journal import read_entries
from tests.support.prepared import TRUTH, write_prepared

ENGINE = "tests.support.fake_engine:QuietFakeEngine"
OPTIONS: dict[str, Any] = {
    "boundary": "matched", "dentin": "known", "samples_per_pixel": 64, "max_steps": 15, "search_candidates": 2000,
    "advise": False,
}  # fmt: skip
TRUE = {
    f"{part}.{leaf}": value
    for part, medium in (("enamel", TRUTH.enamel), ("dentin", TRUTH.dentin))
    for leaf, value in (
        ("sigma_s_reduced", medium.sigma_s_reduced),
        ("sigma_a", (1 - medium.alpha) * medium.sigma),
    )
}


STILL = (1e-4, 1e-3)
"""Standard errors, rad and mm, of a scan that lies where the calibration says."""


def fit(
    root: Path,
    gains: tuple[float, ...] = (1.0,) * 6,
    flare: float = 0.0,
    scan_se: tuple[float, float] | None = None,
    **options: Any,
) -> FitReport:
    """Fit photographs with one gain per light and with flare, a share of the brightest pixel."""
    write_prepared(root, scan_se=scan_se)

    def photographed(observations: Observations, channel: str, spec: JobSpec) -> tuple[ViewStack, ...]:
        views = read_channel(observations, channel, spec)
        light = np.array(gains)[:, None]
        return tuple(replace(v, reference=v.reference * light + flare * v.reference.max()) for v in views)

    with patch("services.fit.stages.tooth.driver.read_channel", photographed):
        return run(JobSpec.model_validate(OPTIONS | {"capture": root} | options), LocalContext(root), engine=ENGINE)


def off(report: FitReport) -> dict[str, float]:
    """Error of each quantity of the media, divided by its ±."""
    table = report.parameters["green"]
    return {name: (table[name].value - true) / (table[name].se or np.nan) for name, true in TRUE.items()}


@pytest.fixture(scope="module")
def brighter(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, FitReport]:
    root = tmp_path_factory.mktemp("brighter")
    return root, fit(root, gains=(1.02,) * 6, scan_se=STILL, advise=True)


def test_a_gain_that_is_off_is_in_the_errors(brighter: tuple[Path, FitReport], tmp_path: Path) -> None:
    _, report = brighter
    assert report.converged, report.advice
    assert "photograph" not in report.advice
    assert not report.instrument_faults
    for name, one in report.instrument["green"].items():
        assert one.se is not None
        # With its prior, no gain and no flare is known worse than before the fit.
        if not name.startswith("teeth"):
            assert one.se <= report.instrument_prior["green"][name] * (1 + 1e-9), name
    # The gain's error is two of its ±, so it changes other quantities by at most two of their ±; noise adds to that. It
    # is the dimmer light that shows this: in brighter photographs absorption comes out smaller, and its ± with it.
    dimmer = fit(tmp_path / "on", gains=(0.98,) * 6, scan_se=STILL)
    assert max(map(abs, off(dimmer).values())) < 2.5
    alone = fit(tmp_path / "off", gains=(0.98,) * 6, scan_se=STILL, instrument="off")
    assert max(map(abs, off(alone).values())) > 4
    assert not alone.instrument
    assert alone.instrument_told[0].startswith("The standard errors take the instrument for perfect")


@pytest.mark.dear("precise fits by pairs, whose differences are small beside their noise otherwise")
def test_a_gain_that_is_off_moves_the_media_as_the_linear_model_predicts(tmp_path: Path) -> None:
    moved, predicted = (dict.fromkeys(TRUE, 0.0) for _ in range(2))
    for seed in (1, 2, 3):
        right, dimmer = (
            fit(
                tmp_path / f"{gain}-{seed}",
                gains=(gain,) * 6,
                scan_se=STILL,
                max_samples_per_pixel=4096,
                image_tolerance=0.001,
                seed=seed,
            )
            for gain in (1.0, 0.98)
        )
        for name in TRUE:
            one, other = right.parameters["green"][name], dimmer.parameters["green"][name]
            assert one.se is not None
            # Two prior errors of the gain.
            moved[name] += (other.value - one.value) / one.se / 3
            predicted[name] += 2 * one.se_parts["gain"] / one.se / 3
    for name in TRUE:
        # A distance of 0.3 is what the design allows.
        assert abs(moved[name]) == pytest.approx(predicted[name], abs=0.3), name


@pytest.mark.dear("Two pairs of fits from two seeds, each with and without more paths.")
def test_rendering_that_blurs_a_result_gets_more_paths_for_its_gradient(tmp_path: Path) -> None:
    found = []
    for largest, seed in itertools.product((1.0, 0.01), (1, 2)):
        root = tmp_path / f"{largest}-{seed}"
        with patch("services.fit.solve.precision.MAX_RENDERING", largest):
            found.append(fit(root, scan_se=STILL, seed=seed, max_samples_per_pixel=8192))
        entries = read_entries(root / "fit-checkpoint" / "journal.jsonl")
        assert ("green/refined" in entries) == (largest < 1)
        assert sum(key.startswith("green/closing") for key in entries) == 1
    blurred, sharp = found[:2], found[2:]
    for name, truth in TRUE.items():
        for one, more in zip(blurred, sharp, strict=True):
            before, after = (report.parameters["green"][name] for report in (one, more))
            # Sixteen times the paths, of which the equations before and the response keep some of their noise.
            assert after.se_parts["rendering"] < 0.6 * before.se_parts["rendering"]
            assert after.se is not None
            assert abs(after.value - truth) < 4.5 * after.se


def test_every_error_says_what_it_is_made_of(brighter: tuple[Path, FitReport]) -> None:
    _, report = brighter
    for one in (*report.parameters["green"].values(), *report.instrument["green"].values()):
        if one.se:
            assert sum(part**2 for part in one.se_parts.values()) == pytest.approx(one.se**2, rel=1e-6)
    parts = report.parameters["green"]["enamel.sigma_a"].se_parts
    assert parts["gain"] > 0
    assert parts["photographs"] > 0
    errors = [name for name in report.instrument["green"] if not name.startswith("teeth")]
    assert report.assumed == (*errors, "dome")
    assert report.instrument_told[0].startswith("Assumed, as the calibration does not state")


def test_says_which_measurement_of_the_instrument_would_help(brighter: tuple[Path, FitReport]) -> None:
    assert "Measuring the gain to 0.5 % would cut the error of" in brighter[1].next_capture


def test_a_light_that_is_far_off_is_named(tmp_path: Path) -> None:
    report = fit(tmp_path, gains=(1.0, 0.9, 1.0, 1.0, 1.0, 1.0))
    (fault,) = [told for told in report.instrument_told if "seems at fault" in told]
    assert "light_gain.l1" in fault
    found: Estimate = report.instrument["green"]["light_gain.l1"]
    assert found.se is not None
    assert abs(found.value + 0.1) < 4 * found.se


def test_a_gain_that_is_far_off_keeps_its_prior(tmp_path: Path) -> None:
    report = fit(tmp_path, gains=(1.1,) * 6, scan_se=STILL)
    found: Estimate = report.instrument["green"]["gain.green"]
    assert found.se is not None
    assert found.se <= report.instrument_prior["green"]["gain.green"] * (1 + 1e-9)
    assert "gain.green" not in report.instrument_faults.get("green", ())


def test_photographs_that_were_exchanged_are_named(tmp_path: Path) -> None:
    write_prepared(tmp_path)

    def exchanged(observations: Observations, channel: str, spec: JobSpec) -> tuple[ViewStack, ...]:
        first, second = read_channel(observations, channel, spec)
        order = [2, 1, 0, 3, 4, 5]
        return first, replace(second, reference=second.reference[order], variance=second.variance[order])

    with patch("services.fit.stages.tooth.driver.read_channel", exchanged):
        spec = JobSpec.model_validate(OPTIONS | {"capture": tmp_path, "max_steps": 2})
        report = run(spec, LocalContext(tmp_path), engine=ENGINE)
    assert "The photographs of camera c1 under lights l0 and l2 seem exchanged" in report.advice
    assert not report.converged


def test_a_stated_calibration_takes_the_place_of_what_is_assumed(tmp_path: Path) -> None:
    write_prepared(tmp_path)
    manifest = tmp_path / "prepared" / MANIFEST
    stored = json.loads(manifest.read_text())
    moves = [f"{thing}.{axis}" for thing in ("teeth", "dome") for axis in TWIST]
    names = ["gain.green", *(f"light_gain.l{k}" for k in range(6)), "flare.c0.green", "flare.c1.green", *moves]
    stated = {"names": names, "covariance": np.diag([1e-6] * len(names)).tolist()}
    stored["record"]["uncertainty"] = stated
    assert PreparedManifest.model_validate(stored["record"]).uncertainty is not None
    manifest.write_text(json.dumps(stored))
    spec = JobSpec.model_validate(OPTIONS | {"capture": tmp_path, "max_steps": 1})
    report = run(spec, LocalContext(tmp_path), engine=ENGINE)
    assert report.assumed == ()
    (told,) = report.instrument_told
    assert "which states ± 0.001 mm and ± 0.057°; the fit renders it there." in told
    assert report.instrument_prior["green"]["gain.green"] == pytest.approx(1e-3)


def test_results_and_report_show_the_instrument(brighter: tuple[Path, FitReport]) -> None:
    root, report = brighter
    export(JobSpec.model_validate(OPTIONS | {"capture": root}), LocalContext(root))
    table = json.loads((root / "parameters.json").read_text())["green"]
    assert table["gain.green"]["se"] == report.instrument["green"]["gain.green"].se
    assert table["enamel.sigma_a"]["se_parts"] == report.parameters["green"]["enamel.sigma_a"].se_parts
    page = (root / "report.html").read_text()
    assert page.index("Assumed, as the calibration") < page.index("Error on held-out images")
    assert "What each standard error is made of" in page
    assert "light_gain.l0" in page


def test_a_fit_whose_prior_took_it_too_far_looks_again_from_there(tmp_path: Path) -> None:
    found: list[Uncertainty] = []

    def cut_at_first(*args: Any, **named: Any) -> Uncertainty:
        found.append(replace(uncertainty(*args, **named), is_full_step=bool(found)))
        return found[-1]

    with patch("services.fit.solve.closing.uncertainty", cut_at_first):
        report = fit(tmp_path, gains=(1.02,) * 6)
    stage, _ = open_stage(tmp_path, "fit", FitReport)
    history = json.loads((stage / "history.json").read_text())
    assert history[-1]["stage"] == "again"
    assert [step["step"] for step in history] == list(range(1, report.steps + 1))
    assert report.converged, report.advice
    # The second end's values are reported. The first end was at the minimum, so the second one must agree with it.
    first, *_, second = found
    assert report.instrument["green"]["gain.green"].value == second.x[second.domain.tissue_count]
    assert np.abs((second.x - first.x) / np.sqrt(np.diag(first.covariance))).max() < 1
