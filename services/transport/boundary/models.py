"""The boundary models by name."""

from __future__ import annotations

from typing import Any

from services.core.choices import chosen
from services.transport.boundary.matched import Matched
from services.transport.boundary.model import Boundary
from services.transport.boundary.smooth import Smooth
from services.transport.boundary.thin import Thin

MESH_MODELS: dict[str, Any] = {"matched": Matched, "thin": Thin}
"""Models of the outer faces of teeth and of mouths."""
SLAB_MODELS: dict[str, Any] = {**MESH_MODELS, "smooth": Smooth}
"""Models of a slab's flat faces."""


def mesh_boundary(name: str, ior: float, *, refracts: bool = True) -> Boundary:
    """The boundary of a scene of meshes; without any contrast of indices every model is the matched one.

    Raises:
        SettingsError: there is no model of that name.
    """
    return _model(MESH_MODELS, name, ior, refracts=refracts)


def slab_boundary(name: str, ior: float) -> Boundary:
    """The boundary of a slab's flat faces.

    Raises:
        SettingsError: there is no model of that name.
    """
    return _model(SLAB_MODELS, name, ior, refracts=ior != 1)


def _model(models: dict[str, Any], name: str, ior: float, *, refracts: bool) -> Boundary:
    model = chosen("Boundary", name, models)
    found: Boundary = Matched() if model is Matched or not refracts else model(ior)
    return found
