"""Accuracy that the fit of a jaw of 14 teeth must reach, tooth by tooth, on the jaw that stock Mitsuba rendered
(``tests/support/jaw_truth.py``), as JSON.

python -m tests.benchmarks.jaw_table --json jaw_table.json
python -m tests.benchmarks.jaw_table --options '{"max_samples_per_pixel": 96, "max_steps": 6}' --workers 2 \\
    --json jaw_table.json
python -m tests.benchmarks.jaw_table --options '{"dentin": "fit"}' --photographs engine --json jaw_table.json

Every visible tooth is compared to the limits of a single tooth with known dentin. The noise of sensor and renderer is
part of every figure: a medium's figure has its standard error beside it, an image's figure the error that this noise
alone gives in so few pixels. Photographs by the project's engine have the sensor's noise alone; they show the errors of
the fit, not those of the engine.
"""

from __future__ import annotations

import argparse
import json
import resource
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from services.anatomy.templates.dimensions import upper_tooth
from services.anatomy.templates.jaw import build_jaw
from services.assets.fitted_job import fitted_teeth
from services.bench.fits.jaw import prepared_jaw, reported_mouth
from services.bench.fits.tooth_capture import PreparedTooth
from services.core.records import JobSpec
from services.core.results import FitReport, PreparedManifest
from services.core.store import open_stage
from services.fit.stages.jaw.views import views_of_parts
from services.transport.optics.parameters import Mouth
from services.transport.thickness import enamel_thickness_mm
from tests.benchmarks.fit_table import Figure
from tests.support.jaw_truth import CHANNEL, SUBJECT, JawTruth, by_engine, read_jaw_truth, write_jaw_capture

IMAGE_MUST, ENAMEL_MUST, DENTIN_MUST = 0.05, 0.15, 0.10
IMAGE_GOAL, ENAMEL_GOAL, DENTIN_GOAL = 0.02, 0.05, 0.04
IMAGE = "image, held out"
THICKNESS_MUST, THICKNESS_GOAL = 0.15, 0.08
JUDGE_SAMPLES = 512
PHOTOGRAPH_SAMPLES = 2048


@dataclass(frozen=True)
class JawFigure(Figure):
    """One tooth's figure, with the part that noise can explain."""

    resolution: float = 0.0
    """For a medium, the relative standard error; for images, the error that the noise of photographs and renders alone
    gives; for thickness, the standard error in mm."""

    @property
    def is_beyond_noise(self) -> bool:
        """Whether the figure misses its limit by more than three times the resolution. Noise adds to the squares of
        image errors, so these are compared as squares.
        """
        if self.figure == IMAGE:
            return self.value**2 > self.must**2 + 3 * self.resolution**2
        return self.value > self.must + 3 * self.resolution


@dataclass(frozen=True)
class Cost:
    """Cost of a whole job, including preparation and report."""

    processor_s: float
    wall_s: float
    workers: int
    largest_process_mb: float


def fit(folder: Path, truth: JawTruth, options: dict[str, Any], workers: int) -> tuple[JobSpec, FitReport, Cost]:
    """Fit the truth with sensor noise, on local workers."""
    from services.pipeline.stages import run_job

    write_jaw_capture(folder / "capture", truth, seed=1)
    spec = JobSpec.model_validate(
        {"kind": "jaw", "capture": folder / "capture", "boundary": "matched", "dentin": "known"} | options
    )
    began, used = time.perf_counter(), _processor_s()
    run_job(spec, folder / "job", workers=workers)
    largest = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)) / 1024
    cost = Cost(_processor_s() - used, time.perf_counter() - began, workers, largest)
    return spec, open_stage(folder / "job", "fit", FitReport)[1], cost


def figures(folder: Path, truth: JawTruth, options: dict[str, Any], workers: int = 1) -> Iterator[JawFigure]:
    """Yield the figure of all images together, then those of every visible tooth."""
    spec, report, cost = fit(folder, truth, options, workers)
    images = judged(prepared_jaw(folder / "job", spec), reported_mouth(report, truth.mouth), JUDGE_SAMPLES)
    ended = f"{report.steps} steps, {'converged' if report.converged else 'not converged'}; {cost}"
    value, resolution = next(images)
    yield JawFigure("jaw", "all", IMAGE, value, IMAGE_MUST, IMAGE_GOAL, cost.processor_s, ended, resolution)
    for (fdi, tooth), true, (value, resolution) in zip(report.teeth.items(), truth.mouth.teeth, images, strict=True):
        if tooth.state != "fitted":
            continue
        note = f"{tooth.pixels} pixels"
        yield JawFigure("jaw", fdi, IMAGE, value, IMAGE_MUST, IMAGE_GOAL, cost.processor_s, note, resolution)
        for name, right, must, goal in (
            ("enamel.sigma_s_reduced", true.enamel.sigma_s_reduced, ENAMEL_MUST, ENAMEL_GOAL),
            ("dentin.alpha_reduced", 1 - true.dentin.alpha_reduced, DENTIN_MUST, DENTIN_GOAL),
        ):
            estimate = tooth.parameters[CHANNEL][name]
            found = 1 - estimate.value if name.endswith("alpha_reduced") else estimate.value
            known = f"{note}, {100 * (found / right - 1):+.1f} %" + ("" if estimate.determined else ", not determined")
            yield JawFigure(
                "jaw",
                fdi,
                name,
                abs(found / right - 1),
                must,
                goal,
                cost.processor_s,
                known,
                (estimate.se or 0.0) / found,
            )
        if tooth.shape:
            off_mm = thickness_off_mm(folder, truth, spec, report, int(fdi))
            error = tooth.enamel_thickness.se if tooth.enamel_thickness else None
            note = f"c = {', '.join(f'{c:.2f}' for c in tooth.shape)}"
            yield JawFigure(
                "jaw",
                fdi,
                "thickness, occlusal half, mm",
                off_mm,
                THICKNESS_MUST,
                THICKNESS_GOAL,
                cost.processor_s,
                note,
                error or 0.0,
            )


def thickness_off_mm(folder: Path, truth: JawTruth, spec: JobSpec, report: FitReport, fdi: int) -> float:
    """Mean absolute error of enamel's thickness (mm) over the occlusal half of a tooth's crown."""
    prepared, manifest = open_stage(folder / "job", "prepared", PreparedManifest)
    (found,) = (tooth for tooth in fitted_teeth(prepared, manifest, spec, report) if tooth.fdi == fdi)
    (true,) = (tooth for tooth in truth.jaw.teeth if tooth.fdi == fdi)
    (standing,) = (tooth for tooth in build_jaw(SUBJECT).teeth if tooth.fdi == fdi)
    assert found.dentin is not None
    assert true.dentin is not None
    height_mm = standing.frame.canonical_from_world(found.outer.vertices_mm)[:, 2]
    points = found.outer.vertices_mm[height_mm > height_mm.max() - upper_tooth(fdi % 10).crown_length_mm / 2]
    return float(np.abs(enamel_thickness_mm(points, found.dentin) - enamel_thickness_mm(points, true.dentin)).mean())


def judged(prepared: PreparedTooth, mouth: Mouth, samples: int) -> Iterator[tuple[float, float]]:
    """Yield the held-out error of all images, then of each tooth's pixels, each with the error that the noise of
    photographs and renders alone gives.
    """
    for views in (prepared.views, *(views_of_parts(prepared.views, k) for k in range(len(mouth.teeth)))):
        own = replace(prepared, views=views)
        held_out = own.errors(mouth, samples=samples, seed=23)[1]
        signal = held_out.reference_squared - held_out.reference_variance
        yield held_out.error or 0.0, (own.resolution() ** 4 + held_out.product_noise / signal**2) ** 0.25


def _processor_s() -> float:
    # Processor time of this process and of its children that have ended.
    usage = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(one.ru_utime + one.ru_stime for one in usage)


def main() -> None:
    """Print each figure when it is known, and write all of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--options", default="{}", help="options of the job, JSON")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument(
        "--photographs",
        choices=("mitsuba", "engine"),
        default="mitsuba",
        help="stored ones by stock Mitsuba, or by the project's engine",
    )
    parser.add_argument("--json", type=Path, required=True)
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = []
    truth = read_jaw_truth() if arguments.photographs == "mitsuba" else by_engine(read_jaw_truth(), PHOTOGRAPH_SAMPLES)
    with tempfile.TemporaryDirectory() as folder:
        for one in figures(Path(folder), truth, json.loads(arguments.options), arguments.workers):
            print(
                f"{one.subject:4} {one.figure:24} {one.value:.3f} ± {one.resolution:.3f} (must {one.must:g}):"
                f" {one.reached}; {one.note}",
                flush=True,
            )
            rows.append(asdict(one) | {"reached": one.reached})
            arguments.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
