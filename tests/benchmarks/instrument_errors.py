"""Bias of a fit by errors of the instrument, over the media's ±, with the instrument's errors as unknowns of the fit
and without, as JSON.

python -m tests.benchmarks.instrument_errors --json instrument_errors.json
python -m tests.benchmarks.instrument_errors --errors none,gain --pixel-step 3 --json gain.json
python -m tests.benchmarks.instrument_errors --errors none,far_gain,far_light,far_scan,exchanged --seeds 3 \\
    --instrument on --json faults.json
python -m tests.benchmarks.instrument_errors --errors drawn --seeds 20 --instrument on --json drawn.json

The stored central incisor, rendered by stock Mitsuba with sensor noise, is photographed by an instrument with one
error: its images are scaled, or light is added to them, or the stated positions of its lights, scan or dome are wrong.
The error is two assumed standard errors, or far more, where the fit has to name the fault; with ``drawn`` all errors
are drawn at once from the covariance that a fit assumes. Bias is the difference between the fits with and without the
error for the same seed of the sensor's noise, so that the fit's own errors cancel. Fits run in this process, on one
thread; ``seconds`` is its processor time, ``samples`` the number of paths of its last step.
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

import numpy as np
from numpy.typing import NDArray

from services.bench.fits.tooth_capture import prepared_tooth
from services.core.files.meshes import read_mesh, write_mesh
from services.core.geometry import Mesh
from services.core.records import JobSpec
from services.core.results import FitReport
from services.core.stage import LocalContext
from services.core.store import open_stage
from services.fit.instrument.errors import DEFAULT_MOVE_SE, DEFAULT_SE
from services.fit.instrument.moves import rigid
from services.fit.stage import run
from services.fit.transport.platform import prepare_device
from tests.support.truths import SIDE_LIGHTS, read, write_capture

SUBJECT = "central-incisor"
QUANTITIES = ("enamel.sigma_s_reduced", "enamel.sigma_a", "dentin.sigma_s_reduced", "dentin.sigma_a")
OPTIONS: dict[str, Any] = {"boundary": "matched", "dentin": "known", "advise": False, "held_out_lights": SIDE_LIGHTS}
LIGHT = "l0"
FAR_LIGHT = "l1"
EXCHANGED = ("l0", "l3")
"""Two fitted lights whose photographs are exchanged in every camera."""
SCAN_OFF_MM, FAR_SCAN_MM, DOME_OFF_MM, FAR_LIGHT_MM = 0.1, 1.0, 4.0, 30.0
"""Position errors: twice the assumed standard errors of scan and dome (``*_OFF_MM``), and errors far beyond any assumed
standard error (``FAR_*``)."""
FAULTS: Mapping[str, Callable[[FitReport], bool]] = {
    "far_light": lambda report: f"light_gain.{FAR_LIGHT}" in report.instrument_faults.get("green", ()),
    "far_scan": lambda report: "mm apart" in report.advice,
    "exchanged": lambda report: all(name in report.advice for name in ("seem exchanged", *EXCHANGED)),
}
"""By error: a function that says whether the report names the fault."""
LIGHTS_OFF_MM = 4.0
"""Distance of each stated light from its true position, in a random direction; of the dome, 2 mm are assumed."""


def perturb(folder: Path, error: str, seed: int) -> None:
    """Change a written capture into that of an instrument with an error: ``none`` or one of ``ERRORS``; the errors of
    ``drawn`` follow from the seed.
    """
    description = json.loads((folder / "capture.json").read_text())
    if error == "drawn":
        draw(folder, description, np.random.default_rng([29, seed]))
        return
    if error in ("lights", "dome", "far_light"):
        _move_lights(description["lights"], error)
        (folder / "capture.json").write_text(json.dumps(description))
        return
    if error in ("scan", "far_scan"):
        # Move the scan perpendicular to the first camera's line of sight; the other cameras see it obliquely.
        right = np.array(description["cameras"][0]["camera_from_world"])[0, :3]
        for path in (folder / "teeth").rglob("*.ply"):
            mesh = read_mesh(path)
            moved = mesh.vertices_mm + (FAR_SCAN_MM if error == "far_scan" else SCAN_OFF_MM) * right
            write_mesh(path, Mesh(moved, mesh.faces))
        return
    if error == "exchanged":
        first, second = EXCHANGED
        other = {first: second, second: first}
        for one in description["images"]:
            one["light"] = other.get(one["light"], one["light"])
        (folder / "capture.json").write_text(json.dumps(description))
        return
    images, brightest = photographs(folder, description)
    lights = [light["name"] for light in description["lights"]]
    each = dict(zip(lights, 0.02 * np.random.default_rng(11).standard_normal(len(lights)), strict=True))
    changed: dict[str, Callable[[dict[str, str], NDArray[np.float64]], NDArray[np.float64]]] = {
        "none": lambda _, image: image,
        "gain": lambda _, image: 1.02 * image,
        "far_gain": lambda _, image: 1.1 * image,
        "light_gain": lambda one, image: 1.02 * image if one["light"] == LIGHT else image,
        "light_gains": lambda one, image: (1 + each[one["light"]]) * image,
        "flare": lambda one, image: image + 0.006 * brightest[one["camera"]],
        "far_flare": lambda one, image: image + 0.02 * brightest[one["camera"]],
    }
    for one in description["images"]:
        np.save(folder / one["file"], changed[error](one, images[one["file"]]))


def photographs(folder: Path, description: dict[str, Any]) -> tuple[dict[str, NDArray[np.float64]], dict[str, float]]:
    """The capture's images by their file, and the value of each camera's brightest pixel by its name."""
    images = {one["file"]: np.load(folder / one["file"]) for one in description["images"]}
    brightest = {
        camera["name"]: max(
            float(images[one["file"]].max()) for one in description["images"] if one["camera"] == camera["name"]
        )
        for camera in description["cameras"]
    }
    return images, brightest


def draw(folder: Path, description: dict[str, Any], rng: np.random.Generator) -> None:
    """Change a written capture by errors of gain, lights, flare, scan and dome, drawn from their assumed covariance."""
    images, brightest = photographs(folder, description)
    gain = rng.normal(0, DEFAULT_SE["gain"])
    lights = {light["name"]: rng.normal(0, DEFAULT_SE["light_gain"]) for light in description["lights"]}
    flare = {name: rng.normal(0, DEFAULT_SE["flare"]) * brightest[name] for name in brightest}
    for one in description["images"]:
        photograph = (1 + gain + lights[one["light"]]) * images[one["file"]] + flare[one["camera"]]
        np.save(folder / one["file"], photograph)

    places_mm = np.array([light["position_mm"] for light in description["lights"]])
    move = rigid(rng.normal(0, DEFAULT_MOVE_SE["dome"]), places_mm.mean(axis=0))
    for light, place_mm in zip(description["lights"], places_mm, strict=True):
        light["position_mm"] = (move[:3, :3] @ place_mm + move[:3, 3]).tolist()
    (folder / "capture.json").write_text(json.dumps(description))

    scans = sorted((folder / "teeth").rglob("*.ply"))
    outer_mm = read_mesh(next(path for path in scans if path.stem == "outer")).vertices_mm
    move = rigid(rng.normal(0, DEFAULT_MOVE_SE["teeth"]), outer_mm.mean(axis=0))
    for path in scans:
        mesh = read_mesh(path)
        write_mesh(path, Mesh(mesh.vertices_mm @ move[:3, :3].T + move[:3, 3], mesh.faces))


ERRORS = (
    "drawn", "gain", "light_gain", "light_gains", "flare", "lights", "dome", "scan", "far_gain", "far_flare", *FAULTS,
)  # fmt: skip


def _move_lights(lights: list[dict[str, Any]], error: str) -> None:
    if error == "lights":
        ways = np.random.default_rng(7).standard_normal((len(lights), 3))
        ways *= LIGHTS_OFF_MM / np.linalg.norm(ways, axis=1, keepdims=True)
    else:
        # Move the dome to the side, or one light towards the tooth, where its brightness shows the error.
        towards = -np.array([light["position_mm"] for light in lights])
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        chosen = np.array([error == "dome" or light["name"] == FAR_LIGHT for light in lights])
        way = np.array([DOME_OFF_MM, 0.0, 0.0]) if error == "dome" else FAR_LIGHT_MM * towards
        ways = chosen[:, None] * way
    for light, way in zip(lights, ways, strict=True):
        light["position_mm"] = (np.array(light["position_mm"]) + way).tolist()


def fit(folder: Path, error: str, seed: int = 1, **options: Any) -> dict[str, Any]:
    """Fit the perturbed capture; returns values with their ± and parts of these, the estimated errors of the
    instrument, and the fit's cost.

    Args:
        seed: seed of the sensor's noise.
    """
    write_capture(SUBJECT, folder / "capture", seed=seed)
    perturb(folder / "capture", error, seed)
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
        "seed": seed,
        "instrument": spec.instrument,
        "faults": report.instrument_faults.get("green", ()),
        "advice": report.advice,
        "named": FAULTS[error](report) if error in FAULTS else None,
        "values": {name: table[name].model_dump() for name in QUANTITIES},
        "correlation": report.correlations["green"].model_dump(),
        "errors_found": {name: one.model_dump() for name, one in report.instrument.get("green", {}).items()},
        "told": report.instrument_told,
        "held_out_error": report.held_out_error,
        "converged": report.converged,
        "steps": report.steps,
        "samples": history[-1]["samples"],
        "seconds": seconds,
    }


def rows(fits: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row per fit: each quantity's bias in per cent of the truth and over its ±, and its error over its ±."""
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
            bias = own["value"] - clean[one["instrument"], one["seed"]][name]["value"]
            row[name] = {
                "bias_percent": round(100 * bias / true[name], 1),
                "bias_over_se": round(bias / own["se"], 2),
                "off_truth_over_se": round((own["value"] - true[name]) / own["se"], 2),
                "se_percent": round(100 * own["se"] / true[name], 1),
            }
        found.append(row)
    return found


def main() -> None:
    """Run the fits asked for, write the file after each, and print the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--json", type=Path, required=True, help="where results go; fits that are in it are not run again"
    )
    parser.add_argument(
        "--errors", default="none,gain,light_gain,light_gains,flare,lights,dome,scan", help=f"none or of {ERRORS}"
    )
    parser.add_argument("--seeds", type=int, default=1, help="fits of each, by seeds of the sensor's noise from 1")
    parser.add_argument("--instrument", default="on,off")
    parser.add_argument("--pixel-step", type=int, default=2)
    parser.add_argument("--options", type=json.loads, default={}, help="further options of the job, as JSON")
    given = parser.parse_args()
    prepare_device(1)
    fits = json.loads(given.json.read_text())["fits"] if given.json.is_file() else []
    for seed, error, instrument in product(
        range(1, given.seeds + 1), given.errors.split(","), given.instrument.split(",")
    ):
        if any((one["seed"], one["error"], one["instrument"]) == (seed, error, instrument) for one in fits):
            continue
        with tempfile.TemporaryDirectory() as folder:
            options = {"instrument": instrument, "pixel_step": given.pixel_step} | given.options
            fits.append(fit(Path(folder), error, seed, **options))
        told = {(one["instrument"], one["seed"]) for one in fits if one["error"] == "none"}
        complete = {(one["instrument"], one["seed"]) for one in fits} <= told
        given.json.write_text(json.dumps({"rows": rows(fits) if complete else [], "fits": fits}, indent=1))
        print(json.dumps(rows(fits)[-1] if complete else fits[-1]["values"]), flush=True)


if __name__ == "__main__":
    main()
