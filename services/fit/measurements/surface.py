"""The surface of the tooth or object, which is known before the fit begins and is held by it."""

from __future__ import annotations

from services.core.records import JobSpec
from services.core.results import Estimate, RoughSurface


def held_surface(spec: JobSpec) -> RoughSurface | None:
    """The rough surface that a fit holds; None for the other boundary models.

    A roughness that the job gives is taken as exact: pixels off the highlights hardly tell it from absorption.
    """
    if spec.boundary != "rough":
        return None
    return RoughSurface(
        roughness=Estimate(value=spec.roughness, se=None, unit="1", determined=False),
        ior=spec.ior,
        multiple_scattering=spec.multiple_scattering == "on",
    )
