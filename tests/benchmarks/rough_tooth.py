"""What each boundary model makes of the same images of a tooth whose surface is rough: those of stock Mitsuba of the
procedural incisor with its true dentin, one channel. Stock Mitsuba loses light that meets several facets, and so do the
fits.

python -m tests.benchmarks.rough_tooth --boundaries rough,thin --json rough_tooth.json

``error`` and ``se`` are relative to the truth; ``absorbed`` is 1 - α'.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from services.core.records import Boundary, JobSpec
from services.core.results import FitReport
from services.core.stage import LocalContext
from services.fit.stage import run
from services.phantom.tooth import write_phantom
from services.preprocess.stage import run as prepare
from services.transport.platform import prepare_device

CHANNEL = "green"


@dataclass(frozen=True)
class Row:
    """One quantity of one fit, or an error of its images, which has no truth but 0."""

    boundary: Boundary
    quantity: str
    error: float
    se: float
    seconds: float
    """Processor time of preparation and fit."""


def rows(capture: Path, job: Path, boundary: Boundary, *, roughness: float, max_samples: int) -> Iterator[Row]:
    """Fit a capture under a boundary model, and compare with its truth."""
    spec = JobSpec(
        capture=capture, boundary=boundary, roughness=roughness, multiple_scattering="off", instrument="off",
        dentin="known", advise=False, max_samples_per_pixel=max_samples,
    )  # fmt: skip
    context, begun_s = LocalContext(job), time.process_time()
    prepare(spec, context)
    report = run(spec, context)
    seconds = time.process_time() - begun_s
    truth = json.loads((capture / "truth.json").read_text())["channels"][CHANNEL]
    for part in ("enamel", "dentin"):
        for quantity in ("sigma_s_reduced", "absorbed"):
            error, se = _off(report, truth, part, quantity)
            yield Row(boundary, f"{part} {quantity}", error, se, seconds)
    for name, errors, ses in (
        ("fitted images", report.fit_error, report.fit_error_se),
        ("held-out images", report.held_out_error, report.held_out_error_se),
    ):
        yield Row(boundary, name, errors[CHANNEL], ses[CHANNEL], seconds)


def _off(report: FitReport, truth: dict[str, dict[str, float]], part: str, quantity: str) -> tuple[float, float]:
    name = "alpha_reduced" if quantity == "absorbed" else quantity
    estimate, known = report.parameters[CHANNEL][f"{part}.{name}"], truth[part][name]
    found = 1 - estimate.value if quantity == "absorbed" else estimate.value
    true = 1 - known if quantity == "absorbed" else known
    return found / true - 1, (estimate.se or 0.0) / true


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--boundaries", default="rough,thin")
    parser.add_argument("--roughness", type=float, default=0.15)
    parser.add_argument("--cameras", type=int, default=3)
    parser.add_argument("--lights", type=int, default=5)
    parser.add_argument("--held-out", type=int, default=1, help="number of lights that are kept from the fit")
    parser.add_argument("--pixel-mm", type=float, default=1.0)
    parser.add_argument("--samples", type=int, default=8192)
    parser.add_argument("--max-samples", type=int, default=4096)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    prepare_device()
    found: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        capture = Path(folder) / "capture"
        write_phantom(
            capture, cameras=given.cameras, lights=given.lights, pixel_mm=given.pixel_mm, samples=given.samples,
            renderer="mitsuba", held_out=given.held_out, boundary="rough", roughness=given.roughness,
            multiple_scattering=False,
        )  # fmt: skip
        for boundary in given.boundaries.split(","):
            options = {"roughness": given.roughness, "max_samples": given.max_samples}
            for row in rows(capture, Path(folder) / boundary, boundary, **options):
                found.append(row)
                told = f"{row.quantity}: {row.error:+.1%} ± {row.se:.1%}, {row.seconds:.0f} s"
                print(f"{row.boundary}, {told}", flush=True)
    if given.json is not None:
        given.json.write_text(json.dumps([asdict(row) for row in found], indent=1))


if __name__ == "__main__":
    main()
