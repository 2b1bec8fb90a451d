"""One scene in red, green and blue, made of the three channels' scenes.

Mitsuba's phase functions hold one number for all colours, so the scene is exact where the channels' phase functions are
equal. Elsewhere it holds similar media: every medium keeps its absorption and its reduced scattering in each channel,
and takes one phase function for all of them, the Henyey-Greenstein function of the channels' mean cosine. Images of
thick media then agree, as their light has scattered many times; those of thin layers differ.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.assets.mitsuba.scene import MAX_DEPTH, ROULETTE_DEPTH, SceneDict
from services.core.errors import InputError

Floats = NDArray[np.float64]

COLOUR_INTEGRATOR: SceneDict = {"type": "volpathmis", "max_depth": MAX_DEPTH, "rr_depth": ROULETTE_DEPTH}
"""Integrator that samples free paths of all channels together. ``volpath`` samples one channel's and weighs it for the
others, and where extinctions differ twofold the weights have no finite variance: red came out 4 % dark after 16,384
paths a pixel."""


@dataclass(frozen=True)
class Colour:
    """One value for each of red, green and blue, as ``scene_xml`` writes it."""

    values: tuple[float, float, float]


@dataclass(frozen=True)
class ColourScene:
    """A scene in colour."""

    scene: SceneDict
    is_exact: bool
    """Whether the phase functions of all media are the channels' own."""


def colour_scene(scenes: Sequence[SceneDict]) -> ColourScene:
    """Join the scenes of red, green and blue, which differ by numbers alone.

    Raises:
        InputError: the scenes differ by more, such as by textures.
    """
    exact = [True]
    scene = _joined(list(scenes), exact) | {"integrator": COLOUR_INTEGRATOR}
    return ColourScene(scene, exact[0])


def _joined(nodes: list[Any], exact: list[bool]) -> Any:
    first = nodes[0]
    if isinstance(first, np.ndarray):
        return first
    if not isinstance(first, dict) or any(node.keys() != first.keys() for node in nodes):
        if any(node != first for node in nodes):
            raise InputError(f"Scenes whose channels differ by {first!r} cannot be one scene in colour; use render.py.")
        return first
    kind = first.get("type")
    if kind == "homogeneous":
        return _medium(nodes, exact)
    if kind == "uniform":
        return {"type": "rgb", "value": colour_of([node["value"] for node in nodes])}
    own: SceneDict = {"pixel_format": "rgb"} if kind == "hdrfilm" else {}
    if kind == "point":
        own["intensity"] = colour_of([_number(node["intensity"]) for node in nodes])
    return {key: own.get(key) or _joined([node[key] for node in nodes], exact) for key in first}


def _number(value: Any) -> float:
    return float(getattr(value, "default", value))


def colour_of(values: Sequence[float] | Floats) -> Colour:
    """The colour of three values."""
    red, green, blue = (float(value) for value in values)
    return Colour((red, green, blue))


def homogeneous(extinction: Floats, albedo: Floats, phase: SceneDict, written: Callable[[Floats], Any]) -> SceneDict:
    """A medium with a value for each colour or wavelength.

    Args:
        extinction: extinction (N,), 1/mm.
        albedo: single-scattering albedo (N,).
        phase: the phase function.
        written: makes of N values what ``scene_xml`` writes.
    """
    # Mitsuba takes colours of media from 0 to 1, so the largest extinction stands apart.
    largest = float(extinction.max())
    return {
        "type": "homogeneous",
        "scale": largest,
        "sigma_t": written(extinction / largest if largest > 0 else extinction),
        "albedo": written(albedo),
        "phase": phase,
    }


def _medium(media: list[SceneDict], exact: list[bool]) -> SceneDict:
    extinction = np.array([medium["sigma_t"] for medium in media])
    albedo = np.array([medium["albedo"] for medium in media])
    phase = media[0]["phase"]
    if any(medium["phase"] != phase for medium in media):
        # Similar media: sigma_s (1 - g) and sigma_a of each channel, and the mean of the channels' cosines.
        exact[0] = False
        cosines = np.array([_mean_cosine(medium["phase"]) for medium in media])
        scattering = albedo * extinction * (1 - cosines) / (1 - cosines.mean())
        absorption = (1 - albedo) * extinction
        extinction = scattering + absorption
        albedo = np.divide(scattering, extinction, out=np.zeros(3), where=extinction > 0)
        phase = {"type": "hg", "g": float(cosines.mean())}
    return homogeneous(extinction, albedo, phase, colour_of)


def _mean_cosine(phase: SceneDict) -> float:
    if phase["type"] == "hg":
        return float(phase["g"])
    weight = float(phase["weight"])
    return (1 - weight) * _mean_cosine(phase["first"]) + weight * _mean_cosine(phase["second"])
