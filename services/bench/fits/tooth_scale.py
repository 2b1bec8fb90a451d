"""Benchmark of a single tooth at the size of a real capture, fitted on one and on two workers: three views under 54
lights with pixels of 0.064 mm, about 28,000 pixels per view.

The photographs are this engine's own, because no peer renders 162 of them within hours; they are kept in ``.cache``
below the working directory for the next run. Seconds are by the clock, because two workers share two cores, so the
machine must be idle. ``error`` is the held-out error. The results of both runs must agree to the last bit, with one
thread each.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from services.bench import Row
from services.bench.fits.tooth_capture import prepare
from services.core.errors import InputError
from services.core.records import JobSpec
from services.core.results import FitReport
from services.core.stage import LocalContext
from services.core.store import open_stage
from services.pipeline.dask_config import DASK_CONFIG

PIXEL_MM, CAMERAS, LIGHTS, SAMPLES = 0.064, 3, 54, 64
CACHE = Path(".cache")
QUICK_PIXEL_MM, QUICK_LIGHTS = 0.5, 8


class ScaleRow(Row):
    """Preparation and fit of one capture on so many workers."""

    workers: int
    fit_seconds: float
    """Time of the fit stage alone."""
    pixels_per_view: int
    images: int
    idle_cores: float
    """Number of idle cores by the machine's load before the run; fewer than ``workers`` invalidate the measurement."""
    identical: bool | None = None
    """Whether the result equals that of the first run to the last bit."""
    scaling: float | None = None
    """Fit time on one worker, divided by the fit time on all workers and by their number."""


def run(*, quick: bool, keep: Callable[[list[dict[str, Any]]], None]) -> list[dict[str, Any]]:
    """Return one row per number of workers.

    Args:
        quick: take the smaller capture.
        keep: called with all rows so far after every new one.
    """
    rows: list[ScaleRow] = []
    capture = _capture(quick)
    reports: list[FitReport] = []
    for workers in (1, 2):
        report, row = _measure(capture, workers)
        reports.append(report)
        if workers > 1:
            one = rows[0]
            same = report.parameters == reports[0].parameters
            row = row.model_copy(update={"identical": same, "scaling": one.fit_seconds / (workers * row.fit_seconds)})
        rows.append(row)
        keep([one.model_dump() for one in rows])
    return [row.model_dump() for row in rows]


def _capture(quick: bool) -> Path:
    from services.phantom.tooth import write_phantom

    pixel_mm, lights = (QUICK_PIXEL_MM, QUICK_LIGHTS) if quick else (PIXEL_MM, LIGHTS)
    folder = CACHE / f"tooth-scale-{pixel_mm:g}-{lights}"
    if not (folder / "capture.json").is_file():
        write_phantom(folder, pixel_mm=pixel_mm, cameras=CAMERAS, lights=lights, samples=SAMPLES, subject=1)
    return folder


def _measure(capture: Path, workers: int) -> tuple[FitReport, ScaleRow]:
    import dask
    from distributed import Client, LocalCluster

    spec = JobSpec.model_validate({"capture": capture, "boundary": "matched", "dentin": "known", "workers": workers})
    idle = (os.cpu_count() or 1) - os.getloadavg()[0]
    with (
        tempfile.TemporaryDirectory() as name,
        dask.config.set({**DASK_CONFIG, "distributed.worker.daemon": False}),
        LocalCluster(
            n_workers=workers, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0"
        ) as cluster,
        Client(cluster) as client,
    ):
        began = time.perf_counter()
        client.submit(_stages, spec, Path(name)).result()
        seconds = time.perf_counter() - began
        report = open_stage(Path(name), "fit", FitReport)[1]
    if not report.held_out_error:
        raise InputError("The scale case lost its held-out lights; remove its folder from .cache and run it again.")
    pixels, images = _size(capture)
    row = ScaleRow(
        benchmark="tooth-scale", peer=f"dentine-{workers}-workers", seconds=seconds,
        error=report.held_out_error["green"], workers=workers, fit_seconds=report.seconds, pixels_per_view=pixels,
        images=images, idle_cores=idle,
    )  # fmt: skip
    return report, row


def _stages(spec: JobSpec, root: Path) -> None:
    # This runs on a worker; from there the fit distributes its passes to all workers.
    from services.fit.stage import run as fit

    prepare(root, spec)
    fit(spec, LocalContext(root))


def _size(capture: Path) -> tuple[int, int]:
    # Return the number of lit pixels of the first image, and the number of images.
    import numpy as np

    from services.core.records import FolderCapture
    from services.core.store import read_record

    images = read_record(capture / "capture.json", FolderCapture).images
    return int((np.load(capture / images[0].file) > 0).sum()), len(images)
