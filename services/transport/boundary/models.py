"""The boundary models by name."""

from __future__ import annotations

from typing import Any

from services.core.choices import chosen
from services.transport.boundary.matched import Matched
from services.transport.boundary.model import Boundary, FlatBoundary
from services.transport.boundary.rough import Rough
from services.transport.boundary.smooth import Smooth
from services.transport.boundary.thin import Thin

MESH_MODELS: dict[str, Any] = {"matched": Matched, "thin": Thin, "rough": Rough}
"""Models of the outer faces of teeth and of mouths."""
SLAB_MODELS: dict[str, Any] = {"matched": Matched, "thin": Thin, "smooth": Smooth}
"""Models of a slab's flat faces."""


def mesh_boundary(
    name: str,
    ior: float,
    *,
    refracts: bool = True,
    roughness: float = 0.15,
    gums_ior: float | None = None,
    compensated: bool = True,
) -> Boundary:
    """The boundary of a scene of meshes; without any contrast of indices every model is the matched one.

    Args:
        name: name of the model.
        ior: index of refraction of the teeth.
        refracts: whether there is any contrast of indices in the scene.
        roughness: GGX roughness of a rough surface.
        gums_ior: index of refraction of gums behind a rough surface; None for a scene without gums.
        compensated: whether a rough surface gives back light that meets several facets.

    Raises:
        SettingsError: there is no model of that name.
    """
    if name == Rough.name and refracts:
        return Rough(ior, roughness, gums_ior=gums_ior, compensated=compensated)
    return _model(MESH_MODELS, name, ior, refracts=refracts)  # type: ignore[no-any-return]


def slab_boundary(name: str, ior: float) -> FlatBoundary:
    """The boundary of a slab's flat faces, or of any faces that a path asks for their reflectance alone.

    Raises:
        SettingsError: there is no model of that name.
    """
    return _model(SLAB_MODELS, name, ior, refracts=ior != 1)  # type: ignore[no-any-return]


def _model(models: dict[str, Any], name: str, ior: float, *, refracts: bool) -> Any:
    model = chosen("Boundary", name, models)
    return Matched() if model is Matched or not refracts else model(ior)
