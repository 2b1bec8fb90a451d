"""Routes of masks by hand. Annotations are evaluated here, because FastAPI reads them."""

from typing import Annotated, Literal

from fastapi import APIRouter, Depends, Request, Response
from starlette.concurrency import run_in_threadpool

from services.api.auth.scopes import needs
from services.api.http.artifacts import ANSWERS, artifact_response
from services.api.http.problems import refusals
from services.api.jobs.jobs import Jobs
from services.api.jobs.records import Job
from services.api.masks.masks import MaskList, Masks

PNG = "image/png"
_BODY = {"requestBody": {"required": True, "content": {PNG: {"schema": {"type": "string", "format": "binary"}}}}}


def build_masks_router(jobs: Jobs, masks: Masks) -> APIRouter:
    """Build the routes over the given masks."""
    router = APIRouter(prefix="/v1/jobs/{job_id}/masks", tags=["masks"], responses=refusals(404, 409, 413, 422))

    def find_job(job_id: str) -> Job:
        return jobs.repository.get(job_id)

    Found = Annotated[Job, Depends(find_job)]

    @router.get("", dependencies=[needs("read")])
    def every(job: Found) -> MaskList:
        """List a job's masks by hand, and whether its preparation has taken them in."""
        return masks.list(job)

    @router.get(
        "/{camera}/{light}",
        response_class=Response,
        responses=ANSWERS | {200: {"content": {PNG: {}}}},
        dependencies=[needs("read", audited=True)],
    )
    def get(
        job: Found, camera: str, light: str, request: Request, which: Literal["hand", "prepared"] = "hand"
    ) -> Response:
        """A mask as PNG: by hand, as put, without metadata; prepared, the sum of the reasons why a pixel is out
        (MaskBit), 0 where the fit may look.
        """
        if which == "prepared":
            return Response(masks.prepared(job, camera, light), media_type=PNG)
        return artifact_response(request, masks.get(job, camera, light))

    @router.put("/{camera}/{light}", status_code=204, openapi_extra=_BODY, dependencies=[needs("submit")])
    async def put(job: Found, camera: str, light: str, request: Request) -> None:
        """Put a mask by hand, for one light or for 'all': a grey PNG of the camera's size, not 0 where the fit must not
        look. A retry takes it in.
        """
        await run_in_threadpool(masks.put, job, camera, light, await request.body())

    @router.delete("/{camera}/{light}", status_code=204, dependencies=[needs("submit")])
    def delete(job: Found, camera: str, light: str) -> None:
        """Take a mask by hand back."""
        masks.delete(job, camera, light)

    return router
