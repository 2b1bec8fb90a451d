"""The public interface of dentine: the names that a script needs, each loaded when it is first used.

>>> import dentine
>>> with dentine.Client("http://127.0.0.1:8000") as client:
...     job = client.submit(spec)

=====================  =============================================================================
``Client``             client of a server: submit, watch, upload, download
``AsyncClient``        the same for asyncio
``JobSpec``            the options of a job
``run``                runs a job on this machine, without a server
``simulate_slab``      reflectance and transmittance of a slab, with their derivatives
``load_asset``         loads the asset that a job has exported, from the job's folder
``register_mitsuba``   makes ``dentine`` an integrator of this process's Mitsuba
=====================  =============================================================================

``Client`` needs neither database nor server, Dask nor renderer. ``services`` is the implementation and may change.
"""

import importlib
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from services.client.client import AsyncClient as AsyncClient
    from services.client.client import Client as Client
    from services.core.provenance.asset import load_asset as load_asset
    from services.core.records import JobSpec as JobSpec
    from services.pipeline.stages import run_job as run
    from services.slab.simulate import simulate_slab as simulate_slab
    from services.transport.plugin.integrator import register_integrator as register_mitsuba

_PLACES = MappingProxyType(
    {
        "AsyncClient": "services.client.client:AsyncClient",
        "Client": "services.client.client:Client",
        "JobSpec": "services.core.records:JobSpec",
        "load_asset": "services.core.provenance.asset:load_asset",
        "register_mitsuba": "services.transport.plugin.integrator:register_integrator",
        "run": "services.pipeline.stages:run_job",
        "simulate_slab": "services.slab.simulate:simulate_slab",
    }
)
__all__ = ["AsyncClient", "Client", "JobSpec", "load_asset", "register_mitsuba", "run", "simulate_slab"]


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module 'dentine' has no attribute '{name}'; it has {', '.join(_PLACES)}")
    module, _, attribute = _PLACES[name].partition(":")
    return getattr(importlib.import_module(module), attribute)


def __dir__() -> list[str]:
    return sorted(_PLACES)
