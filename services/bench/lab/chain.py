"""Chain from the raw frames of a virtual laboratory to a measured tooth, with the functions behind a real laboratory's
commands. The truth is not read here.

LAB/calibration/    files that ``dentine calibrate LAB/session --out LAB/calibration`` writes
LAB/mouth/          gets teeth, gums and registration.json, as by ``dentine register LAB/mouth``
LAB/job/            files that ``dentine run JOB.toml --out LAB/job`` writes, with the options of ``job_of``
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from services.calibrate.registration.register import MAX_MISFIT_MM, register_folder
from services.calibrate.session.report_page import write_report
from services.calibrate.session.run import CALIBRATION as CALIBRATION_FILE
from services.calibrate.session.run import calibrate, write_session
from services.core.raw.registration import REGISTRATION, Registration
from services.core.records import JobSpec
from services.core.store import read_record
from services.phantom.lab.make import CALIBRATION, MOUTH, SESSION
from services.phantom.lab.mouth import FITTED

JOB, COMPARISON = "job", "comparison"
COARSE: Mapping[str, Any] = MappingProxyType(
    {
        "samples_per_pixel": 16,
        "max_samples_per_pixel": 64,
        "max_steps": 3,
        "search_candidates": 2000,
    }
)
"""Options of the job for a first, coarse result."""
PIXELS_MM = 0.5
"""Edge at the teeth of the squares of pixels whose means are fitted: light spreads in a tooth at least as far."""
MAX_SAMPLES = 512
"""Most paths per pixel and pass. With 1,024 the chain takes 22 minutes on two cores in place of 13, and its standard
errors are at most a quarter smaller."""


def calibrated(root: Path, report_step: Callable[[str], None]) -> None:
    """Calibrate the rig from the session's frames if it is not calibrated."""
    out = root / CALIBRATION
    if (out / CALIBRATION_FILE).is_file():
        return
    session = calibrate(root / SESSION, report_step)
    out.mkdir(parents=True, exist_ok=True)
    # The record is written last, so where it exists all files do.
    write_report(session, out)
    write_session(session, out)
    for limit in session.judgement.broken:
        report_step(f"{limit.what}: {limit.value:.3g} {limit.unit} is beyond its limit of {limit.limit:g}")


def registered(root: Path, pixel_mm: float, report_step: Callable[[str], None]) -> Registration:
    """Register the scan if it is not registered; its outlines may be off by up to one pixel where pixels are coarse.

    Args:
        root: folder of the laboratory.
        pixel_mm: edge of a photograph's pixel at the teeth.
        report_step: called with a description of the step as it begins.
    """
    folder = root / MOUTH
    if (folder / REGISTRATION).is_file():
        return read_record(folder / REGISTRATION, Registration)
    # Teeth without a record come from an attempt that did not finish.
    shutil.rmtree(folder / "teeth", ignore_errors=True)
    report_step("registration: landmarks, outlines")
    return register_folder(folder, max_misfit_mm=max(MAX_MISFIT_MM, pixel_mm))


def job_of(capture: Path, pixel_mm: float, options: Mapping[str, Any]) -> JobSpec:
    """Return the job that measures the tooth.

    Args:
        capture: raw folder with its teeth.
        pixel_mm: edge of a photograph's pixel at the teeth.
        options: options of the job that replace the ones here.
    """
    defaults = {
        "capture": capture.resolve(),
        "fdi": FITTED,
        "boundary": "matched",
        "dentin": "fit",
        "surroundings": "on",
        "channels": ("green",),
        "pixel_step": max(round(PIXELS_MM / pixel_mm), 1),
        "max_samples_per_pixel": MAX_SAMPLES,
        "advise": False,
        # The images of so small a rig determine the lights' distances only to a centimetre, which hardly changes their
        # light at the teeth.
        "accept_calibration": True,
    }
    return JobSpec.model_validate(defaults | dict(options))


def remove_results(root: Path) -> None:
    """Remove the calibration, the job and the comparisons, which were made from other frames."""
    for name in (CALIBRATION, JOB, COMPARISON):
        shutil.rmtree(root / name, ignore_errors=True)
