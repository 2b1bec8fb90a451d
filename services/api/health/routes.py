"""Routes of readiness and metrics. Annotations are evaluated here, because FastAPI reads them."""

from http import HTTPStatus

from fastapi import APIRouter, Request, Response
from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, generate_latest
from pydantic import Field

from services.api.auth.scopes import needs
from services.api.health.readiness import Check, Readiness
from services.api.http.problems import MEDIA_TYPE, Problem, refusals
from services.core.geometry import Record


class Ready(Record):
    """Everything that a job needs is there."""

    status: str
    checks: tuple[Check, ...]


class NotReady(Problem):
    """Something is missing."""

    checks: tuple[Check, ...] = Field(description="the same as when the server is ready")


def build_health_router(readiness: Readiness, registry: CollectorRegistry) -> APIRouter:
    """Build the routes over the given checks and metrics."""
    router = APIRouter(prefix="/v1", tags=["health"], responses=refusals())

    @router.get(
        "/health/ready",
        response_model=Ready,
        responses={503: {"model": NotReady, "content": {MEDIA_TYPE: {}}}},
        dependencies=[needs("read")],
    )
    def ready(request: Request) -> Response:
        """Whether a submitted job would run: database, scheduler, workers, store and disk are each tried."""
        checks = readiness.checks()
        if bad := [check for check in checks if not check.ok]:
            problem = Problem.of(
                HTTPStatus.SERVICE_UNAVAILABLE,
                "not-ready",
                " ".join(check.sentence for check in bad),
                request.scope["path"],
            )
            return Response(
                NotReady(**problem.model_dump(), checks=checks).model_dump_json(), problem.status, media_type=MEDIA_TYPE
            )
        return Response(Ready(status="ready", checks=checks).model_dump_json(), media_type="application/json")

    @router.get(
        "/metrics",
        response_class=Response,
        responses={200: {"content": {"text/plain": {}}}},
        dependencies=[needs("metrics")],
    )
    def metrics() -> Response:
        """Metrics for Prometheus, in its text format."""
        return Response(generate_latest(registry), media_type=CONTENT_TYPE_LATEST)

    return router
