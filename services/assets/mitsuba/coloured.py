"""Scenes of a tooth in linear sRGB and in spectra, for renderers that know no camera's channels.

They are the scene of one channel with other media, a white light and a film of three colours.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.assets.colour.media import ReducedMedium, upsampled
from services.assets.colour.tables import ColouredMedium
from services.assets.mitsuba.rgb import COLOUR_INTEGRATOR, Colour, colour_of, homogeneous
from services.assets.mitsuba.scene import SceneDict
from services.assets.mitsuba.scene_xml import Spectrum

FIRST_NM, LAST_NM = 360.0, 830.0
"""Wavelengths that Mitsuba samples. A table is 0 beyond its ends, so spectra go on constant to these."""


def srgb_scene(scene: SceneDict, media: Mapping[str, ColouredMedium], intensity: float) -> SceneDict:
    """The scene in linear sRGB, for a variant such as ``llvm_ad_rgb``.

    Args:
        scene: the scene of any channel, with media ``medium_<name>``.
        media: media by name.
        intensity: radiant intensity of the white light in each channel.
    """
    found = {f"medium_{name}": _medium(one.srgb, one.mean_cosine, colour_of) for name, one in media.items()}
    return _with(scene, found, {"type": "rgb", "value": Colour((intensity,) * 3)})


def spectral_scene(scene: SceneDict, media: Mapping[str, ColouredMedium], intensity: float) -> SceneDict:
    """The same in spectra under daylight D65, for a variant such as ``llvm_ad_spectral``; the spectra are upsampled."""
    found = {}
    for name, one in media.items():
        nm, spectrum = upsampled(one.srgb)
        wavelengths = (FIRST_NM, *nm.tolist(), LAST_NM)

        def table(values: NDArray[np.float64], wavelengths: tuple[float, ...] = wavelengths) -> Spectrum:
            return Spectrum(wavelengths, (float(values[0]), *values.tolist(), float(values[-1])))

        found[f"medium_{name}"] = _medium(spectrum, one.mean_cosine, table)
    return _with(scene, found, {"type": "d65", "scale": intensity})


def _medium(medium: ReducedMedium, mean_cosine: float, written: Callable[[NDArray[np.float64]], Any]) -> SceneDict:
    scattering = medium.sigma_s_reduced / (1 - mean_cosine)
    extinction = scattering + medium.sigma_a
    return homogeneous(extinction, scattering / extinction, {"type": "hg", "g": mean_cosine}, written)


def _with(scene: SceneDict, media: SceneDict, intensity: SceneDict) -> SceneDict:
    changed = scene | media | {"integrator": COLOUR_INTEGRATOR, "light": scene["light"] | {"intensity": intensity}}
    for key, node in scene.items():
        if isinstance(node, dict) and node.get("type") == "perspective":
            changed[key] = node | {"film": node["film"] | {"pixel_format": "rgb"}}
    return changed
