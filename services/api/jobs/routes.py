"""REST routes of jobs, their events and artifacts, the options, the OpenAPI description and liveness.

Annotations are evaluated here, because FastAPI reads them and they name local dependencies.
"""

import asyncio
import json
from collections.abc import AsyncIterator
from typing import Annotated, Any

from fastapi import APIRouter, Header, Query, Request, Response
from pydantic import Field, StringConstraints

from services.api.auth.departures import Use, require_departure, said_use
from services.api.auth.scopes import CurrentViewer, needs, require
from services.api.auth.tokens import Scope
from services.api.http.artifacts import ANSWERS, Artifact, artifact_response, list_artifacts, open_artifact
from services.api.http.bodies import BodyRoute, ValidatedBody
from services.api.http.json_responses import in_json
from services.api.http.problems import refusals
from services.api.http.thread_pools import ThreadPool
from services.api.jobs.event_stream import EVENT_ANSWERS, EventBroadcaster, EventStream, end_of
from services.api.jobs.jobs import Jobs, StageProgress
from services.api.jobs.records import Deletion, Job
from services.api.jobs.time_ranges import TimeRange
from services.api.tables.jobs import JobFilter
from services.api.tables.lifecycle import JobState
from services.core.geometry import Record
from services.core.job_kinds import foreign_options, job_kinds
from services.core.light.safety import FlashAcknowledgement
from services.core.owners import Viewer
from services.core.records import JobName, JobSpec, KindName
from services.pipeline.database import MAX_ID

ESTIMATE_TIMEOUT_S = 2.0
"""Longest time in s that the answer about a job waits for the disks of captures, which are read to predict how long
jobs take."""


MAX_STREAMED = 64
"""Largest number of jobs in one stream of events."""
_STREAM_POSITION = "a job's id, and after a colon the id of its last event that is known already"
StreamPosition = Annotated[str, StringConstraints(pattern=r"^[0-9a-zA-Z]{1,40}(:[0-9]{1,9})?$")]


class Submission(JobSpec):
    """A job's options and, besides, its label."""

    name: JobName | None = Field(default=None, description="label of the job, for people")

    def spec(self) -> JobSpec:
        """Return the options without the label."""
        return JobSpec.model_construct(
            self.model_fields_set - {"name"}, **{name: getattr(self, name) for name in JobSpec.model_fields}
        )


class Label(Record):
    """What a person calls a job."""

    name: JobName | None = Field(description="null takes the label away")


class JobPage(Record):
    """Some jobs, newest first."""

    jobs: list[Job]
    next_before: int | None = Field(description="give as 'before' to get the next page; null on the last")


class Retry(Record):
    """What a retry may bring."""

    flashes: FlashAcknowledgement | None = Field(
        default=None,
        description="acknowledgement of faster flashes, in place of the job's own; each attempt that lights needs one",
    )


class JobDetail(Job):
    """A job and how far each of its stages is."""

    stages: list[StageProgress]
    waits_for: str | None = Field(
        description="why a queued job does not start, or a running one does not go on or stop; null if nothing keeps it"
    )
    remaining: TimeRange | None = Field(
        description="how long until it ends, waiting in the queue included; null unless it waits or runs"
    )


class Health(Record):
    """What the server has checked."""

    status: str


def build_router(
    jobs: Jobs,
    broadcaster: EventBroadcaster,
    database_pool: ThreadPool,
    file_pool: ThreadPool,
    capture_pool: ThreadPool,
    cancel_pool: ThreadPool,
) -> APIRouter:
    """Build the routes.

    Args:
        broadcaster: follows the event table.
        database_pool: threads that query the database.
        file_pool: threads that read the files of jobs.
        capture_pool: threads that read captures, whose disks may hang.
        cancel_pool: threads that cancel jobs.
    """
    router = APIRouter(prefix="/v1", route_class=BodyRoute, responses=refusals(404, 409, 413, 422, 507))
    foreign = {kind: sorted(foreign_options(kind, frozenset(JobSpec.model_fields))) for kind in job_kinds()}
    schema = json.dumps({**JobSpec.model_json_schema(), "foreign_options": foreign})

    @in_json
    def detail(job: Job, remaining: TimeRange | None, viewer: Viewer) -> JobDetail:
        shown = job.redacted_for(viewer)
        fields = {name: getattr(shown, name) for name in Job.model_fields}
        return JobDetail(**fields, stages=jobs.progress(job), waits_for=jobs.waits_for(job), remaining=remaining)

    def find(job_id: str, viewer: Viewer) -> Job | Response:
        job = jobs.repository.get(job_id)
        return detail(job, None, viewer) if job.state.is_final else job

    async def estimate_remaining(job: Job) -> TimeRange | None:
        try:
            async with asyncio.timeout(ESTIMATE_TIMEOUT_S):
                return await capture_pool.run(jobs.time_range, job)
        except TimeoutError:
            return TimeRange(
                reason=(
                    f"The captures of this job and those before it could not be looked at within {ESTIMATE_TIMEOUT_S:g}"
                    " s; ask again."
                )
            )

    @router.post(
        "/jobs", status_code=201, responses={200: {"model": Job}}, tags=["jobs"], dependencies=[needs("submit")]
    )
    def submit(
        submission: ValidatedBody[Submission],
        viewer: CurrentViewer,
        request: Request,
        response: Response,
        idempotency_key: Annotated[str | None, Header(max_length=200)] = None,
    ) -> Job:
        """Submit a job. The same Idempotency-Key with the same options gives the same job, and status 200.

        A job with a rig needs scope operate-dome too, unless its dome is simulated.
        """
        if submission.rig is not None and not submission.rig.is_simulated:
            require(request.scope.get("caller"), Scope.OPERATE_DOME)
            if submission.rig.flashes is not None:
                request.scope["audited"].ids["flashes"] = str(submission.rig.flashes)
        creation = jobs.submit(submission.spec(), idempotency_key, request.state.request_id, submission.name, viewer)
        response.status_code = 201 if creation.is_new else 200
        response.headers["Location"] = f"/v1/jobs/{creation.job.id}"
        return creation.job

    @router.get("/jobs", tags=["jobs"], dependencies=[needs("read")])
    @database_pool.wrap_handler
    @in_json
    def page(
        viewer: CurrentViewer,
        limit: Annotated[int, Query(ge=1, le=500)] = 50,
        before: Annotated[int | None, Query(ge=0, le=MAX_ID)] = None,
        state: Annotated[tuple[JobState, ...], Query(description="give several to allow each")] = (),
        kind: KindName | None = None,
        created_after_s: Annotated[float | None, Query(allow_inf_nan=False, description="Unix time")] = None,
        created_before_s: Annotated[float | None, Query(allow_inf_nan=False, description="Unix time")] = None,
        capture: Annotated[
            str | None,
            Query(max_length=500, description="text in the path of the capture or of the rig's mouth, in any case"),
        ] = None,
    ) -> JobPage:
        """List jobs, newest first."""
        filters = JobFilter(
            states=state, kind=kind, created_after_s=created_after_s, created_before_s=created_before_s, source=capture
        )
        found = jobs.repository.page(limit + 1, before, only=filters.visible_to(viewer))
        return JobPage(
            jobs=[job.redacted_for(viewer) for job in found[:limit]],
            next_before=found[limit - 1].number if len(found) > limit else None,
        )

    @router.get("/jobs/{job_id}", response_model=JobDetail, tags=["jobs"], dependencies=[needs("read")])
    async def get(job_id: str, viewer: CurrentViewer) -> Response:
        """One job with its stages."""
        found = await database_pool.run(find, job_id, viewer)
        return (
            found
            if isinstance(found, Response)
            else await database_pool.run(detail, found, await estimate_remaining(found), viewer)
        )

    @router.patch("/jobs/{job_id}", tags=["jobs"], dependencies=[needs("submit")])
    def rename(job_id: str, label: ValidatedBody[Label]) -> Job:
        """Give a job another label, or none; nothing else of it can be changed."""
        return jobs.repository.rename(job_id, label.name)

    @router.post("/jobs/{job_id}/cancel", status_code=202, tags=["jobs"], dependencies=[needs("submit", darkens=True)])
    @cancel_pool.wrap_handler
    def cancel(job_id: str) -> Job:
        """Cancel a job. The lights go off first; what it has published is kept."""
        return jobs.cancel(job_id)

    @router.post("/jobs/{job_id}/retry", status_code=202, tags=["jobs"], dependencies=[needs("submit")])
    def retry(job_id: str, request: Request, retried: ValidatedBody[Retry] | None = None) -> Job:
        """Queue a failed or cancelled job again, or one that succeeded before its masks were changed; it resumes from
        what it had published.

        A job that has yet to capture needs scope operate-dome too, unless its dome is simulated. If it has flashed
        under an acknowledgement, it needs a newer one, in 'flashes'.
        """
        flashes = None if retried is None else retried.flashes
        if flashes is not None:
            request.scope["audited"].ids["flashes"] = str(flashes)
        if jobs.lights_again(job_id):
            require(request.scope.get("caller"), Scope.OPERATE_DOME)
        return jobs.retry(job_id, flashes)

    @router.delete("/jobs/{job_id}", tags=["jobs"], dependencies=[needs("submit")])
    def delete(job_id: str) -> Deletion:
        """Remove everything that is stored of a job that has ended; the answer is the receipt."""
        return jobs.delete(job_id)

    @router.get("/deletions/{job_id}", tags=["jobs"], dependencies=[needs("read")])
    @database_pool.wrap_handler
    @in_json
    def deletion(job_id: str) -> Deletion:
        """The receipt of a deleted job."""
        return jobs.repository.deletion(job_id)

    @router.get(
        "/jobs/{job_id}/events",
        response_class=Response,
        responses=EVENT_ANSWERS,
        tags=["jobs"],
        dependencies=[needs("read")],
    )
    async def events(job_id: str, last_event_id: Annotated[int | None, Header(ge=0, le=MAX_ID)] = None) -> Response:
        """The job's events, replayed after Last-Event-ID and then live; event 'end' carries the final state."""
        return await broadcaster.answer(job_id, last_event_id or 0)

    @router.get(
        "/events", response_class=Response, responses=EVENT_ANSWERS, tags=["jobs"], dependencies=[needs("read")]
    )
    async def events_of_several(
        viewer: CurrentViewer,
        job: Annotated[
            tuple[StreamPosition, ...], Query(min_length=1, max_length=MAX_STREAMED, description=_STREAM_POSITION)
        ],
    ) -> Response:
        """The events of several jobs in one stream, as a browser has few connections.

        Event 'end' names the job and its final state, null for an absent one.
        """
        positions = {job_id: int(after or 0) for job_id, _, after in (position.partition(":") for position in job)}
        visible = await database_pool.run(jobs.repository.visible_ids, positions, viewer)

        async def follow() -> AsyncIterator[bytes]:
            for job_id in sorted(set(positions) - visible):
                yield end_of(job_id, None)
            async for batch in broadcaster.follow_several({job_id: positions[job_id] for job_id in visible}):
                yield batch

        return EventStream(follow(), broadcaster.places)

    @router.get("/jobs/{job_id}/artifacts", tags=["artifacts"], dependencies=[needs("read")])
    @file_pool.wrap_handler
    @in_json
    def artifacts(job_id: str) -> list[Artifact]:
        """List the job's files."""
        return list_artifacts(jobs.present_folder(jobs.repository.get(job_id).id))

    @router.get(
        "/jobs/{job_id}/artifacts/{path:path}",
        response_class=Response,
        responses=ANSWERS,
        tags=["artifacts"],
        dependencies=[needs("read", audited=True)],
    )
    @file_pool.wrap_handler
    def artifact(job_id: str, path: str, request: Request, use: Annotated[Use, Query(alias="for")] = None) -> Response:
        """One file; takes Range and If-None-Match. A result is refused where the person's consent has ended or does not
        list its use.
        """
        folder = jobs.present_folder(jobs.repository.get(job_id).id)
        require_departure(folder, path, said_use(request, use))
        return artifact_response(request, open_artifact(folder, path))

    @router.get("/options", response_model=dict[str, Any], tags=["options"], dependencies=[needs("read")])
    async def options() -> Response:
        """JSON schema of a job's options with defaults, units and help; ``foreign_options`` are those that a kind does
        not have.
        """
        return Response(schema, media_type="application/json")

    @router.get("/openapi.json", include_in_schema=False, dependencies=[needs("read")])
    def description(request: Request) -> dict[str, Any]:
        """The OpenAPI description."""
        described: dict[str, Any] = request.app.openapi()
        return described

    @router.get("/health/live", tags=["health"])
    async def live() -> Health:
        """Whether the process answers."""
        return Health(status="live")

    return router
