"""The part of ``dentine lab-demo`` after the frames are made: the chain, then the comparisons."""

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
    report_step: Callable[[str], None],
    *,
    coarse: bool = False,
) -> dict[str, Any]:
    """Run the chain, then the comparisons, and return the summary of their results; finished steps are not repeated.

    Args:
        root: folder of a laboratory whose frames exist.
        pixel_mm: edge of a photograph's pixel at the teeth.
        compare: names of ``VARIANTS``.
        workers: number of processes of each job; None for the job's own number.
        report_step: called with a description of each step as it begins.
        coarse: use the options for a first, coarse result.
    """
    options = COARSE if coarse else {}
    calibrated(root, report_step)
    registered(root, pixel_mm, report_step)
    report_step("job: preparation and fit")
    _run(job_of(root / MOUTH, pixel_mm, options), root / JOB, workers)
    jobs = {}
    for name in compare:
        folder, known = root / COMPARISON / name.replace(" ", "-"), VARIANTS[name]
        if not (folder / MOUTH / DESCRIPTION).is_file():
            write_variant(root, folder / MOUTH, known)
        report_step(f"comparison: {name}")
        job_options = {**options, "instrument": "off"} if known.is_all else options
        _run(job_of(folder / MOUTH, pixel_mm, job_options), folder / JOB, workers)
        jobs[name] = folder / JOB
    return summary(root, jobs)


def _run(spec: JobSpec, out: Path, workers: int | None) -> None:
    with ProgressView() as view:
        run_job(spec, out, view, workers)
