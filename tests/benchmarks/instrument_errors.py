"""What errors of the instrument do to a fit, with its errors as coordinates and without: bias of the media over their ±, as JSON.

python -m tests.benchmarks.instrument_errors --json instrument_errors.json
python -m tests.benchmarks.instrument_errors --errors none,gain --pixel-step 3 --json gain.json

The stored central incisor as stock Mitsuba renders it, with sensor noise, is photographed by an instrument with one error: its images are scaled, or light is
added to them, or its lights are said to be elsewhere. Bias is that of the fit with the error less that of the fit without, so that what the fit itself leaves
cancels. Fits run in this process, on one thread; ``seconds`` is its processor time, ``paths`` what every image took of paths, which is what a fit costs.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.bench.fits.tooth_capture import prepared_tooth
from services.core.records import JobSpec
from services.core.results import FitReport
from services.core.stage import LocalContext
from services.core.store import open_stage
from services.fit.stage import run
from services.fit.transport.platform import prepare_device
from tests.support.truths import SIDE_LIGHTS, read, write_capture

SUBJECT = "central-incisor"
QUANTITIES = ("enamel.sigma_s_reduced", "enamel.sigma_a", "dentin.sigma_s_reduced", "dentin.sigma_a")
OPTIONS: dict[str, Any] = {"boundary": "matched", "dentin": "known", "advise": False, "held_out_lights": SIDE_LIGHTS}
LIGHT = "l0"
LIGHTS_OFF_MM = 10.0
"""Root mean square distance of the stated lights from the true ones, in a direction of its own each."""


def perturb(folder: Path, error: str) -> None:
    """Change a written capture as an instrument with an error would have: ``gain``, ``light_gain``, ``flare`` or ``lights``."""
    description = json.loads((folder / "capture.json").read_text())
    if error == "lights":
        directions = np.random.default_rng(7).standard_normal((len(description["lights"]), 3))
        directions *= LIGHTS_OFF_MM / np.linalg.norm(directions, axis=1, keepdims=True)
        for light, way in zip(description["lights"], directions, strict=True):
            light["position_mm"] = (np.array(light["position_mm"]) + way).tolist()
        (folder / "capture.json").write_text(json.dumps(description))
        return
    images: dict[str, NDArray[np.float64]] = {
        one["file"]: np.load(folder / one["file"]) for one in description["images"]
    }
    brightest = {
        camera["name"]: max(
            images[one["file"]].max() for one in description["images"] if one["camera"] == camera["name"]
        )
        for camera in description["cameras"]
    }
    changed: dict[str, Callable[[dict[str, str], NDArray[np.float64]], NDArray[np.float64]]] = {
        "none": lambda _, image: image,
        "gain": lambda _, image: 1.02 * image,
        "light_gain": lambda one, image: 1.02 * image if one["light"] == LIGHT else image,
        "flare": lambda one, image: image + 0.02 * brightest[one["camera"]],
    }
    for one in description["images"]:
        np.save(folder / one["file"], changed[error](one, images[one["file"]]))


def fit(folder: Path, error: str, **options: Any) -> dict[str, Any]:
    """One fit of the perturbed capture: values, ± and what they are made of, the instrument's errors, and what it took."""
    write_capture(SUBJECT, folder / "capture", seed=1)
    perturb(folder / "capture", error)
    spec = JobSpec.model_validate(OPTIONS | {"capture": folder / "capture"} | options)
    began = time.process_time()
    prepared_tooth(folder / "job", spec)
    run(spec, LocalContext(folder / "job"))
    seconds = time.process_time() - began
    stage, report = open_stage(folder / "job", "fit", FitReport)
    table = report.parameters["green"]
    history = json.loads((stage / "history.json").read_text())
    return {
        "error": error,
        "instrument": spec.instrument,
        "values": {name: table[name].model_dump() for name in QUANTITIES},
        "errors_found": {name: one.model_dump() for name, one in report.instrument.get("green", {}).items()},
        "told": report.instrument_told,
        "held_out_error": report.held_out_error,
        "converged": report.converged,
        "steps": report.steps,
        "samples": history[-1]["samples"],
        "seconds": seconds,
    }


def rows(fits: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Bias in percent and over its ± by error, with and without coordinates; off the truth, too."""
    truth = read(SUBJECT)
    media = {part: truth.medium(part) for part in ("enamel", "dentin")}
    true = {f"{part}.sigma_s_reduced": one["sigma_s_reduced"] for part, one in media.items()}
    true |= {f"{part}.sigma_a": (1 - one["alpha"]) * one["sigma"] for part, one in media.items()}
    clean = {one["instrument"]: one["values"] for one in fits if one["error"] == "none"}
    found = []
    for one in fits:
        row: dict[str, Any] = {
            "error": one["error"],
            "instrument": one["instrument"],
            "seconds": round(one["seconds"], 1),
        }
        for name, own in one["values"].items():
            bias = own["value"] - clean[one["instrument"]][name]["value"]
            row[name] = {
                "bias_percent": round(100 * bias / true[name], 1),
                "bias_over_se": round(bias / own["se"], 2),
                "off_truth_over_se": round((own["value"] - true[name]) / own["se"], 2),
                "se_percent": round(100 * own["se"] / true[name], 1),
            }
        found.append(row)
    return found


def main() -> None:
    """Run the fits asked for, write after each, and print the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--json", type=Path, required=True, help="where results go; fits that are in it are not run again"
    )
    parser.add_argument("--errors", default="none,gain,light_gain,flare,lights")
    parser.add_argument("--instrument", default="on,off")
    parser.add_argument("--pixel-step", type=int, default=2)
    parser.add_argument("--options", type=json.loads, default={}, help="further options of the job, as JSON")
    given = parser.parse_args()
    prepare_device(1)
    fits = json.loads(given.json.read_text())["fits"] if given.json.is_file() else []
    for error in given.errors.split(","):
        for instrument in given.instrument.split(","):
            if any(one["error"] == error and one["instrument"] == instrument for one in fits):
                continue
            with tempfile.TemporaryDirectory() as folder:
                options = {"instrument": instrument, "pixel_step": given.pixel_step} | given.options
                fits.append(fit(Path(folder), error, **options))
            told = [one for one in fits if one["error"] == "none"]
            complete = {one["instrument"] for one in fits} <= {one["instrument"] for one in told}
            given.json.write_text(json.dumps({"rows": rows(fits) if complete else [], "fits": fits}, indent=1))
            print(json.dumps(rows(fits)[-1] if complete else fits[-1]["values"]), flush=True)


if __name__ == "__main__":
    main()
