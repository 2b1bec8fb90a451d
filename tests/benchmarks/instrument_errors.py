"""Bias of a fit by errors of the instrument, over the media's ±, with the instrument's errors as unknowns of the fit
and without, as JSON.

python -m tests.benchmarks.instrument_errors --json instrument_errors.json
python -m tests.benchmarks.instrument_errors --errors none,gain --pixel-step 3 --json gain.json
python -m tests.benchmarks.instrument_errors --errors none,far_gain,far_light,far_scan,exchanged --seeds 3 \\
    --instrument on --json faults.json
python -m tests.benchmarks.instrument_errors --errors drawn --seeds 37-51 --instrument on --json drawn.json

The stored central incisor, rendered by stock Mitsuba with sensor noise, is photographed by an instrument with one error
(``instrument_perturbations``), which is two assumed standard errors, or far more, where the fit has to name the fault;
with ``drawn`` all errors are drawn at once from the covariance that a fit assumes. Bias is the difference between the
fits with and without the error for the same seed of the sensor's noise, so that the fit's own errors cancel. Errors of
``drawn`` are also told over their ± after whitening by the fit's own covariance, because the quantities share a gain
and their errors are not independent. Fits run in this process, on one thread; ``seconds`` is its processor time,
``samples`` the number of paths of its last step.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Mapping
from itertools import product
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from services.bench.fits.tooth_capture import prepared_tooth
from services.core.records import JobSpec
from services.core.results import FitReport
from services.core.stage import LocalContext
from services.core.store import open_stage
from services.fit.coordinates.domain import Domain
from services.fit.solve.covariance import Uncertainty
from services.fit.solve.estimates import DERIVED, estimates
from services.fit.stage import run
from services.fit.stages.tooth import driver
from services.transport.optics.parameters import Tissue
from services.transport.platform import prepare_device
from tests.benchmarks.instrument_perturbations import ERRORS, EXCHANGED, FAR_LIGHT, perturb
from tests.support.truths import SIDE_LIGHTS, read, write_capture

Array = NDArray[np.float64]

SUBJECT = "central-incisor"
QUANTITIES = ("enamel.sigma_s_reduced", "enamel.sigma_a", "dentin.sigma_s_reduced", "dentin.sigma_a")
OPTIONS: dict[str, Any] = {"boundary": "matched", "dentin": "known", "advise": False, "held_out_lights": SIDE_LIGHTS}
FAULTS: Mapping[str, Callable[[FitReport], bool]] = {
    "far_light": lambda report: f"light_gain.{FAR_LIGHT}" in report.instrument_faults.get("green", ()),
    "far_scan": lambda report: "mm apart" in report.advice,
    "exchanged": lambda report: all(name in report.advice for name in ("seem exchanged", *EXCHANGED)),
}
"""By error: a function that says whether the report names the fault."""


def fit(folder: Path, error: str, seed: int = 1, **options: Any) -> dict[str, Any]:
    """Fit the perturbed capture; returns values with their ± and parts of these, the estimated errors of the
    instrument, and the fit's cost.

    Args:
        seed: seed of the sensor's noise.
    """
    write_capture(SUBJECT, folder / "capture", seed=seed)
    perturb(folder / "capture", error, seed)
    spec = JobSpec.model_validate(OPTIONS | {"capture": folder / "capture"} | options)
    solutions: list[tuple[Tissue, Uncertainty]] = []

    def kept(tissue: Tissue, parts: Any, uncertainty: Uncertainty, *more: Any) -> Any:
        solutions.append((tissue, uncertainty))
        return estimates(tissue, parts, uncertainty, *more)

    began = time.process_time()
    prepared_tooth(folder / "job", spec)
    with patch.object(driver, "estimates", kept):
        run(spec, LocalContext(folder / "job"))
    seconds = time.process_time() - began
    stage, report = open_stage(folder / "job", "fit", FitReport)
    table = report.parameters["green"]
    history = json.loads((stage / "history.json").read_text())
    return {
        "error": error,
        "seed": seed,
        "instrument": spec.instrument,
        "faults": report.instrument_faults.get("green", ()),
        "advice": report.advice,
        "named": FAULTS[error](report) if error in FAULTS else None,
        "values": {name: table[name].model_dump() for name in QUANTITIES},
        "relative_covariance": relative_covariance(*solutions[0]).tolist(),
        "errors_found": {name: one.model_dump() for name, one in report.instrument.get("green", {}).items()},
        "told": report.instrument_told,
        "held_out_error": report.held_out_error,
        "converged": report.converged,
        "steps": report.steps,
        "samples": history[-1]["samples"],
        "seconds": seconds,
    }


def relative_covariance(tissue: Tissue, uncertainty: Uncertainty) -> Array:
    """Covariance (Q, Q) of the relative errors of the reported quantities."""
    slopes = relative_slopes(uncertainty.domain, tissue, uncertainty.x)
    return np.asarray(slopes @ uncertainty.covariance @ slopes.T)


def relative_slopes(domain: Domain, tissue: Tissue, x: Array, step: float = 1e-5) -> Array:
    """Derivatives (Q, F) of the logarithms of the reported quantities by the coordinates, by central differences."""

    def logarithms(moved: Array) -> Array:
        media = {part: domain.tissue_at(moved, tissue).medium(part) for part in ("enamel", "dentin")}
        named = (name.split(".") for name in QUANTITIES)
        return np.log([DERIVED[leaf][1](media[part]) for part, leaf in named])

    shifts = step * np.eye(len(x))
    return np.transpose([(logarithms(x + shift) - logarithms(x - shift)) / (2 * step) for shift in shifts])


def whitened(distances: Array, covariance: Array) -> Array:
    """Distances (Q,) from the truth over their ±, without the correlations of a covariance (Q, Q)."""
    se = np.sqrt(np.diag(covariance))
    return np.asarray(np.linalg.solve(np.linalg.cholesky(covariance / np.outer(se, se)), distances))


def rows(fits: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row per fit: each quantity's error over its ±, raw and whitened, and where the fit of the unperturbed capture
    is among them, its bias in per cent of the truth and over its ±.
    """
    truth = read(SUBJECT)
    media = {part: truth.medium(part) for part in ("enamel", "dentin")}
    true = {f"{part}.sigma_s_reduced": one["sigma_s_reduced"] for part, one in media.items()}
    true |= {f"{part}.sigma_a": (1 - one["alpha"]) * one["sigma"] for part, one in media.items()}
    clean = {(one["instrument"], one["seed"]): one["values"] for one in fits if one["error"] == "none"}
    found = []
    for one in fits:
        row: dict[str, Any] = {
            "error": one["error"],
            "instrument": one["instrument"],
            "seed": one["seed"],
            "named": one["named"],
            "faults": one["faults"],
            "seconds": round(one["seconds"], 1),
        }
        for name, own in one["values"].items():
            row[name] = {
                "off_truth_over_se": round((own["value"] - true[name]) / own["se"], 2),
                "se_percent": round(100 * own["se"] / true[name], 1),
            }
            if (one["instrument"], one["seed"]) in clean:
                bias = own["value"] - clean[one["instrument"], one["seed"]][name]["value"]
                row[name]["bias_percent"] = round(100 * bias / true[name], 1)
                row[name]["bias_over_se"] = round(bias / own["se"], 2)
        distances = np.array([row[name]["off_truth_over_se"] for name in QUANTITIES])
        row["whitened"] = whitened(distances, np.array(one["relative_covariance"])).round(2).tolist()
        found.append(row)
    return found


def summary(table: list[dict[str, Any]]) -> str:
    """How far drawn fits lie from the truth, as rms over their ±, raw and whitened, and what they name as faults."""
    distances = np.array([[row[name]["off_truth_over_se"] for name in QUANTITIES] for row in table])
    errors = np.array(
        [[row[name]["off_truth_over_se"] * row[name]["se_percent"] for name in QUANTITIES] for row in table]
    )
    told = {
        "rms": np.sqrt((distances**2).mean()),
        "rms_whitened": np.sqrt((np.array([row["whitened"] for row in table]) ** 2).mean()),
        "within_95_percent": (np.abs(distances) <= 1.96).mean(),
    }
    by_quantity = {
        "median_se_percent": np.median([[row[name]["se_percent"] for name in QUANTITIES] for row in table], axis=0),
        "rms_error_percent": np.sqrt((errors**2).mean(axis=0)),
    }
    return json.dumps(
        {"fits": len(table), "values": distances.size}
        | {name: round(float(value), 2) for name, value in told.items()}
        | {name: dict(zip(QUANTITIES, value.round(1).tolist(), strict=True)) for name, value in by_quantity.items()}
        | {"named": {row["seed"]: row["faults"] for row in table if row["faults"]}}
    )


def main() -> None:
    """Run the fits asked for, write the file after each, and print the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--json", type=Path, required=True, help="where results go; fits that are in it are not run again"
    )
    parser.add_argument(
        "--errors", default="none,gain,light_gain,light_gains,flare,lights,dome,scan", help=f"none or of {ERRORS}"
    )
    parser.add_argument("--seeds", type=_seeds, default=(1,), help="3 for 1 to 3, or 37-51: of the sensor's noise")
    parser.add_argument("--instrument", default="on,off")
    parser.add_argument("--pixel-step", type=int, default=2)
    parser.add_argument("--options", type=json.loads, default={}, help="further options of the job, as JSON")
    given = parser.parse_args()
    prepare_device(1)
    fits = json.loads(given.json.read_text())["fits"] if given.json.is_file() else []
    for seed, error, instrument in product(given.seeds, given.errors.split(","), given.instrument.split(",")):
        if any((one["seed"], one["error"], one["instrument"]) == (seed, error, instrument) for one in fits):
            continue
        with tempfile.TemporaryDirectory() as folder:
            options = {"instrument": instrument, "pixel_step": given.pixel_step} | given.options
            fits.append(fit(Path(folder), error, seed, **options))
        table = rows(fits)
        given.json.write_text(json.dumps({"rows": table, "fits": fits}, indent=1))
        print(json.dumps(table[-1]), flush=True)
    drawn = [row for row in rows(fits) if row["error"] == "drawn"]
    if drawn:
        print(summary(drawn))


def _seeds(text: str) -> tuple[int, ...]:
    first, dash, last = text.partition("-")
    return tuple(range(int(first), int(last) + 1)) if dash else tuple(range(1, int(first) + 1))


if __name__ == "__main__":
    main()
