"""Routes of calibrations. Annotations are evaluated here, because FastAPI reads them."""

from typing import Annotated

from fastapi import APIRouter, Response
from fastapi import Path as PathParameter

from services.api.auth.scopes import Asker, needs
from services.api.calibrations.calibrations import (
    NAME,
    CalibrationCreation,
    CalibrationDetail,
    Calibrations,
    NamedCalibration,
)
from services.api.calibrations.made import made_by
from services.api.captures.captures import Captures
from services.api.http.bodies import BodyRoute, Sent
from services.api.http.json_responses import JSON, in_json
from services.api.http.problems import refusals
from services.api.http.thread_pools import ThreadPool
from services.api.jobs.jobs import Jobs
from services.core.calibration.record import Calibration

Name = Annotated[str, PathParameter(pattern=f"^{NAME}$", description="1 to 60 letters, digits, '.', '_', '-'")]


def build_calibrations_router(
    calibrations: Calibrations, captures: Captures, jobs: Jobs, openers: ThreadPool
) -> APIRouter:
    """Build the routes of stored calibrations, of those in captures, and of those that jobs have made.

    Args:
        openers: threads that read the files of jobs.
    """
    router = APIRouter(prefix="/v1", route_class=BodyRoute, tags=["calibrations"], responses=refusals(404, 409, 422))

    def tell(creation: CalibrationCreation) -> Response:
        headers = {"Location": f"/v1/calibrations/{creation.detail.name}"}
        return Response(creation.detail.model_dump_json(), 201 if creation.is_new else 200, headers, JSON)

    @router.get("/calibrations", dependencies=[needs("read")])
    @in_json
    def every(asker: Asker) -> list[NamedCalibration]:
        """List calibrations, newest first."""
        return calibrations.list(asker)

    @router.get("/calibrations/{name}", dependencies=[needs("read")])
    @in_json
    def get(name: Name, asker: Asker) -> CalibrationDetail:
        """One calibration with its cameras and lights."""
        return calibrations.get(name, asker)

    @router.put(
        "/calibrations/{name}",
        status_code=201,
        response_model=CalibrationDetail,
        responses={200: {"model": CalibrationDetail}},
        dependencies=[needs("submit")],
    )
    def put(name: Name, calibration: Sent[Calibration], asker: Asker) -> Response:
        """Store a calibration under a new name: 201, or 200 where it is there already.

        A name never changes its content: 409.
        """
        return tell(calibrations.put(name, calibration, asker))

    @router.put(
        "/jobs/{job_id}/calibration/{name}",
        status_code=201,
        response_model=CalibrationDetail,
        responses={200: {"model": CalibrationDetail}},
        dependencies=[needs("submit")],
    )
    @openers.answering
    def keep(job_id: str, name: Name, asker: Asker) -> Response:
        """Store what a calibration job made under a new name: 201, or 200 where it is there already.

        The job may be deleted then.
        """
        return tell(calibrations.put(name, made_by(jobs, job_id), asker))

    @router.get("/captures/{capture}/calibration", dependencies=[needs("read")])
    @in_json
    def of_capture(capture: str) -> Calibration:
        """The calibration that a committed capture brings along."""
        return captures.calibration(capture)

    return router
