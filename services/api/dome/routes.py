"""Routes of the dome by hand. Annotations are evaluated here, because FastAPI reads them."""

from fastapi import APIRouter, Request

from services.api.auth.scopes import CurrentViewer, needs
from services.api.dome.dome import AllOff, Dome, DomeState, LightRequest, PreflightResult
from services.api.http.bodies import BodyRoute, ValidatedBody
from services.api.http.problems import refusals
from services.api.http.thread_pools import ThreadPool
from services.core.dome import DomeStatus
from services.core.records import RigSpec


def build_dome_router(dome: Dome, all_off_pool: ThreadPool, dome_pool: ThreadPool) -> APIRouter:
    """Build the routes over the given dome. ALL OFF runs in ``all_off_pool``, all else in ``dome_pool``."""
    router = APIRouter(prefix="/v1/dome", route_class=BodyRoute, tags=["dome"], responses=refusals(404, 409, 422, 502))

    @router.get("", dependencies=[needs("operate-dome")])
    @dome_pool.wrap_handler
    def state(viewer: CurrentViewer) -> DomeState:
        """What the dome's controller says, and which jobs capture."""
        return dome.state(viewer)

    @router.post("/off", dependencies=[needs("operate-dome", darkens=True)])
    @all_off_pool.wrap_handler
    def off(viewer: CurrentViewer) -> AllOff:
        """ALL OFF: every light dark at once and every capture stopped.

        The dome refuses light until somebody starts anew.
        """
        return dome.all_off(viewer)

    @router.put("/light", dependencies=[needs("operate-dome")])
    @dome_pool.wrap_handler
    def light(request: ValidatedBody[LightRequest], viewer: CurrentViewer) -> DomeStatus:
        """Switch one light on, for alignment. It goes dark by itself after 'on_s'; repeat the request to keep it on."""
        return dome.light(request, viewer)

    @router.delete("/light", dependencies=[needs("operate-dome", darkens=True)])
    @dome_pool.wrap_handler
    def dark() -> DomeStatus:
        """Switch off the light that was switched on by hand."""
        return dome.dark()

    @router.post("/preflight", dependencies=[needs("operate-dome")])
    @dome_pool.wrap_handler
    def preflight(rig: ValidatedBody[RigSpec], viewer: CurrentViewer, request: Request) -> PreflightResult:
        """Look at every light, the black level and clipping, with the dome of this server; takes a third of a second a
        light, less with 'flashes'.
        """
        if rig.flashes is not None:
            request.scope["audited"].ids["flashes"] = str(rig.flashes)
        return dome.preflight(rig, viewer)

    return router
