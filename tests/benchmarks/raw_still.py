"""A fit of raw photographs of a tooth that does not move, without tracking frames, beside a fit of its linear images.

python -m tests.benchmarks.raw_still --capture ../shared/data/tooth-ur1-truth --folder raw-still --json raw_still.json

The folder capture, rendered by another renderer and with known optics, becomes counts of 12 bits in three exposures,
its lights up to a tenth stronger or weaker than nominal. Both captures are prepared and fitted with the same options.
It takes 25 minutes of two cores; results that are in the folder already are not computed again.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from services.core.records import FolderCapture, JobSpec
from services.core.results import PreparedManifest
from services.core.stage import LocalContext
from services.core.store import StoredArray, is_published, open_stage, read_record, write_atomic, write_record
from services.preprocess.quality.images import QualityReport
from tests.support.raw_captures import write_raw_capture
from tests.support.raw_sensor import Sensor

EXPOSURES_S = (0.0125, 0.05, 0.2)
SENSOR = Sensor(bits=12, read_counts=2.0, counts_per_electron=0.5)
LIGHT_SPREAD = 0.1
CHECKED = ("sigma_s_reduced", "sigma_a")
CHEAP = {"advise": False, "image_tolerance": 0.01, "max_samples_per_pixel": 512}


def main() -> None:
    """Prepare and fit both, and write how they differ from the truth and from each other."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", type=Path, required=True, help="folder capture with truth.json")
    parser.add_argument("--folder", type=Path, required=True, help="kept, and gone on with")
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--images-only", action="store_true", help="prepare both, and fit none")
    options = parser.parse_args()
    linear, raw = options.folder / "linear", options.folder / "raw"
    if not linear.is_dir():
        _write_linear(linear, options.capture, options.seed)
    if not raw.is_dir():
        write_raw_capture(raw, linear, SENSOR, EXPOSURES_S, tracking=0, seed=options.seed)
    jobs = {one.name: options.folder / f"{one.name}-job" for one in (linear, raw)}
    specs = {
        one.name: JobSpec.model_validate(
            {"capture": one, "boundary": "matched", "dentin": "known", "seed": options.seed, **CHEAP}
        )
        for one in (linear, raw)
    }
    told: dict[str, Any] = {"images": _prepared(specs, jobs)}
    if not options.images_only:
        rows = {name: _fitted(spec, jobs[name]) for name, spec in specs.items()}
        told |= {"fits": rows, "values": _compared(rows, options.capture)}
        whitened = [row["raw - linear, standard errors"] for row in told["values"]]
        told["rms of raw - linear, standard errors"] = float(np.sqrt(np.mean(np.square(whitened))))
    write_atomic(options.json, json.dumps(told, indent=1).encode())
    print(json.dumps(told, indent=1))


def _write_linear(target: Path, source: Path, seed: int) -> None:
    """Copy a folder capture with its lights stronger or weaker, in the images and in the description."""
    random = np.random.default_rng(seed)
    found = read_record(source / "capture.json", FolderCapture)
    factor = {light.name: float(1 + LIGHT_SPREAD * random.uniform(-1, 1)) for light in found.lights}
    target.mkdir(parents=True)
    shutil.copytree(source / "teeth", target / "teeth")
    for image in found.images:
        np.save(target / image.file, np.load(source / image.file) * np.float32(factor[image.light]))
    lights = tuple(
        light.model_copy(update={"intensity": tuple(value * factor[light.name] for value in light.intensity)})
        for light in found.lights
    )
    images = tuple(image.model_copy(update={"variance_file": None}) for image in found.images)
    write_record(target / "capture.json", found.model_copy(update={"lights": lights, "images": images}))


def _prepared(specs: dict[str, JobSpec], jobs: dict[str, Path]) -> dict[str, Any]:
    """Prepare both; returns motion and, for each image, the relative difference of raw and linear."""
    from services.preprocess.stage import run as prepare

    for name, spec in specs.items():
        if not is_published(jobs[name], "prepared"):
            prepare(spec, LocalContext(jobs[name]))
    (linear, _), (raw, manifest) = (open_stage(jobs[name], "prepared", PreparedManifest) for name in specs)
    quality = read_record(raw / "quality.json", QualityReport)
    stores = [{key: StoredArray(one / "prepared.zarr" / key) for key in ("radiance", "valid")} for one in (linear, raw)]
    differences = []
    for camera in range(len(manifest.cameras)):
        for light in range(len(manifest.lights)):
            (first, used), (second, seen) = (
                (one["radiance"][camera, light], one["valid"][camera, light]) for one in stores
            )
            both = (used == 0) & (seen == 0)
            differences.append(float(np.linalg.norm((second - first)[both]) / np.linalg.norm(first[both])))
    return {
        "images": len(differences),
        "moved": sum((image.motion_px or 0) > 0 for image in quality.images),
        "motion errors, px": [image.motion_error_px for image in quality.images],
        "sources": sorted({image.motion_source or "" for image in quality.images}),
        "median difference": float(np.median(differences)),
        "largest difference": max(differences),
    }


def _fitted(spec: JobSpec, job: Path) -> dict[str, Any]:
    from services.fit.stage import run as fit
    from services.transport.platform import prepare_device

    kept = job / "row.json"
    if not kept.is_file():
        prepare_device()
        report = fit(spec, LocalContext(job))
        (channel,) = report.parameters
        told = {
            "converged": report.converged,
            "held_out_error": report.held_out_error[channel],
            "parameters": {name: [one.value, one.se] for name, one in report.parameters[channel].items()},
            "notes": list(report.notes),
        }
        write_atomic(kept, json.dumps(told).encode())
    row: dict[str, Any] = json.loads(kept.read_text())
    return row


def _compared(rows: dict[str, dict[str, Any]], capture: Path) -> list[dict[str, Any]]:
    truth = json.loads((capture / "truth.json").read_text())
    found = []
    for name, (value, error) in rows["raw"]["parameters"].items():
        part, _, quantity = name.partition(".")
        if quantity not in CHECKED:
            continue
        other = rows["linear"]["parameters"][name][0]
        true = _true(truth[part], quantity)
        found.append(
            {
                "value": name,
                "truth": true,
                "raw": value,
                "linear": other,
                "standard error": error,
                "raw - truth, standard errors": (value - true) / error,
                "raw - linear, standard errors": (value - other) / error,
            }
        )
    return found


def _true(medium: dict[str, float], quantity: str) -> float:
    return medium["sigma_s_reduced"] if quantity == "sigma_s_reduced" else medium["sigma_t"] * (1 - medium["albedo"])


if __name__ == "__main__":
    main()
