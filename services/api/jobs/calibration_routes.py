"""Routes of calibrations. Annotations are evaluated here, because FastAPI reads them."""

from typing import Annotated

from fastapi import APIRouter, Response
from fastapi import Path as PathParameter

from services.api.auth.scopes import CurrentViewer, needs
from services.api.calibrations.calibrations import (
    NAME,
    CalibrationCreation,
    CalibrationDetail,
    Calibrations,
    NamedCalibration,
)
from services.api.captures.captures import Captures
from services.api.http.bodies import BodyRoute, ValidatedBody
from services.api.http.json_responses import JSON, in_json
from services.api.http.problems import refusals
from services.api.http.thread_pools import ThreadPool
from services.api.jobs.job_calibrations import calibration_of_job
from services.api.jobs.jobs import Jobs
from services.core.calibration.record import Calibration

Name = Annotated[str, PathParameter(pattern=f"^{NAME}$", description="1 to 60 letters, digits, '.', '_', '-'")]


def build_calibrations_router(
    calibrations: Calibrations, captures: Captures, jobs: Jobs, file_pool: ThreadPool
) -> APIRouter:
    """Build the routes of stored calibrations, of those in captures, and of those that jobs have made.

    Args:
        file_pool: threads that read the files of jobs.
    """
    router = APIRouter(prefix="/v1", route_class=BodyRoute, tags=["calibrations"], responses=refusals(404, 409, 422))

    def respond(creation: CalibrationCreation) -> Response:
        headers = {"Location": f"/v1/calibrations/{creation.detail.name}"}
        return Response(creation.detail.model_dump_json(), 201 if creation.is_new else 200, headers, JSON)

    @router.get("/calibrations", dependencies=[needs("read")])
    @in_json
    def every(viewer: CurrentViewer) -> list[NamedCalibration]:
        """List calibrations, newest first."""
        return calibrations.list(viewer)

    @router.get("/calibrations/{name}", dependencies=[needs("read")])
    @in_json
    def get(name: Name, viewer: CurrentViewer) -> CalibrationDetail:
        """One calibration with its cameras and lights."""
        return calibrations.get(name, viewer)

    @router.put(
        "/calibrations/{name}",
        status_code=201,
        response_model=CalibrationDetail,
        responses={200: {"model": CalibrationDetail}},
        dependencies=[needs("submit")],
    )
    def put(name: Name, calibration: ValidatedBody[Calibration], viewer: CurrentViewer) -> Response:
        """Store a calibration under a new name: 201, or 200 where it is there already.

        A name never changes its content: 409.
        """
        return respond(calibrations.put(name, calibration, viewer))

    @router.put(
        "/jobs/{job_id}/calibration/{name}",
        status_code=201,
        response_model=CalibrationDetail,
        responses={200: {"model": CalibrationDetail}},
        dependencies=[needs("submit")],
    )
    @file_pool.wrap_handler
    def keep(job_id: str, name: Name, viewer: CurrentViewer) -> Response:
        """Store what a calibration job made under a new name: 201, or 200 where it is there already.

        The job may be deleted then.
        """
        return respond(calibrations.put(name, calibration_of_job(jobs, job_id), viewer))

    @router.get("/captures/{capture}/calibration", dependencies=[needs("read")])
    @in_json
    def of_capture(capture: str) -> Calibration:
        """The calibration that a committed capture brings along."""
        return captures.calibration(capture)

    return router
