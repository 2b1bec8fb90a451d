"""Losses, solvers and priors that a job can choose, on the fake engine with a known truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.core.records import JobSpec
from services.core.results import FitReport
from services.core.stage import LocalContext, StageEvent
from services.fit.stage import run
from services.tasks.journal import read_entries
from tests.support.prepared import FAKE, TRUTH, without_time, write_prepared

QUANTITIES = [(part, leaf) for part in ("enamel", "dentin") for leaf in ("sigma_s_reduced", "alpha_reduced")]


def fit(root: Path, *, attempt: int = 1, listen: Any = None, **options: Any) -> FitReport:
    values: dict[str, Any] = {
        "capture": root, "boundary": "matched", "dentin": "known", "samples_per_pixel": 64,
        "max_samples_per_pixel": 1024, "max_steps": 8, "search_candidates": 500,
        # This engine's renders are too noisy for estimates with errors of the instrument; test_fit_instrument.py fits
        # those errors.
        "instrument": "off",
    }  # fmt: skip
    return run(JobSpec(**(values | options)), LocalContext(root, attempt, listen), engine=FAKE)


def scores(report: FitReport) -> list[float]:
    """Errors of the reduced quantities divided by their standard errors."""
    table, z = report.parameters["green"], []
    for part, leaf in QUANTITIES:
        estimate, medium = table[f"{part}.{leaf}"], getattr(TRUTH, part)
        assert estimate.se
        z.append((estimate.value - getattr(medium, leaf)) / estimate.se)
    return z


def off(report: FitReport) -> float:
    """Root mean square relative error of the reduced quantities."""
    table = report.parameters["green"]
    return float(
        np.sqrt(
            np.mean(
                [
                    (table[f"{part}.{leaf}"].value / getattr(getattr(TRUTH, part), leaf) - 1) ** 2
                    for part, leaf in QUANTITIES
                ]
            )
        )
    )


def require_truth(report: FitReport, largest: float = 0.1) -> None:
    # For one fit at one seed, errors are at most 4.5 of its standard errors, which must be small enough for a
    # meaningful test.
    table = report.parameters["green"]
    assert max(map(abs, scores(report))) < 4.5
    assert all((table[f"{part}.{leaf}"].se or 1) < largest * table[f"{part}.{leaf}"].value for part, leaf in QUANTITIES)


def test_a_tighter_tolerance_goes_on_to_smaller_errors(tmp_path: Path) -> None:
    # Both fits use one seed, so that they are identical until the one with the default tolerance has converged.
    reports = []
    asked: dict[str, dict[str, Any]] = {"default": {}, "tight": {"image_tolerance": 0.0001}}
    for name, options in asked.items():
        write_prepared(tmp_path / name)
        reports.append(fit(tmp_path / name, seed=4, advise=False, max_samples_per_pixel=16384, max_steps=20, **options))
    usual, tight = reports
    assert usual.converged
    assert tight.steps > usual.steps
    errors = [report.parameters["green"]["enamel.sigma_s_reduced"].se or 0.0 for report in reports]
    assert 0 < errors[1] < errors[0]


@pytest.mark.parametrize("loss", ["relative_l2", "l1", "relative_l1", "robust"])
def test_every_loss_finds_the_truth_where_the_model_holds(loss: str, tmp_path: Path) -> None:
    # The model explains everything except the noise, so all losses have the same minimum.
    write_prepared(tmp_path)
    require_truth(fit(tmp_path, loss=loss, advise=False))


def test_images_outvote_the_literature(tmp_path: Path) -> None:
    # Dentin's true albedo is 2.5 widths from the prior's centre. The limit of a fifth is far below the prior widths of
    # densities, which are factors of 5.7 and 3.4.
    write_prepared(tmp_path)
    require_truth(fit(tmp_path, prior="literature", advise=False), largest=0.2)


def test_a_robust_loss_forgives_shadows_by_weights_that_follow_residuals_and_are_kept(tmp_path: Path) -> None:
    # With a fifth of all measurements in shadow, the L2 fit has errors of 15 to 23 %. The robust fit's error of 2 % is
    # Monte Carlo noise.
    errors = {}
    for loss in ("l2", "robust"):
        write_prepared(tmp_path / loss, shadowed=0.2)
        errors[loss] = off(fit(tmp_path / loss, loss=loss, advise=False))
    assert errors["robust"] < 0.5 * errors["l2"]
    # The weights are computed once a round, and are stored.
    checkpoint = tmp_path / "robust" / "fit-checkpoint"
    entries = read_entries(checkpoint / "journal.jsonl")
    rounds = [key for key in entries if key.endswith("/weights")]
    assert rounds == ["green/exact/weights", "green/exact.1/weights", "green/exact.2/weights"]
    assert all((checkpoint / "inputs" / name).is_file() for key in rounds for name, _ in entries[key])


@pytest.mark.slow
def test_what_is_held_stays_and_only_the_shape_is_asked_for_where_all_media_are(tmp_path: Path) -> None:
    media = {
        f"{part}.{leaf}": getattr(getattr(TRUTH, part), leaf)
        for part in ("enamel", "dentin")
        for leaf in ("sigma", "alpha", "g1")
    }
    write_prepared(tmp_path)
    report = fit(tmp_path, dentin="fit", held=media)
    table = report.parameters["green"]
    assert {name: table[name].value for name in media} == pytest.approx(media)
    assert all(table[name].se is None for name in media)
    assert len(report.shape) == 3
    assert all(table[f"shape.{k}"].se for k in range(3))


def test_a_channel_that_takes_the_shape_from_another_has_its_error(tmp_path: Path) -> None:
    write_prepared(tmp_path, channels=("red", "green"))
    few = {"samples_per_pixel": 16, "max_samples_per_pixel": 64}
    tables = fit(tmp_path, dentin="fit", max_steps=1, advise=False, pixel_step=2, **few).parameters
    # Both channels have the same photographs, and the first one of those with equal signals fits the shape.
    parts = {channel: table["dentin.sigma_a"].se_parts for channel, table in tables.items()}
    assert "shape" not in parts["red"]
    assert parts["green"]["shape"] > 0


def test_a_held_albedo_is_not_moved_by_the_cosine(tmp_path: Path) -> None:
    write_prepared(tmp_path)
    table = fit(tmp_path, held={"enamel.alpha": 0.99}, max_steps=2, advise=False).parameters["green"]
    assert table["enamel.alpha"].value == pytest.approx(0.99)
    assert table["enamel.alpha"].se is None
    assert table["enamel.sigma"].se


@pytest.mark.slow
def test_adam_finds_the_truth_and_resumes(tmp_path: Path) -> None:
    options: dict[str, Any] = {"solver": "adam", "adam_steps": 80}
    write_prepared(tmp_path / "whole")
    report = fit(tmp_path / "whole", **options)
    # With a constant rate of 0.05 densities vary by 3 % per step, and by several times that where enamel and dentin can
    # compensate each other.
    assert off(report) < 0.15
    assert report.held_out_error["green"] < 0.02
    # Its standard errors come from normal equations at the end.
    assert all(report.parameters["green"][f"{part}.{leaf}"].se for part, leaf in QUANTITIES)
    write_prepared(tmp_path / "twice")

    class StoppedError(Exception):
        pass

    def stop(event: StageEvent) -> None:
        if event.kind == "step" and event.data["stage"] == "layered":
            raise StoppedError

    with pytest.raises(StoppedError):
        fit(tmp_path / "twice", listen=stop, **options)
    again = fit(tmp_path / "twice", attempt=2, **options)
    assert without_time(again) == without_time(report)
