"""Routes of the dome by hand. Annotations are evaluated here, because FastAPI reads them."""

from fastapi import APIRouter

from services.api.auth.scopes import Asker, needs
from services.api.dome.dome import AllOff, Dome, DomeState, LightRequest, PreflightResult
from services.api.http.bodies import BodyRoute, Sent
from services.api.http.problems import refusals
from services.api.http.thread_pools import ThreadPool
from services.core.dome import DomeStatus
from services.core.records import RigSpec


def build_dome_router(dome: Dome, darkeners: ThreadPool, operators: ThreadPool) -> APIRouter:
    """Build the routes over the given dome. ALL OFF runs in ``darkeners``, all else in ``operators``."""
    router = APIRouter(prefix="/v1/dome", route_class=BodyRoute, tags=["dome"], responses=refusals(404, 409, 422, 502))

    @router.get("", dependencies=[needs("operate-dome")])
    @operators.answering
    def state(asker: Asker) -> DomeState:
        """What the dome's controller says, and which jobs capture."""
        return dome.state(asker)

    @router.post("/off", dependencies=[needs("operate-dome", darkens=True)])
    @darkeners.answering
    def off(asker: Asker) -> AllOff:
        """ALL OFF: every light dark at once and every capture stopped.

        The dome refuses light until somebody starts anew.
        """
        return dome.all_off(asker)

    @router.put("/light", dependencies=[needs("operate-dome")])
    @operators.answering
    def light(wanted: Sent[LightRequest], asker: Asker) -> DomeStatus:
        """Switch one light on, for alignment. It goes dark by itself after 'on_s'; repeat the request to keep it on."""
        return dome.light(wanted, asker)

    @router.delete("/light", dependencies=[needs("operate-dome", darkens=True)])
    @operators.answering
    def dark() -> DomeStatus:
        """Switch off the light that was switched on by hand."""
        return dome.dark()

    @router.post("/preflight", dependencies=[needs("operate-dome")])
    @operators.answering
    def preflight(rig: Sent[RigSpec], asker: Asker) -> PreflightResult:
        """Look at every light, the black level and clipping, with the dome of this server; takes seconds."""
        return dome.preflight(rig, asker)

    return router
