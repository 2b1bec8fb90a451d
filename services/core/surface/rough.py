"""Options of a rough dielectric surface, and what a job with one cannot have."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, WithJsonSchema
from pydantic_core import PydanticCustomError

ROUGHNESS = (0.02, 1.0)
"""Least and largest GGX roughness: connections through a smoother face are hits of a needle, seldom and bright."""
MIN_ROUGH_IOR = 1.01
"""Least index of refraction of a rough face: below it, light is bent by less than facets of a thousandth would turn it,
and single precision no longer finds the facet that bends it to a light."""
DEFAULT_ROUGHNESS = 0.15
"""GGX roughness of a phantom or an asset that gives none: that of a wet and polished tooth, about."""
FIT: Literal["fit"] = "fit"
"""The roughness is measured by the highlights of the photographs."""


def _roughness(value: Any) -> Any:
    low, high = ROUGHNESS
    if value == FIT:
        return value
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise PydanticCustomError(
            "roughness",
            f'give "fit", or the GGX roughness of the surface, a number from {low:g} to {high:g}, such as 0.15',
        )
    return float(value)


Roughness = Annotated[
    float | Literal["fit"],
    BeforeValidator(_roughness),
    WithJsonSchema(
        {
            "anyOf": [
                {"type": "string", "const": FIT},
                {"type": "number", "minimum": ROUGHNESS[0], "maximum": ROUGHNESS[1]},
            ]
        }
    ),
    Field(
        description="of boundary = rough: GGX roughness of the surface, which the fit holds; fit measures it first by"
        " the highlights of the photographs"
    ),
]
"""Width of the distribution of facets' slopes, Walter's alpha, or ``fit``."""
MultipleScattering = Annotated[
    Literal["on", "off"],
    Field(
        description="of boundary = rough: give back light that meets several facets; off only to compare with renderers"
        " that lose it"
    ),
]
"""Whether a rough surface is compensated for light that meets several of its facets."""


def require_rough_job(kind: str, ior: float, roughness: float | Literal["fit"], *, stains: bool) -> None:
    """Refuse what a job with a rough surface cannot have.

    Raises:
        ValueError: names the option and the remedy.
    """
    if kind == "jaw" and roughness == FIT:
        raise ValueError(
            "the roughness of a jaw is not measured; give roughness = 0.15, or what a fit of one of its teeth measures,"
            " or choose boundary = thin"
        )
    if stains:
        raise ValueError("boundary = rough has no stains; leave out stains, or choose boundary = thin")
    if ior < MIN_ROUGH_IOR:
        raise ValueError(
            f"ior = {ior:g} is too close to that of air for boundary = rough, which needs at least {MIN_ROUGH_IOR:g};"
            " choose boundary = matched"
        )
