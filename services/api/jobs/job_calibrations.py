"""Reads the calibrations that jobs have made, to be stored under names."""

from __future__ import annotations

from services.api.jobs.jobs import Jobs
from services.api.tables.lifecycle import JobState
from services.client.errors import JobStateError
from services.core.calibration.record import CALIBRATION_FILE, Calibration
from services.core.results import AssetManifest
from services.core.store import open_stage, read_record

KIND = "calibration"


def calibration_of_job(jobs: Jobs, job_id: str) -> Calibration:
    """Return the calibration that a job has made.

    Raises:
        UnknownJobError: there is no such job. JobStateError: the job makes no calibration, or has made none yet.
            CorruptStoreError: the files of the job are not as they were published.
    """
    job = jobs.repository.get(job_id)
    if job.spec.kind != KIND:
        raise JobStateError(
            f"Job {job.id} is of kind {job.spec.kind} and makes no calibration; name one of kind {KIND}."
        )
    if job.state is not JobState.SUCCEEDED:
        raise JobStateError(f"Job {job.id} is {job.state} and has no calibration to keep; wait until it has succeeded.")
    folder, manifest = open_stage(jobs.folder(job.id), "asset", AssetManifest)
    if CALIBRATION_FILE not in manifest.files:
        raise JobStateError(f"Job {job.id} published no {CALIBRATION_FILE}; submit it again.")
    return read_record(folder / CALIBRATION_FILE, Calibration)
