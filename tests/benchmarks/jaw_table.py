"""The row "jaw of 14" of what a fit must reach, tooth by tooth, on the jaw that stock Mitsuba rendered (``tests/support/jaw_truth.py``), as JSON.

python -m tests.benchmarks.jaw_table --out jaw_table.json
python -m tests.benchmarks.jaw_table --options '{"max_samples_per_pixel": 96, "max_steps": 6}' --workers 2 --out jaw_table.json

Every visible tooth is held to the limits of a single one with known dentin. The photographs' own noise, that of the sensor and of the renderer, is part of
every number: a medium's figure comes with its standard error, an image's with the error that this noise alone looks like in so few pixels.
"""

from __future__ import annotations

import argparse
import json
import resource
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from services.core.records import FitReport, JobSpec
from services.core.store import open_stage
from services.fit.jaw_views import label_views
from services.fit.observations import read_channel, read_observations
from tests.benchmarks.fit_table import Figure
from tests.support.jaw_truth import CHANNEL, JawTruth, read_jaw_truth, write_jaw_capture

IMAGE_MUST, ENAMEL_MUST, DENTIN_MUST = 0.05, 0.15, 0.10
IMAGE_GOAL, ENAMEL_GOAL, DENTIN_GOAL = 0.02, 0.05, 0.04


@dataclass(frozen=True)
class JawFigure(Figure):
    """One tooth's number, with what noise makes of it."""

    resolution: float = 0.0
    """Of a medium one standard error of its logarithm, where errors are even; of images the error that the photographs' noise looks like."""

    @property
    def is_beyond_noise(self) -> bool:
        """Whether it misses its limit by more than three times what noise does; squares of image errors are what noise adds to."""
        if self.figure.startswith("image"):
            return self.value**2 > self.must**2 + 3 * self.resolution**2
        return self.value > self.must + 3 * self.resolution


@dataclass(frozen=True)
class Cost:
    """Of a whole job, preparation and report included."""

    processor_s: float
    wall_s: float
    workers: int
    largest_process_mb: float


def fit(folder: Path, options: dict[str, Any], workers: int) -> tuple[JawTruth, JobSpec, FitReport, Cost]:
    """Fit the stored truth with sensor noise, on local workers."""
    from services.api.pipeline import run_job

    truth = read_jaw_truth()
    write_jaw_capture(folder / "capture", truth, seed=1)
    spec = JobSpec.model_validate({"kind": "jaw", "capture": folder / "capture", "boundary": "matched", "dentin": "known"} | options)
    began, used = time.perf_counter(), _processor_s()
    run_job(spec, folder / "job", workers=workers)
    largest = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)) / 1024
    cost = Cost(_processor_s() - used, time.perf_counter() - began, workers, largest)
    return truth, spec, open_stage(folder / "job", "fit", FitReport)[1], cost


def figures(folder: Path, options: dict[str, Any], workers: int = 1) -> Iterator[JawFigure]:
    """Every visible tooth's numbers, those of all images together first."""
    truth, spec, report, cost = fit(folder, options, workers)
    resolved = _resolutions(folder / "job", spec)
    ended = f"{report.steps} steps, {'converged' if report.converged else 'not converged'}; {cost}"
    yield JawFigure("jaw", "all", "image, held out", report.held_out_error[CHANNEL], IMAGE_MUST, IMAGE_GOAL, cost.processor_s, ended, resolved["all"])
    for (fdi, tooth), true in zip(report.teeth.items(), truth.mouth.teeth, strict=True):
        if tooth.state != "fitted":
            continue
        note = f"{tooth.pixels} pixels"
        yield JawFigure("jaw", fdi, "image, held out", tooth.held_out_error[CHANNEL], IMAGE_MUST, IMAGE_GOAL, cost.processor_s, note, resolved[fdi])
        for name, value, must, goal in (
            ("enamel.sigma_s_reduced", true.enamel.sigma_s_reduced, ENAMEL_MUST, ENAMEL_GOAL),
            ("dentin.alpha_reduced", true.dentin.alpha_reduced, DENTIN_MUST, DENTIN_GOAL),
        ):
            found, whole = tooth.parameters[CHANNEL][name], 1 - value if name.endswith("alpha_reduced") else value
            measured = 1 - found.value if name.endswith("alpha_reduced") else found.value
            off, error = abs(measured / whole - 1), (found.se or 0.0) / measured
            yield JawFigure("jaw", fdi, name, off, must, goal, cost.processor_s, note + ("" if found.determined else ", not determined"), error)


def _processor_s() -> float:
    # Of this process and of children that have ended.
    usage = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(one.ru_utime + one.ru_stime for one in usage)


def _resolutions(job: Path, spec: JobSpec) -> dict[str, float]:
    # By FDI number: one standard deviation of the square of the held-out error by the photographs' noise, as an error.
    observations = read_observations(job, spec)
    reference, variance, shown = [], [], []
    for view in label_views(read_channel(observations, CHANNEL, spec), observations):
        chosen = view.valid & view.held_out[:, None]
        assert view.parts is not None
        reference.append(view.reference[chosen])
        variance.append(view.variance[chosen])
        shown.append(np.broadcast_to(view.parts.shown, chosen.shape)[chosen])
    r, v, part = (np.concatenate(arrays) for arrays in (reference, variance, shown))

    def resolution(pixels: np.ndarray[Any, np.dtype[np.bool_]]) -> float:
        r_own, v_own = r[pixels], v[pixels]
        return float((2 * v_own @ v_own) ** 0.25 / np.sqrt(r_own @ r_own - v_own.sum()))

    teeth = {str(tooth.fdi): part == k for k, tooth in enumerate(observations.teeth)}
    return {name: resolution(pixels) for name, pixels in ({"all": np.ones(len(part), dtype=bool)} | teeth).items() if pixels.any()}


def main() -> None:
    """Print the figures as they come and write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--options", default="{}", help="options of the job, JSON")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for one in figures(Path(folder), json.loads(arguments.options), arguments.workers):
            print(f"{one.subject:4} {one.figure:24} {one.value:.3f} ± {one.resolution:.3f} (must {one.must:g}): {one.reached}; {one.note}", flush=True)
            rows.append(asdict(one) | {"reached": one.reached})
            arguments.out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
