"""Routes of the log, the curve, the pictures and the files of a job, and of the presets.

Annotations are evaluated here, because FastAPI reads them.
"""

from typing import Annotated, Literal

from fastapi import APIRouter, Query, Request, Response
from fastapi import Path as PathParameter
from fastapi.responses import StreamingResponse

from services.api.auth.departures import Use, require_departure, said_use
from services.api.auth.scopes import needs
from services.api.http.artifacts import ANSWERS, artifact_response, list_artifacts, open_artifact
from services.api.http.json_responses import JSON, in_json
from services.api.http.problems import refusals
from services.api.http.thread_pools import ThreadPool
from services.api.http.zip_stream import stream_zip
from services.api.jobs.history import History, HistoryCache, LogPage, PreviewPage, read_log, read_previews
from services.api.jobs.jobs import Jobs
from services.api.jobs.parameter_table import parameter_table
from services.api.presets import Preset, find_preset, list_presets
from services.client.errors import UnknownJobError
from services.core.provenance.asset import PARAMETERS
from services.core.stage import StageName
from services.pipeline.database import MAX_ID
from services.pipeline.event_log import EventLog

After = Annotated[int, Query(ge=0, le=MAX_ID, description="id of the last one that is known already")]


def build_observe_router(jobs: Jobs, database_pool: ThreadPool, file_pool: ThreadPool) -> APIRouter:
    """Build the routes.

    Args:
        database_pool: threads that query the database.
        file_pool: threads that read the files of jobs.
    """
    router = APIRouter(prefix="/v1", responses=refusals(404, 422))
    history_cache = HistoryCache()

    def events_of(job_id: str) -> EventLog:
        return jobs.repository.events_of(jobs.repository.get(job_id).id)

    @router.get("/jobs/{job_id}/logs", tags=["jobs"], dependencies=[needs("read")])
    @database_pool.wrap_handler
    @in_json
    def logs(
        job_id: str,
        after: After = 0,
        limit: Annotated[int, Query(ge=1, le=1000)] = 200,
        stage: StageName | None = None,
        attempt: Annotated[int | None, Query(ge=1, le=MAX_ID)] = None,
    ) -> LogPage:
        """What the job's stages said, oldest first."""
        return read_log(events_of(job_id), after, limit, stage, attempt)

    @router.get("/jobs/{job_id}/history", response_model=History, tags=["jobs"], dependencies=[needs("read")])
    @database_pool.wrap_handler
    def history(
        job_id: str,
        points: Annotated[int, Query(ge=3, le=5000)] = 500,
        channel: Annotated[str | None, Query(max_length=100)] = None,
    ) -> Response:
        """Loss, errors and parameters of the fit per channel over steps, thinned to at most so many points."""
        return Response(history_cache.read(events_of(job_id), points, channel), media_type=JSON)

    @router.get("/jobs/{job_id}/previews", tags=["artifacts"], dependencies=[needs("read")])
    @database_pool.wrap_handler
    @in_json
    def previews(job_id: str, after: After = 0, limit: Annotated[int, Query(ge=1, le=1000)] = 200) -> PreviewPage:
        """Pictures that the fit has made so far, oldest first."""
        return read_previews(events_of(job_id), job_id, after, limit)

    @router.get(
        "/jobs/{job_id}/previews/{preview_id}/{picture}",
        response_class=Response,
        responses=ANSWERS,
        tags=["artifacts"],
        dependencies=[needs("read", audited=True)],
    )
    @file_pool.wrap_handler
    def preview(
        job_id: str,
        preview_id: Annotated[int, PathParameter(ge=1, le=MAX_ID)],
        picture: Literal["render", "photo", "residual"],
        request: Request,
    ) -> Response:
        """One picture; takes Range and If-None-Match."""
        events = events_of(job_id).read(preview_id - 1, 1, kind="preview")
        path = events[0].data.get(picture) if events and events[0].id == preview_id else None
        if not isinstance(path, str):
            raise UnknownJobError(
                f"The job has no {picture} of preview {preview_id}; list its previews to see their ids."
            )
        return artifact_response(request, open_artifact(jobs.present_folder(job_id), path))

    @router.get(
        "/jobs/{job_id}/artifacts.zip",
        response_class=Response,
        responses={200: {"content": {"application/zip": {}}}},
        tags=["artifacts"],
        dependencies=[needs("read", audited=True)],
    )
    def archive(job_id: str, request: Request, use: Annotated[Use, Query(alias="for")] = None) -> Response:
        """All artifacts as one zip file, made while it is sent. It is refused where the person's consent has ended or
        does not list its use.
        """
        job = jobs.repository.get(job_id)
        root = jobs.present_folder(job.id)
        require_departure(root, "", said_use(request, use))
        names = [artifact.path for artifact in list_artifacts(root)]
        headers = {"Content-Disposition": f'attachment; filename="dentine-{job.id}.zip"', "Cache-Control": "no-store"}
        return StreamingResponse(stream_zip(root, names), headers=headers, media_type="application/zip")

    @router.get(
        "/jobs/{job_id}/parameters.csv",
        response_class=Response,
        responses=refusals(409) | {200: {"content": {"text/csv": {}}}},
        tags=["artifacts"],
        dependencies=[needs("read", audited=True)],
    )
    @file_pool.wrap_handler
    def parameters(job_id: str, request: Request, use: Annotated[Use, Query(alias="for")] = None) -> Response:
        """What the job has measured, for a spreadsheet: a row per channel and parameter with value, standard error and
        unit. It is refused where the person's consent has ended or does not list its use.
        """
        job = jobs.repository.get(job_id)
        folder = jobs.present_folder(job.id)
        require_departure(folder, PARAMETERS, said_use(request, use))
        table = parameter_table(job.id, open_artifact(folder, PARAMETERS))
        headers = {"Content-Disposition": f'attachment; filename="dentine-{job.id}.csv"', "Cache-Control": "no-store"}
        return Response(table, headers=headers, media_type="text/csv")

    @router.get("/presets", tags=["options"], dependencies=[needs("read")])
    @database_pool.wrap_handler
    @in_json
    def presets() -> list[Preset]:
        """Named sets of options."""
        return list_presets()

    @router.get("/presets/{name}", tags=["options"], dependencies=[needs("read")])
    @database_pool.wrap_handler
    @in_json
    def preset(name: str) -> Preset:
        """One set of options, to merge into a job's own."""
        return find_preset(name)

    return router
