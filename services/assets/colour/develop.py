"""Development of linear photographs and renders: from a camera's channels to a colour space of renderers.

Radiance is divided, channel by channel, by that of a perfect diffuser that faces the light where the teeth are. So the
light's own colour drops out, as it does when a chart is photographed in that light, and white is (1, 1, 1).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.assets.colour.spaces import LINEAR_SRGB, SPACES, ColourSpace
from services.assets.content import RGB
from services.core.calibration.cameras_and_lights import CameraColour
from services.core.calibration.colours import xyz_of
from services.core.geometry import Light, Vector3

Floats = NDArray[np.float64]
ASSUMED = "assumed: its red, green and blue are taken for linear sRGB"
"""What an asset says of a camera whose colour no calibration has told."""


@dataclass(frozen=True)
class CapturedColours:
    """Colours of the cameras of a capture."""

    channels: tuple[str, ...] = RGB
    """Names of the channels in the order of the matrices' columns."""
    cameras: Mapping[str, CameraColour] = field(default_factory=dict)
    """Colour by name of the camera, where one is known."""


def diffuser_radiance(light: Light, at_mm: Vector3) -> Floats:
    """Radiance (C,) of a perfect diffuser that faces a light, at a point: intensity ÷ (π d²)."""
    squared = float(np.sum((np.array(light.position_mm) - np.array(at_mm)) ** 2))
    return np.array(light.intensity) / (np.pi * squared)


def developed(relative: NDArray[np.floating], colour: CameraColour | None, space: ColourSpace) -> Floats:
    """Linear colours (..., 3) of radiance (..., 3) that is relative to a perfect diffuser's.

    Args:
        relative: red, green and blue of the camera.
        colour: the camera's colour; None where there is none, and its channels are taken for linear sRGB.
        space: the colours' space.
    """
    return np.asarray(xyz_d50(relative, colour) @ space.rgb_from_xyz().T)


def xyz_d50(relative: NDArray[np.floating], colour: CameraColour | None) -> Floats:
    """XYZ (..., 3) under D50 of the same radiance, by the camera's root polynomial where it has one, else by its
    matrix.
    """
    values = np.asarray(relative, dtype=np.float64)
    return np.asarray(values @ xyz_from_assumed().T) if colour is None else xyz_of(values, colour)


def xyz_from_assumed() -> Floats:
    """Matrix (3, 3) to XYZ under D50 of channels that are taken for linear sRGB."""
    return np.asarray(np.linalg.inv(LINEAR_SRGB.rgb_from_xyz()))


def rig_colours(
    colours: CapturedColours, channels: Sequence[str], cameras: Sequence[str], at_mm: Vector3
) -> dict[str, Any] | None:
    """What an asset's ``rig.json`` says of colours, as JSON values; None where a channel of a colour is not there.

    Args:
        colours: of the capture.
        channels: names of the asset's channels.
        cameras: names of the asset's cameras.
        at_mm: where the diffuser is, the middle of the teeth.
    """
    if not set(colours.channels) <= set(channels):
        return None
    return {
        "channels": list(colours.channels),
        "white": "the radiance of a perfect diffuser that faces the light at diffuser_mm",
        "diffuser_mm": at_mm,
        "cameras": {name: _camera(colours.cameras.get(name)) for name in cameras},
        "from_xyz": {space.name: space.rgb_from_xyz().tolist() for space in SPACES},
    }


def _camera(colour: CameraColour | None) -> dict[str, Any]:
    if colour is None:
        return {"source": ASSUMED, "xyz_d50_from_rgb": xyz_from_assumed().tolist(), "root_polynomial": None}
    return {
        "source": "the calibration",
        "xyz_d50_from_rgb": colour.xyz_from_rgb,
        "root_polynomial": colour.root_polynomial,
    }
