"""The whole of ``dentine lab-demo`` behind its frames: the chain, then the comparisons."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from services.bench.lab.chain import COARSE, COMPARISON, JOB, calibrated, job_of, registered
from services.bench.lab.comparison import summary
from services.bench.lab.known import VARIANTS, write_variant
from services.client.progress import ProgressView
from services.core.raw.folder import DESCRIPTION
from services.core.records import JobSpec
from services.phantom.lab.make import MOUTH
from services.pipeline.stages import run_job


def measured(
    root: Path,
    pixel_mm: float,
    compare: Sequence[str],
    workers: int | None,
    tell: Callable[[str], None],
    *,
    coarse: bool = False,
) -> dict[str, Any]:
    """Run the chain, then the comparisons, and say what came out; what is done already is not done again.

    Args:
        root: a laboratory whose frames are there.
        pixel_mm: edge of a photograph's pixel at the teeth.
        compare: names of ``VARIANTS``.
        workers: processes of each job; None for the job's own number.
        tell: is told each step as it begins.
        coarse: take the options of a first look.
    """
    options = COARSE if coarse else {}
    calibrated(root, tell)
    registered(root, pixel_mm, tell)
    tell("job: preparation and fit")
    _run(job_of(root / MOUTH, pixel_mm, options), root / JOB, workers)
    jobs = {}
    for name in compare:
        folder, known = root / COMPARISON / name.replace(" ", "-"), VARIANTS[name]
        if not (folder / MOUTH / DESCRIPTION).is_file():
            write_variant(root, folder / MOUTH, known)
        tell(f"comparison: {name}")
        told = {**options, "instrument": "off"} if known.is_all else options
        _run(job_of(folder / MOUTH, pixel_mm, told), folder / JOB, workers)
        jobs[name] = folder / JOB
    return summary(root, jobs)


def _run(spec: JobSpec, out: Path, workers: int | None) -> None:
    with ProgressView() as view:
        run_job(spec, out, view, workers)
