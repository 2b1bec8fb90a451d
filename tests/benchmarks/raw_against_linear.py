"""Comparison of a fit of raw photographs to a fit of the linear images from which they were made.

python -m tests.benchmarks.raw_against_linear --folder raw-against-linear --json raw_against_linear.json

The scene is the demonstration's tooth under eight lights, two of them held out, as its first camera sees it. Its images
with pixels of 0.5 mm are interpolated and photographed at twice the resolution by a known sensor: a mosaic of 12 bits,
three exposures with factors of four between them, shot and read noise, black frames, tracking frames, flat fields. Red
and blue are the rendered green times a constant. Both captures are prepared and fitted in green with the same options,
with means over 2 x 2 pixels. Neither capture states the noise of the rendering, so it is part of both errors;
``scene_noise`` is its size, and ``ratio_without`` the ratio of the errors without it. It takes some minutes of a core;
results that are in the folder already are not computed again.
"""

from __future__ import annotations

import argparse
import json
import shutil
import time
from pathlib import Path
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np

from services.bench.fits.tooth_capture import prepared_tooth, tissue_of
from services.core.records import FolderCapture, JobSpec
from services.core.results import PreparedManifest
from services.core.stage import LocalContext
from services.core.store import StoredArray, is_published, open_stage, read_record, write_atomic, write_record
from services.fit.passes.evaluate import ErrorSums
from services.phantom.tooth import write_phantom
from tests.support.raw_captures import write_raw_capture
from tests.support.raw_sensor import Sensor

CELL = 2
"""Pixels of the sensor along the side of a pixel of the demonstration; fits average over squares of this side."""
KEPT_NOISE = (0.75**2 + 2 * 0.125**2) ** 2
"""Factor by which interpolation and the mean over a cell lower the images' variance: a cell's mean has the weights 1/8,
3/4, 1/8 along each side."""
CHANNELS, SHADES = ("red", "green", "blue"), (1.1, 1.0, 0.8)
"""Channels, and the radiance of a tooth in each relative to green."""
EXPOSURES_S = (0.0125, 0.05, 0.2)
SENSOR = Sensor(bits=12, read_counts=2.0, counts_per_electron=0.5, mosaic="RGGB")
"""Sensor with 8,000 electrons at full scale, half of those of a camera with small pixels; shot noise there is 1.1 %."""
CHEAP = MappingProxyType({"image_tolerance": 0.01, "max_samples_per_pixel": 256})
"""Options of a cheap fit; more precision would not show beside the images' noise of 3 %."""
JUDGE_PASS = 1024
"""Paths per pixel of one pass of the renders that judge a fit."""
CHANNEL, HELD_OUT = "green", ["l3", "l7"]


def main() -> None:
    """Write, prepare and fit both captures, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True, help="kept, and gone on with")
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--samples", type=int, default=8192, help="paths per pixel of the tooth's images")
    parser.add_argument("--judge-samples", type=int, default=4096, help="paths per pixel that judge a fit, twice")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--images-only", action="store_true", help="prepare both, and fit none")
    options = parser.parse_args()
    mouth = options.folder / "mouth"
    if not (mouth / "capture.json").is_file():
        write_phantom(mouth, cameras=1, lights=8, samples=options.samples, seed=options.seed)
    captures = {"linear": options.folder / "linear", "raw": options.folder / "raw"}
    if not captures["linear"].is_dir():
        _write_linear(captures["linear"], mouth)
    if not captures["raw"].is_dir():
        write_raw_capture(captures["raw"], captures["linear"], SENSOR, EXPOSURES_S, seed=options.seed)
    jobs = {name: options.folder / f"{name}-job" for name in captures}
    specs = {name: _spec(capture, options.seed) for name, capture in captures.items()}
    for name, spec in specs.items():
        _prepare(spec, jobs[name])
    told: dict[str, Any] = {"images": _images_error(jobs)}
    if not options.images_only:
        rows = {name: _fitted(spec, jobs[name]) for name, spec in specs.items()}
        rows = {name: row | _errors(specs[name], jobs[name], row, options.judge_samples) for name, row in rows.items()}
        told |= _judged(rows, mouth, jobs["linear"])
    write_atomic(options.json, json.dumps(told, indent=1).encode())
    print(json.dumps(told, indent=1))


def _judged(rows: dict[str, dict[str, Any]], truth: Path, job: Path) -> dict[str, Any]:
    """The fits, and the ratio of their errors with and without the rendering's noise."""
    noise = _scene_noise(truth, job)
    errors = {name: row["held_out_error"] for name, row in rows.items()}
    without = {name: float(np.sqrt(max(error**2 - noise**2, 0.0))) for name, error in errors.items()}
    return {
        **rows,
        "scene_noise": noise,
        "ratio": errors["raw"] / errors["linear"] if errors["linear"] else None,
        "without_scene_noise": without,
        "ratio_without": without["raw"] / without["linear"] if without["linear"] else None,
    }


def _write_linear(target: Path, mouth: Path) -> None:
    """Write the first camera's images in three channels, at the sensor's pixels, without their variance."""
    found = read_record(mouth / "capture.json", FolderCapture)
    (column, row, last), (width, height) = found.cameras[0].K, found.cameras[0].size
    K = tuple(tuple(CELL * value for value in line) for line in (column, row))
    camera = found.cameras[0].model_copy(update={"K": (*K, last), "size": (CELL * width, CELL * height)})
    images = [one for one in found.images if one.camera == camera.name]
    shutil.copytree(mouth / "teeth", target / "teeth")
    for image in images:
        # Interpolate linearly, as a lens blurs; steps between cells would shift the mosaic's colours relative to each
        # other.
        fine = cv2.resize(np.load(mouth / image.file)[..., 0], camera.size, interpolation=cv2.INTER_LINEAR)
        np.save(target / image.file, (fine[..., None] * SHADES).astype(np.float32))
    changes = {
        "channels": CHANNELS,
        "cameras": (camera,),
        "lights": tuple(light.model_copy(update={"intensity": light.intensity[:1] * 3}) for light in found.lights),
        "images": tuple(image.model_copy(update={"variance_file": None}) for image in images),
    }
    write_record(target / "capture.json", found.model_copy(update=changes))


def _spec(capture: Path, seed: int) -> JobSpec:
    tree = {"capture": capture, "boundary": "matched", "dentin": "known", "channels": [CHANNEL], "seed": seed}
    tree |= {"pixel_step": CELL, "held_out_lights": HELD_OUT, "advise": False}
    return JobSpec.model_validate({**tree, **CHEAP})


def _prepare(spec: JobSpec, job: Path) -> None:
    from services.preprocess.stage import run as prepare

    if not is_published(job, "prepared"):
        prepare(spec, LocalContext(job))


def _images_error(jobs: dict[str, Path]) -> dict[str, float]:
    """Relative rms difference between prepared photographs and the images, over squares that are valid in both.

    ``noise`` is the difference that the photographs' stated variance explains, and ``systematic`` the rest, whose
    square adds to that of a fit's error.
    """
    (linear, first), (raw, second) = (
        open_stage(jobs[name], "prepared", PreparedManifest) for name in ("linear", "raw")
    )
    channel = first.channels.index(CHANNEL)
    apart, spread, light = 0.0, 0.0, 0.0
    for camera in range(len(first.cameras)):
        for place, lamp in enumerate(first.lights):
            other = [one.name for one in second.lights].index(lamp.name)

            def of(stage: Path, name: str, number: int, camera: int = camera) -> np.ndarray:
                values = StoredArray(stage / "prepared.zarr" / name)[camera, number]
                return _squares(values if values.ndim == 2 else values[..., channel].astype(float))

            used = (of(linear, "valid", place) == 0).all(axis=-1) & (of(raw, "valid", other) == 0).all(axis=-1)
            true, seen, variance = (
                of(stage, name, number)[used].mean(axis=-1)
                for stage, name, number in (
                    (linear, "radiance", place),
                    (raw, "radiance", other),
                    (raw, "variance", other),
                )
            )
            apart += float(((seen - true) ** 2).sum())
            spread += float(variance.sum()) / CELL**2
            light += float((true**2).sum())
    total, noise = np.sqrt([apart / light, spread / light])
    systematic = np.sqrt(max(apart - spread, 0.0) / light)
    return {"error": float(total), "noise": float(noise), "systematic": float(systematic)}


def _fitted(spec: JobSpec, job: Path) -> dict[str, Any]:
    """Fit a prepared capture; returns errors, parameters and time. A result in the job's folder is read instead."""
    from services.fit.stage import run as fit
    from services.transport.platform import prepare_device

    kept = job / "row.json"
    if kept.is_file():
        row: dict[str, Any] = json.loads(kept.read_text())
        return row
    prepare_device()
    _, prepared = open_stage(job, "prepared", PreparedManifest)
    began_s = time.perf_counter()
    report = fit(spec, LocalContext(job))
    row = {
        "held_out_error": report.held_out_error[CHANNEL],
        "held_out_error_se": report.held_out_error_se[CHANNEL],
        "fit_error": report.fit_error[CHANNEL],
        "converged": report.converged,
        "parameters": {name: {"value": one.value, "se": one.se} for name, one in report.parameters[CHANNEL].items()},
        "median_motion_px": prepared.median_motion_px,
        "valid_fraction": prepared.valid_fraction,
        "seconds": time.perf_counter() - began_s,
    }
    write_atomic(kept, json.dumps(row).encode())
    return row


def _errors(spec: JobSpec, job: Path, row: dict[str, Any], samples: int) -> dict[str, float]:
    """Errors of a fit, from renders with ``samples`` paths per pixel and with the same seeds for both captures."""
    tissue = tissue_of({name: one["value"] for name, one in row["parameters"].items()})
    tooth, fitted, held_out = prepared_tooth(job, spec), ErrorSums(), ErrorSums()
    for seed in range(1, max(samples // JUDGE_PASS, 1) + 1):
        own, kept = tooth.errors(tissue, samples=min(samples, JUDGE_PASS), seed=seed)
        fitted, held_out = fitted + own, held_out + kept
    assert held_out.error is not None
    assert held_out.error_se is not None
    assert fitted.error is not None
    told = {"held_out_error": held_out.error, "held_out_error_se": held_out.error_se, "fit_error": fitted.error}
    return {**{f"fit's own {name}": row[name] for name in told}, **told}


def _scene_noise(mouth: Path, job: Path) -> float:
    """Relative noise of the held-out images from their rendering."""
    stage, prepared = open_stage(job, "prepared", PreparedManifest)
    valid = StoredArray(stage / "prepared.zarr" / "valid")
    names, spread, light = [one.name for one in prepared.lights], 0.0, 0.0
    for image in read_record(mouth / "capture.json", FolderCapture).images:
        if (image.camera, image.light) in prepared.held_out and image.variance_file is not None:
            used = (_squares(valid[0, names.index(image.light)]) == 0).all(axis=-1)
            mean, variance = (np.load(mouth / file)[..., 0][used] for file in (image.file, image.variance_file))
            spread += float(variance.sum(dtype=float))
            light += float((mean.astype(float) ** 2).sum())
    spread *= KEPT_NOISE
    return float(np.sqrt(spread / (light - spread)))


def _squares(image: np.ndarray) -> np.ndarray:
    """Reshape an image (H, W) to the values (H // CELL, W // CELL, CELL²) of each whole square."""
    height, width = (length // CELL for length in image.shape)
    cut = image[: height * CELL, : width * CELL].reshape(height, CELL, width, CELL)
    return np.moveaxis(cut, 2, 1).reshape(height, width, CELL**2)


if __name__ == "__main__":
    main()
