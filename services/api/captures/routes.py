"""Captures by upload, below ``/v1/captures``. Annotations are evaluated here, because FastAPI reads them."""

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from http import HTTPStatus
from typing import Annotated, Any

from fastapi import APIRouter, Header, Query, Request, Response
from pydantic import Field
from sqlalchemy.exc import SQLAlchemyError

from services.api.auth.scopes import CurrentViewer, needs
from services.api.captures.captures import Captures
from services.api.captures.tus_routes import build_tus_router
from services.api.http.awaited_threads import in_thread
from services.api.http.bodies import BodyRoute, ValidatedBody
from services.api.http.json_responses import JSON, in_json
from services.api.http.problems import MEDIA_TYPE, Problem, refusals
from services.client.capture_records import CaptureDetail, CapturePage, FileFault, UploadManifest
from services.client.errors import IncompleteCaptureError
from services.pipeline.database import MAX_ID

SWEEP_S = 600.0
"""Time in s between two searches for captures that have expired."""


class IncompleteCapture(Problem):
    """Everything that keeps a capture from being committed."""

    files: list[FileFault] = Field(description="every file that is missing, corrupt or refused")


def build_captures_router(captures: Captures) -> APIRouter:
    """Build the routes of captures and of the uploads of their files. While their lifespan is active, captures
    expire.
    """

    @asynccontextmanager
    async def sweeping(_app: Any) -> AsyncIterator[None]:
        async def sweep() -> None:
            while True:
                try:
                    await in_thread(captures.sweep)
                except (SQLAlchemyError, OSError):
                    logging.getLogger(__name__).exception(
                        "looking after captures failed; trying again in %g s", SWEEP_S
                    )
                await asyncio.sleep(SWEEP_S)

        task = asyncio.create_task(sweep())
        try:
            yield
        finally:
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task

    router = APIRouter(lifespan=sweeping)
    under = APIRouter(
        prefix="/v1/captures",
        route_class=BodyRoute,
        responses=refusals(404, 409, 410, 413, 422, 423, 507),
        tags=["captures"],
    )

    @under.post(
        "",
        status_code=201,
        response_model=CaptureDetail,
        responses={200: {"model": CaptureDetail}},
        dependencies=[needs("submit")],
    )
    def create(
        manifest: ValidatedBody[UploadManifest],
        viewer: CurrentViewer,
        idempotency_key: Annotated[str | None, Header(max_length=200)] = None,
    ) -> Response:
        """Announce a capture and learn which of its files are known already.

        The same manifest gives the same capture, and status 200.
        """
        creation = captures.create(manifest, idempotency_key, viewer)
        headers = {"Location": f"/v1/captures/{creation.capture.id}"}
        return Response(creation.capture.model_dump_json(), 201 if creation.is_new else 200, headers, JSON)

    @under.get("", dependencies=[needs("read")])
    @in_json
    def page(
        viewer: CurrentViewer,
        limit: Annotated[int, Query(ge=1, le=500)] = 50,
        before: Annotated[int | None, Query(ge=0, le=MAX_ID)] = None,
    ) -> CapturePage:
        """List captures, newest first."""
        return captures.page(limit, before, viewer)

    @under.get("/{capture}", dependencies=[needs("read")])
    @in_json
    def get(capture: str) -> CaptureDetail:
        """One capture, and how much of each file is here."""
        return captures.get(capture)

    @under.post(
        "/{capture}/commit",
        responses={409: {"model": IncompleteCapture, "content": {MEDIA_TYPE: {}}}},
        response_model=CaptureDetail,
        dependencies=[needs("submit")],
    )
    def commit(capture: str, request: Request) -> Response:
        """Check the capture and make it usable by jobs; lists every file that is missing, corrupt or refused.

        Repeating it changes nothing.
        """
        if faults := captures.commit(capture):
            detail = f"Capture {capture} cannot be committed: {faults[0].detail}" + (
                f" It is one of {len(faults)} such files." if len(faults) > 1 else ""
            )
            problem = IncompleteCapture.of(
                HTTPStatus.CONFLICT, IncompleteCaptureError.code, detail, request.scope["path"], files=faults
            )
            return Response(problem.model_dump_json(), problem.status, media_type=MEDIA_TYPE)
        return Response(captures.get(capture).model_dump_json(), media_type=JSON)

    @under.delete("/{capture}", status_code=204, dependencies=[needs("submit")])
    def delete(capture: str) -> None:
        """Delete a capture that no job uses, with every content that no other capture has."""
        captures.delete(capture)

    router.include_router(under)
    router.include_router(build_tus_router(captures.uploads))
    return router
