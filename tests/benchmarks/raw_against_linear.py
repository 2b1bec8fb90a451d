"""What a fit of raw photographs reaches beside one of the linear images that they were taken of.

python -m tests.benchmarks.raw_against_linear --folder raw-against-linear --json raw_against_linear.json

The demonstration's tooth in three channels, one camera and eight lights, two of them held out. A known sensor takes
it: a mosaic of 12 bits, three exposures four times apart, shot and read noise, black frames, tracking frames, flat
fields. Both captures are prepared and fitted in green with the same options, at means over 2 x 2 pixels: those of
0.25 mm become those of 0.5 mm that the demonstration fits, each a whole cell of the mosaic. Neither capture tells the
noise that the images have of their rendering, so it counts in both errors; ``scene_noise`` is how much it is, and
``ratio_without`` the errors' ratio once it is taken out. Some 10 minutes of a core; what is in the folder already is
not made again.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from services.core.records import FolderCapture, JobSpec, PreparedManifest
from services.core.stage import LocalContext
from services.core.store import StoredArray, is_published, open_stage, read_record, write_atomic, write_record
from services.phantom.tooth import write_phantom
from tests.support.raw_captures import write_raw_capture
from tests.support.raw_sensor import Sensor

PIXEL_MM, LIGHTS, STEP = 0.25, 8, 2
EXPOSURES_S = (0.0125, 0.05, 0.2)
SENSOR = Sensor(bits=12, read_counts=2.0, counts_per_electron=0.5, mosaic="RGGB")
"""8,000 electrons at full scale: half of a small-pixel camera's, and 1.1 % of noise there."""
CHANNEL = "green"


def main() -> None:
    """Photograph, prepare and fit both, and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True, help="kept, and gone on with")
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--samples", type=int, default=2048, help="paths per pixel of the photographed images")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    truth = options.folder / "truth"
    if not (truth / "capture.json").is_file():
        write_phantom(truth, pixel_mm=PIXEL_MM, cameras=1, lights=LIGHTS, channels=3, samples=options.samples, seed=1)
    captures = {"linear": options.folder / "linear", "raw": options.folder / "raw"}
    if not captures["linear"].is_dir():
        _write_linear(captures["linear"], truth)
    if not captures["raw"].is_dir():
        write_raw_capture(captures["raw"], truth, SENSOR, EXPOSURES_S, seed=options.seed)
    rows = {name: _fitted(capture, options.folder / f"{name}-job", options.seed) for name, capture in captures.items()}
    noise = _scene_noise(truth, options.folder / "linear-job")
    errors = {name: row["held_out_error"] for name, row in rows.items()}
    without = {name: float(np.sqrt(max(error**2 - noise**2, 0.0))) for name, error in errors.items()}
    told = {
        **rows,
        "scene_noise": noise,
        "ratio": errors["raw"] / errors["linear"],
        "without_scene_noise": without,
        "ratio_without": without["raw"] / without["linear"] if without["linear"] else None,
    }
    write_atomic(options.json, json.dumps(told, indent=1).encode())
    print(json.dumps(told, indent=1))


def _write_linear(target: Path, truth: Path) -> None:
    """The images as they are, without what is known of their noise."""
    description = read_record(truth / "capture.json", FolderCapture)
    target.mkdir()
    (target / "teeth").symlink_to(truth.resolve() / "teeth")
    for image in description.images:
        (target / image.file).symlink_to(truth.resolve() / image.file)
    images = tuple(image.model_copy(update={"variance_file": None}) for image in description.images)
    write_record(target / "capture.json", description.model_copy(update={"images": images}))


def _fitted(capture: Path, job: Path, seed: int) -> dict[str, Any]:
    """Errors, parameters and processor time of one capture's preparation and fit."""
    from services.fit.stage import run as fit
    from services.fit.transport.platform import prepare_device
    from services.preprocess.stage import run as prepare

    kept = job / "row.json"
    if kept.is_file():
        row: dict[str, Any] = json.loads(kept.read_text())
        return row
    tree = {"capture": capture, "boundary": "matched", "dentin": "known", "channels": [CHANNEL], "seed": seed}
    spec = JobSpec.model_validate(tree | {"pixel_step": STEP, "advise": False, "held_out_lights": ["l3", "l7"]})
    prepare_device()
    if not is_published(job, "prepared"):
        prepare(spec, LocalContext(job))
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


def _scene_noise(truth: Path, job: Path) -> float:
    """Noise of the held-out images' rendering, relative to them, in means over the squares that are fitted."""
    description = read_record(truth / "capture.json", FolderCapture)
    stage, prepared = open_stage(job, "prepared", PreparedManifest)
    channel = description.channels.index(CHANNEL)
    valid = StoredArray(stage / "prepared.zarr" / "valid")
    lights = [light.name for light in prepared.lights]
    spread, light = 0.0, 0.0
    for image in description.images:
        if (image.camera, image.light) not in prepared.held_out or image.variance_file is None:
            continue
        used = _squares(valid[0, lights.index(image.light)] == 0).all(axis=-1)
        mean, variance = (
            _squares(np.load(truth / file)[..., channel].astype(float))[used]
            for file in (image.file, image.variance_file)
        )
        spread += float(variance.mean(axis=-1).sum()) / STEP**2
        light += float((mean.mean(axis=-1) ** 2).sum())
    return float(np.sqrt(spread / (light - spread)))


def _squares(image: np.ndarray) -> np.ndarray:
    """(h, w, STEP²) values of each whole square."""
    height, width = (length // STEP for length in image.shape)
    cut = image[: height * STEP, : width * STEP].reshape(height, STEP, width, STEP)
    return np.moveaxis(cut, 2, 1).reshape(height, width, STEP**2)


if __name__ == "__main__":
    main()
