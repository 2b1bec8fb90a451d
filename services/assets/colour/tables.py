"""The file ``colour.json`` of an asset: its media in linear sRGB, in ACEScg and as spectra."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.assets.colour.develop import CapturedColours, xyz_from_assumed
from services.assets.colour.media import ReducedMedium, acescg_from_srgb, matrix_between, upsampled
from services.assets.colour.spaces import ACESCG, LINEAR_SRGB
from services.transport.optics.parameters import Medium

Floats = NDArray[np.float64]
TOLD = {
    LINEAR_SRGB.name: "coefficients for a renderer of linear sRGB: the colour of a half space is transformed exactly,"
    " and images agree to second order in the difference of the channels; render.py develops them exactly",
    ACESCG.name: "the same for ACEScg",
    "spectral": "upsampled: smooth spectra that have these colours under D65; three channels do not tell a spectrum",
    "sigma_s_reduced": "reduced scattering; scattering is sigma_s_reduced / (1 - mean_cosine)",
    "mean_cosine": "of the phase function, the mean over the channels",
}


@dataclass(frozen=True)
class ColouredMedium:
    """One medium of an asset in colour."""

    srgb: ReducedMedium
    mean_cosine: float
    """Of the phase function, the mean over the channels."""


def coloured_media(
    media: Mapping[str, Mapping[str, Medium]], colours: CapturedColours, cameras: Sequence[str]
) -> dict[str, ColouredMedium]:
    """The media of an asset in linear sRGB by name; empty where a channel of the colours is absent.

    Args:
        media: by name and channel.
        colours: colours of the cameras; the mean of their matrices counts.
        cameras: names of the asset's cameras.
    """
    known = [colours.cameras[name] for name in cameras if name in colours.cameras]
    xyz = np.mean([one.xyz_from_rgb for one in known], axis=0) if known else xyz_from_assumed()
    matrix = matrix_between(np.asarray(xyz), LINEAR_SRGB)
    found = {}
    for name, by_channel in media.items():
        if set(colours.channels) <= by_channel.keys():
            own = [by_channel[channel] for channel in colours.channels]
            if all(medium.sigma > 0 and medium.table is None for medium in own):
                cosine = float(np.mean([medium.mean_cosine for medium in own]))
                found[name] = ColouredMedium(ReducedMedium.of(own).transformed(matrix), cosine)
    return found


def colour_tables(media: Mapping[str, ColouredMedium]) -> dict[str, Any]:
    """Content of ``colour.json``."""
    spectral: dict[str, Any] = {}
    for name, medium in media.items():
        nm, spectrum = upsampled(medium.srgb)
        spectral |= {"wavelength_nm": nm.tolist(), name: _table(spectrum, medium.mean_cosine)}
    return {
        "units": {"sigma_s_reduced": "1/mm", "sigma_a": "1/mm", "wavelength_nm": "nm"},
        "told": TOLD,
        LINEAR_SRGB.name: {name: _table(one.srgb, one.mean_cosine) for name, one in media.items()},
        ACESCG.name: {
            name: _table(one.srgb.transformed(acescg_from_srgb()), one.mean_cosine) for name, one in media.items()
        },
        "spectral": spectral,
    }


def _table(medium: ReducedMedium, mean_cosine: float) -> dict[str, Any]:
    return {
        "sigma_s_reduced": medium.sigma_s_reduced.tolist(),
        "sigma_a": medium.sigma_a.tolist(),
        "reflectance": medium.reflectance.tolist(),
        "mean_cosine": mean_cosine,
    }
