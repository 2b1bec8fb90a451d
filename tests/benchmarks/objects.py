"""Table of the accuracy of jobs of kind object: shapes of known optics with a matched or a rough surface, rendered by
stock Mitsuba and fitted with the lights' strength given. Each image is of a camera and a light of its own. Stock
Mitsuba loses light that meets several facets of a rough surface, so the fit does too.

python -m tests.benchmarks.objects --shapes sphere,cube --lights 1,3 --boundaries matched --json matched.json
python -m tests.benchmarks.objects --boundaries rough --samples 16384 --max-samples 16384 --json rough.json

A shape may also be the file of a closed surface. Rough surfaces are noisy in stock Mitsuba and take more paths.
Fits that the file holds already are not run again; another ``--samples`` or ``--max-samples`` needs another file.
``error`` and ``se`` are relative to the truth. A figure is reached when its error is below the limit, or below two
standard errors where these exceed the limit, so that the images do not allow it.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path

from services.core.records import Boundary, FolderCapture, JobSpec
from services.core.stage import LocalContext
from services.core.store import read_record, write_record
from services.fit.stage import run
from services.phantom.object import write_object_phantom
from services.preprocess.stage import run_object
from services.transport.platform import prepare_device

LIMITS = {"sigma_s_reduced": 0.03, "sigma_a": 0.05}
"""Largest relative error of reduced scattering and of absorption."""
SIGMAS = 2.0
ROUGHNESS = 0.15
"""GGX roughness of the rough surfaces."""


@dataclass(frozen=True)
class Row:
    """One quantity of one fit; ``seconds`` is the processor time of preparation and fit."""

    shape: str
    boundary: Boundary
    images: int
    quantity: str
    error: float
    se: float
    seconds: float

    @property
    def is_reached(self) -> bool:
        """Whether the error keeps its limit, or two standard errors where these are larger."""
        return abs(self.error) <= max(LIMITS[self.quantity], SIGMAS * self.se)


def rows(
    folder: Path,
    shape: str,
    boundary: Boundary,
    lights: tuple[int, ...],
    *,
    pixel_mm: float,
    samples: int,
    max_samples: int,
    known_counts: frozenset[int] = frozenset(),
) -> Iterator[Row]:
    """Render a shape in as many cameras and under as many lights as the largest number asks for, and fit an image of
    each of the first ones, but for the numbers of images whose fits are known.
    """
    if known_counts >= set(lights):
        return
    prepare_device()
    capture, most = folder / f"{shape}-{boundary}", max(lights)
    write_object_phantom(
        capture, shape=shape, cameras=most, lights=most, pixel_mm=pixel_mm, samples=samples, renderer="mitsuba",
        held_out=0, is_paired=True, boundary=boundary, roughness=ROUGHNESS, multiple_scattering=False,
    )  # fmt: skip
    whole = read_record(capture / "capture.json", FolderCapture)
    truth = json.loads((capture / "truth.json").read_text())["channels"]["green"]["body"]
    known = {"sigma_s_reduced": truth["sigma_s_reduced"], "sigma_a": (1 - truth["alpha"]) * truth["sigma"]}
    for count in (one for one in lights if one not in known_counts):
        cameras, own = whole.cameras[:count], whole.lights[:count]
        part = whole.model_copy(update={"cameras": cameras, "lights": own, "images": whole.images[:count]})
        write_record(capture / "capture.json", part)
        spec = JobSpec(
            kind="object", capture=capture, boundary=boundary, roughness=ROUGHNESS, multiple_scattering="off",
            instrument="off", held_out_lights=(), advise=False, max_samples_per_pixel=max_samples,
        )  # fmt: skip
        job, begun_s = LocalContext(folder / f"{shape}-{boundary}-{count}"), time.process_time()
        run_object(spec, job)
        table = run(spec, job).parameters["green"]
        for quantity, true in known.items():
            estimate = table[f"body.{quantity}"]
            error, se = estimate.value / true - 1, (estimate.se or 0.0) / true
            yield Row(shape, boundary, count, quantity, error, se, time.process_time() - begun_s)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shapes", default="sphere,cube")
    parser.add_argument("--boundaries", default="matched")
    parser.add_argument("--lights", default="1,3")
    parser.add_argument("--pixel-mm", type=float, default=0.8)
    parser.add_argument("--samples", type=int, default=2048)
    parser.add_argument("--max-samples", type=int, default=4096)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    found: list[Row] = []
    if given.json is not None and given.json.is_file():
        found = [Row(**row) for row in json.loads(given.json.read_text())]
    with tempfile.TemporaryDirectory() as folder:
        lights = tuple(int(one) for one in given.lights.split(","))
        for shape, boundary in product(given.shapes.split(","), given.boundaries.split(",")):
            counts = frozenset(row.images for row in found if (row.shape, row.boundary) == (shape, boundary))
            fits = rows(
                Path(folder), shape, boundary, lights, pixel_mm=given.pixel_mm, samples=given.samples,
                max_samples=given.max_samples, known_counts=counts,
            )  # fmt: skip
            for row in fits:
                found.append(row)
                told = f"{row.quantity}: {row.error:+.2%} ± {row.se:.2%}, {row.seconds:.0f} s"
                print(f"{row.shape}, {row.boundary}, {row.images} images, {told}", flush=True)
                # The second quantity of a fit completes it.
                if given.json is not None and row.quantity == tuple(LIMITS)[-1]:
                    given.json.write_text(json.dumps([asdict(one) for one in found], indent=1))


if __name__ == "__main__":
    main()
