"""Route of the states of workers. Annotations are evaluated here, because FastAPI reads them."""

from fastapi import APIRouter

from services.api.auth.scopes import CurrentViewer, needs
from services.api.health.worker_states import WorkerList, list_workers
from services.api.http.json_responses import in_json
from services.api.http.problems import refusals
from services.api.jobs.repository import Repository
from services.pipeline.workers import Workers


def build_workers_router(workers: Workers, repository: Repository) -> APIRouter:
    """Build the route over the given workers."""
    router = APIRouter(prefix="/v1", tags=["workers"], responses=refusals())

    @router.get("/workers", dependencies=[needs("read")])
    @in_json
    def every(viewer: CurrentViewer) -> WorkerList:
        """The workers, what each does of the caller's jobs, and how many jobs they got done; 503 where their scheduler
        does not answer.
        """
        return list_workers(workers, repository, viewer)

    return router
