"""From the raw frames of a virtual laboratory to a measured tooth, by what a real laboratory's commands do; no truth is
read here.

LAB/calibration/    what ``dentine calibrate LAB/session --out LAB/calibration`` writes
LAB/mouth/          gets teeth, gums and registration.json, as by ``dentine register LAB/mouth``
LAB/job/            what ``dentine run JOB.toml --out LAB/job`` writes, with the options of ``job_of``
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from services.calibrate.registration.register import MAX_MISFIT_MM, register_folder
from services.calibrate.session.report import write_report
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
"""Options of a first look."""
PIXELS_MM = 0.5
"""Edge of the squares of pixels that are fitted: what a tooth's light spreads over anyway."""


def calibrated(root: Path, tell: Callable[[str], None]) -> None:
    """Calibrate the rig from the session's frames, unless that is done."""
    out = root / CALIBRATION
    if (out / CALIBRATION_FILE).is_file():
        return
    session = calibrate(root / SESSION, tell)
    out.mkdir(parents=True, exist_ok=True)
    # The record is written last: where it is, all is.
    write_report(session, out)
    write_session(session, out)
    for limit in session.judgement.broken:
        tell(f"{limit.what}: {limit.value:.3g} {limit.unit} is beyond its limit of {limit.limit:g}")


def registered(root: Path, pixel_mm: float, tell: Callable[[str], None]) -> Registration:
    """Find where the scan's teeth stand, unless that is done; outlines of coarse pixels may lie as far off as one of
    them.
    """
    folder = root / MOUTH
    if (folder / REGISTRATION).is_file():
        return read_record(folder / REGISTRATION, Registration)
    # Teeth without a record are those of an attempt that was ended.
    shutil.rmtree(folder / "teeth", ignore_errors=True)
    tell("registration: landmarks, outlines")
    return register_folder(folder, max_misfit_mm=max(MAX_MISFIT_MM, pixel_mm))


def job_of(capture: Path, pixel_mm: float, options: Mapping[str, Any]) -> JobSpec:
    """The job that measures the tooth.

    Args:
        capture: raw folder with its teeth.
        pixel_mm: edge of a photograph's pixel at the teeth.
        options: of the job, that are others than here.
    """
    told = {
        "capture": capture.resolve(),
        "fdi": FITTED,
        "boundary": "matched",
        "dentin": "fit",
        "channels": ("green",),
        "pixel_step": max(round(PIXELS_MM / pixel_mm), 1),
        "advise": False,
        # So small a rig's images leave the lights' distances open to a centimetre, which their light at the teeth
        # hardly shows.
        "accept_calibration": True,
    }
    return JobSpec.model_validate(told | dict(options))


def forget(root: Path) -> None:
    """Remove all that was made of other frames."""
    for name in (CALIBRATION, JOB, COMPARISON):
        shutil.rmtree(root / name, ignore_errors=True)
