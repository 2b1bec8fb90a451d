"""The walk as a Mitsuba integrator, ``dentine``, for teeth in anybody's scene.

Call ``register_integrator()`` once a mono or RGB variant is set, then load a scene with ``optimize=False``. Media
values are one number, or one for each colour channel; lengths are scene units, millimetres where sigma is per
millimetre.

=============================  ====================================================================
property                       meaning
=============================  ====================================================================
enamel, dentin                 ids of the shapes around each, comma separated; dentin may be left out
enamel_sigma, enamel_alpha     extinction and albedo of enamel
enamel_beta, _g1, _g2          its phase function's lobes; 1, 0, 0 where left out
dentin_sigma, ...              the same of dentin
boundary                       ``thin`` (where left out) or ``matched``
ior                            of thin faces; 1.631 where left out
roughness                      GGX roughness of the mirror image in thin faces; no such image where left out
max_depth                      scatterings and reflections after which a path ends; 5000 where left out
=============================  ====================================================================

BSDFs of tooth surfaces and stock media are ignored. Cameras must stand outside the teeth. It renders images only, no
derivatives.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from services.core.errors import InputError, PlatformError
from services.transport.optics.parameters import MEDIUM_FIELDS, Medium
from services.transport.plugin.channel_media import ToothOptics
from services.transport.plugin.scene_checks import require_camera, require_lights, require_nested
from services.transport.plugin.scene_path import ScenePaths
from services.transport.plugin.scene_teeth import SceneTeeth, ToothShapes
from services.transport.scene.media import require_medium

PLUGIN = "dentine"
PARTS = ("enamel", "dentin")
PLUGIN_BOUNDARIES = ("thin", "matched")
"""Boundary models that paths through any scene have."""
MEDIUM_DEFAULTS = {"beta": 1.0, "g1": 0.0, "g2": 0.0}
STOCK_PROPERTIES = {"samples_per_pass", "block_size", "timeout"}
"""Properties that Mitsuba's own base class reads."""
ROUGHNESS = (1e-3, 1.0)
"""Smallest and largest GGX roughness that is accepted."""
NO_DERIVATIVES = f"Integrator {PLUGIN} gives images only; take derivatives from services.transport.engine.Engine."


@dataclass(frozen=True)
class ToothProperties:
    """An integrator's properties, checked."""

    shapes: ToothShapes
    optics: ToothOptics
    max_depth: int


def medium_properties(part: str, media: tuple[Medium, ...]) -> dict[str, Any]:
    """Properties of ``enamel`` or ``dentin`` for the media of one or three colour channels.

    Raises:
        InputError: a phase function is a table.
    """
    for medium in media:
        medium.require_lobes("The integrator")
    values = {field: [float(getattr(medium, field)) for medium in media] for field in MEDIUM_FIELDS}
    return {f"{part}_{field}": numbers if len(numbers) > 1 else numbers[0] for field, numbers in values.items()}


def read_properties(given: Mapping[str, Any], channels: int) -> ToothProperties:
    """Check an integrator's properties.

    Args:
        given: properties by name.
        channels: number of colour channels of the variant, 1 or 3.

    Raises:
        InputError: a property is unknown, missing or impossible; names property and value.
    """
    known = {
        *PARTS,
        *(f"{part}_{field}" for part in PARTS for field in MEDIUM_FIELDS),
        "boundary",
        "ior",
        "roughness",
        "max_depth",
        *STOCK_PROPERTIES,
    }
    for name in given:
        if name not in known:
            raise InputError(
                f"Integrator {PLUGIN} has no property '{name}'; it has {', '.join(sorted(known - STOCK_PROPERTIES))}."
            )
    ids = {part: tuple(filter(None, (name.strip() for name in str(given.get(part, "")).split(",")))) for part in PARTS}
    if not ids["enamel"]:
        raise InputError(f"Integrator {PLUGIN} needs 'enamel', the ids of the shapes around teeth; give at least one.")
    for name in given:
        if name.startswith("dentin_") and not ids["dentin"]:
            raise InputError(
                f"Property {name} is given but no dentin surface; name its shape as 'dentin', or leave the property"
                " out."
            )
    media = {part: _media(part, given, channels) if ids[part] else () for part in PARTS}
    boundary, ior, roughness, max_depth = (
        given.get(*pair) for pair in (("boundary", "thin"), ("ior", 1.631), ("roughness", None), ("max_depth", 5000))
    )
    if boundary not in PLUGIN_BOUNDARIES:
        raise InputError(f"boundary = {boundary} must be 'thin' or 'matched'; choose one of these.")
    if not (isinstance(ior, int | float) and math.isfinite(ior) and ior >= 1):
        raise InputError(f"ior = {ior} must be at least 1; give the index of refraction of enamel, 1.631.")
    if roughness is not None and not (isinstance(roughness, int | float) and ROUGHNESS[0] <= roughness <= ROUGHNESS[1]):
        raise InputError(
            f"roughness = {roughness} must lie in {ROUGHNESS[0]:g} to {ROUGHNESS[1]:g}; correct it, or leave it out for"
            " no mirror image."
        )
    if roughness is not None and boundary == "matched":
        raise InputError(
            "An index-matched surface has no mirror image; choose boundary 'thin', or leave out roughness."
        )
    if not isinstance(max_depth, int) or max_depth < 1:
        raise InputError(f"max_depth = {max_depth} must be a positive whole number; correct it.")
    optics = ToothOptics(media["enamel"], media["dentin"], boundary, float(ior), roughness)
    return ToothProperties(ToothShapes(ids["enamel"], ids["dentin"]), optics, max_depth)


def _media(part: str, given: Mapping[str, Any], channels: int) -> tuple[Medium, ...]:
    columns = []
    for field in MEDIUM_FIELDS:
        name = f"{part}_{field}"
        value = given.get(name, MEDIUM_DEFAULTS.get(field))
        if value is None:
            raise InputError(f"Integrator {PLUGIN} needs {name}; give one number, or one for each colour channel.")
        try:
            numbers = np.atleast_1d(np.array(value, dtype=np.float64)).reshape(-1)
        except (TypeError, ValueError) as problem:
            raise InputError(
                f"{name} = {value} is no number; give one number, or one for each colour channel."
            ) from problem
        if len(numbers) not in {1, channels}:
            raise InputError(
                f"{name} has {len(numbers)} values in a variant of {channels} channel; give one number, or set an RGB"
                " variant."
            )
        columns.append(np.broadcast_to(numbers, channels).tolist())
    media = tuple(Medium(*values) for values in zip(*columns, strict=True))
    for medium in media:
        require_medium(part, medium)
    return media


def register_integrator() -> None:
    """Make ``{"type": "dentine"}`` known to the current variant; this module's docstring lists its properties.

    Raises:
        PlatformError: no variant is set, or one that is neither mono nor RGB.
    """
    variant = mi.variant()
    if variant is None or variant.startswith("scalar") or not variant.endswith(("_mono", "_rgb")):
        raise PlatformError(
            f"Integrator {PLUGIN} needs a variant such as llvm_ad_mono or llvm_ad_rgb, not {variant}; set one first."
        )

    class Dentine(mi.SamplingIntegrator):  # type: ignore[misc]  # mitsuba has no types
        """Adapter between Mitsuba's render loop and ``ScenePaths``."""

        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.properties = read_properties({name: props[name] for name in props.keys()}, len(mi.Spectrum()))  # noqa: SIM118 - no mapping
            self._teeth: SceneTeeth | None = None

        def sample(
            self,
            scene: mi.Scene,
            sampler: mi.Sampler,
            ray: mi.RayDifferential3f,
            medium: Any = None,  # noqa: ARG002
            active: Any = True,
        ) -> Any:
            if self._teeth is None or not self._teeth.is_unchanged(scene):
                teeth = SceneTeeth(scene, self.properties.shapes)
                require_nested(scene, teeth)
                self._teeth = teeth
            require_lights(scene, self._teeth)
            require_camera(scene, self._teeth, ray)
            paths = ScenePaths(scene, self._teeth, self.properties.optics, self.properties.max_depth)
            radiance, valid = paths.radiance(sampler, ray, mi.Bool(active))
            return radiance, valid, []

        def render_forward(self, *_: Any, **__: Any) -> Any:
            raise InputError(NO_DERIVATIVES)

        def render_backward(self, *_: Any, **__: Any) -> Any:
            raise InputError(NO_DERIVATIVES)

        def to_string(self) -> str:
            return f"Dentine[{self.properties}]"

    mi.register_integrator(PLUGIN, Dentine)
