"""Routes of the dome by hand. Annotations are evaluated here, because FastAPI reads them."""

import anyio
from fastapi import APIRouter

from services.api.dome import AllOff, Dome, DomeState, LightRequest, PreflightResult
from services.api.guard import needs
from services.api.problems import refusals
from services.core.dome import DomeStatus
from services.core.records import RigSpec

SIDE_BY_SIDE = 8


def build_dome_router(dome: Dome) -> APIRouter:
    """Routes over the given dome."""
    router = APIRouter(prefix="/v1/dome", tags=["dome"], responses=refusals(404, 409, 422, 502))
    # Threads of its own: ALL OFF does not queue behind requests that wait for something.
    reserved = anyio.CapacityLimiter(SIDE_BY_SIDE)

    @router.get("", dependencies=[needs("operate-dome")])
    def state() -> DomeState:
        """What the dome's controller says, and which jobs capture."""
        return dome.state()

    @router.post("/off", dependencies=[needs("operate-dome")])
    async def off() -> AllOff:
        """ALL OFF: every light dark at once and every capture stopped. The dome refuses light until somebody starts anew."""
        return await anyio.to_thread.run_sync(dome.all_off, limiter=reserved)

    @router.put("/light", dependencies=[needs("operate-dome")])
    def light(wanted: LightRequest) -> DomeStatus:
        """Switch one light on, for alignment. It goes dark by itself after 'on_s'; repeat the request to keep it on."""
        return dome.light(wanted)

    @router.delete("/light", dependencies=[needs("operate-dome")])
    def dark() -> DomeStatus:
        """Switch off the light that was switched on by hand."""
        return dome.dark()

    @router.post("/preflight", dependencies=[needs("operate-dome")])
    def preflight(rig: RigSpec) -> PreflightResult:
        """Look at every light, the black level and clipping, with the dome of this server; takes seconds."""
        return dome.preflight(rig)

    return router
