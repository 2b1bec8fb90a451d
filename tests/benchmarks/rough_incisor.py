"""What fits recover of the micro-CT incisor with a rough surface from stock Mitsuba's images of it
(``tests.benchmarks.render_rough_incisor``), and what the unbent surface ``thin`` makes of the same images.

python -m tests.benchmarks.rough_incisor --seeds 1-4 --boundaries rough,thin --json rough_incisor.json

Each seed draws sensor noise and an error of the scan of 0.02 mm, correlated over 1 mm, for enamel and dentin. The
roughness is measured by the highlights of one set of photographs. The media are fitted with this roughness to a second
set, as through crossed polarisers: the truth's own noise of a fifth of a pixel's value would hide highlights from the
mask. Fits that the folder holds already are not run again, and a fit that was stopped goes on.

``error`` and ``se`` are relative to the truth, ``absorbed`` is 1 - alpha', ``parts`` are those of ``se``, ``seconds``
is the processor time of the fit without preparation and roughness.
"""

from __future__ import annotations

import argparse
import json
import time
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.bench.fits.tooth_capture import photograph
from services.core.files.meshes import read_mesh, write_mesh
from services.core.geometry import teeth_folder
from services.core.records import Boundary, JobSpec
from services.core.results import Estimate, FitReport
from services.core.stage import LocalContext
from services.core.store import is_published, open_stage, read_record, write_atomic
from services.fit.measurements.observations import read_observations
from services.fit.measurements.surface import held_surface
from services.fit.stage import run
from services.phantom.files import medium_truth
from services.phantom.render import variance_of_neighbours
from services.preprocess.stage import run as prepare
from services.transport.platform import prepare_device
from tests.benchmarks.render_rough_incisor import (
    FDI,
    IOR,
    ROUGHNESS,
    SOURCE,
    SUMS,
    TISSUE,
    highlights,
    sums,
)
from tests.support.glossy_bodies import scanned

CACHE = SUMS.parent / "rough-incisor-fits"
HEIGHT_MM, LENGTH_MM = 0.02, 1.0
"""Standard deviation of the scan's error, and the length over which it is correlated."""
TRUTH = {part: medium_truth(getattr(TISSUE, part)) for part in ("enamel", "dentin")}
OPTIONS: dict[str, Any] = {
    "ior": IOR, "multiple_scattering": "off", "instrument": "off", "dentin": "known", "advise": False,
    "motion": "off", "max_samples_per_pixel": 4096,
}  # fmt: skip
Images = NDArray[np.float64]


def write_capture(target: Path, mean: Images, variance: Images, seed: int) -> None:
    """Write radiance (C, L, H, W) and its variance as a capture with the noise of one seed.

    Args:
        target: folder of the new capture.
        mean, variance: the true images, and the variance by which they are uncertain themselves, which is taken from
            each pixel's neighbours (``variance_of_neighbours``).
        seed: of the sensor's noise and of the scan's error.
    """
    random, variance = np.random.default_rng([66, seed]), variance_of_neighbours(variance)
    description = json.loads((SOURCE / "capture.json").read_text())
    cameras, lights = ([one["name"] for one in description[key]] for key in ("cameras", "lights"))
    target.mkdir(parents=True, exist_ok=True)
    for image in description["images"]:
        place = cameras.index(image["camera"]), lights.index(image["light"])
        taken, noise = photograph(mean[place], variance[place], random)
        np.save(target / image["file"], taken[..., None])
        np.save(target / image["variance_file"], noise[..., None])
    folder = teeth_folder(target, FDI)
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("outer.ply", "dentin.ply"):
        mesh = read_mesh(teeth_folder(SOURCE, FDI) / name)
        # The waves of one seed are a field in space, so both surfaces are displaced alike where they are close.
        write_mesh(folder / name, scanned(mesh, HEIGHT_MM, LENGTH_MM, seed))
    (target / "capture.json").write_text(json.dumps(description))


def rows_of(job: Path, boundary: Boundary, seed: int, roughness: Estimate) -> list[dict[str, Any]]:
    """What the fit of a job found, beside the truth."""
    report = open_stage(job, "fit", FitReport)[1]
    (channel,) = report.parameters
    table, found = report.parameters[channel], []

    def add(name: str, value: float, true: float, estimate: Estimate) -> None:
        parts = {part: se / true for part, se in estimate.se_parts.items()}
        found.append(
            {
                "boundary": boundary, "seed": seed, "quantity": name, "error": value / true - 1,
                "se": (estimate.se or 0.0) / true, "parts": parts,
            }
        )  # fmt: skip

    for part, truth in TRUTH.items():
        reduced, absorbed = table[f"{part}.sigma_s_reduced"], table[f"{part}.alpha_reduced"]
        add(f"{part} sigma_s_reduced", reduced.value, truth["sigma_s_reduced"], reduced)
        add(f"{part} absorbed", 1 - absorbed.value, 1 - truth["alpha_reduced"], absorbed)
    if boundary == "rough":
        add("roughness", roughness.value, ROUGHNESS, roughness)
    for name, errors, ses in (
        ("fitted images", report.fit_error, report.fit_error_se),
        ("held-out images", report.held_out_error, report.held_out_error_se),
    ):
        found.append(
            {"boundary": boundary, "seed": seed, "quantity": name, "error": errors[channel], "se": ses[channel]}
        )
    return found


def captures(folder: Path, seed: int) -> tuple[Path, Path]:
    """The captures of a seed without and with highlights; written where they are not."""
    polarised, whole = folder / f"polarised-{seed}", folder / f"highlights-{seed}"
    for capture in (polarised, whole):
        if not (capture / "capture.json").is_file():
            found = sums()
            if found.batches.min() < 2:
                raise SystemExit(
                    "The images are not rendered yet; run python -m tests.benchmarks.render_rough_incisor."
                )
            inside = np.maximum(found.mean, 0)
            write_capture(capture, inside + highlights() if capture is whole else inside, found.variance, seed)
    return polarised, whole


def measured_roughness(folder: Path, seed: int) -> Estimate:
    """The roughness by the highlights of one seed's photographs."""
    kept, job = folder / f"roughness-{seed}.json", folder / f"roughness-{seed}"
    if not kept.is_file():
        spec = JobSpec.model_validate(OPTIONS | {"capture": captures(folder, seed)[1], "boundary": "rough"})
        if not is_published(job, "prepared"):
            prepare(spec, LocalContext(job))
        surface = held_surface(spec, read_observations(job, spec), job, print)
        assert surface is not None
        write_atomic(kept, surface.roughness.model_dump_json().encode())
    return read_record(kept, Estimate)


def fitted(folder: Path, boundary: Boundary, seed: int, options: dict[str, Any]) -> list[dict[str, Any]]:
    """Write, prepare and fit one capture, unless the folder holds the result; its rows."""
    job = folder / f"{boundary}-{seed}"
    kept = job / "rows.json"
    if kept.is_file():
        rows: list[dict[str, Any]] = json.loads(kept.read_text())
        return rows
    roughness, capture = measured_roughness(folder, seed), captures(folder, seed)[0]
    own = {"capture": capture, "boundary": boundary, "seed": seed, "roughness": roughness.value, "highlights": False}
    spec, context = JobSpec.model_validate(OPTIONS | options | own), LocalContext(job)
    if not is_published(job, "prepared"):
        prepare(spec, context)
    begun_s = time.process_time()
    run(spec, context)
    rows = [row | {"seconds": round(time.process_time() - begun_s)} for row in rows_of(job, boundary, seed, roughness)]
    write_atomic(kept, json.dumps(rows).encode())
    return rows


def summary(rows: list[dict[str, Any]]) -> list[str]:
    """By boundary and quantity: the root mean square over seeds of the error, and the mean of the standard errors."""
    told, keys = [], dict.fromkeys((row["boundary"], row["quantity"]) for row in rows)
    for boundary, quantity in keys:
        own = [row for row in rows if (row["boundary"], row["quantity"]) == (boundary, quantity)]
        errors, ses = (np.array([row[name] for row in own]) for name in ("error", "se"))
        rms = float(np.sqrt(np.mean(errors**2)))
        told.append(f"{boundary}, {quantity}: rms {rms:.1%} over {len(own)}, ± {ses.mean():.1%} stated")
    return told


def main() -> None:
    """Print each fit, and the errors over all seeds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--boundaries", default="rough,thin")
    parser.add_argument("--seeds", default="1-4", help="first and last seed")
    parser.add_argument("--options", default="{}", help="options of every fit's job, JSON")
    parser.add_argument("--folder", type=Path, default=CACHE)
    parser.add_argument("--json", type=Path, required=True)
    given = parser.parse_args()
    prepare_device(threads=1)
    first, _, last = given.seeds.partition("-")
    found: list[dict[str, Any]] = []
    for boundary, seed in product(given.boundaries.split(","), range(int(first), int(last or first) + 1)):
        for row in fitted(given.folder, boundary, seed, json.loads(given.options)):
            found.append(row)
            parts = ", ".join(f"{name} {se:.1%}" for name, se in row.get("parts", {}).items())
            told = f"{row['error']:+.1%} ± {row['se']:.1%} ({parts}), {row['seconds']} s"
            print(f"{boundary}, seed {seed}, {row['quantity']}: {told}", flush=True)
        given.json.write_text(json.dumps(found, indent=1) + "\n")
    for line in summary(found):
        print(line)


if __name__ == "__main__":
    main()
