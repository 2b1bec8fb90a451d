"""Colours of cameras: from a camera's radiance to XYZ, as a calibration's chart has found it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from services.core.calibration.cameras_and_lights import CameraColour
from services.core.errors import CaptureInputError

Floats = NDArray[np.float64]
CHANNELS = 3
"""Number of channels, red, green and blue, that a camera's colour is told from."""
ROOT_TERMS = 6
"""Number of terms of a root polynomial of degree 2."""


def root_terms(rgb: Floats) -> Floats:
    """Return the root-polynomial terms of degree 2 (..., 6) of channels (..., 3), which scale with the light as the
    channels do (Finlayson, Mackiewicz & Hurlbert 2015, table I).
    """
    r, g, b = np.moveaxis(np.maximum(rgb, 0), -1, 0)
    return np.stack([r, g, b, np.sqrt(r * g), np.sqrt(g * b), np.sqrt(r * b)], axis=-1)


def xyz_of(rgb: Floats, colour: CameraColour) -> Floats:
    """XYZ (..., 3) under D50 of a camera's channels (..., 3), both with 1 for a perfect diffuser in the same light."""
    if colour.root_polynomial is None:
        return np.asarray(np.asarray(rgb) @ np.array(colour.xyz_from_rgb).T)
    return np.asarray(root_terms(np.asarray(rgb)) @ np.array(colour.root_polynomial).T)


def colours_among(colours: Mapping[str, CameraColour] | None, names: Iterable[str]) -> dict[str, CameraColour] | None:
    """The colours of the cameras of some names; None where none of them has any."""
    return {name: colours[name] for name in names if name in colours} or None if colours else None


def require_colours(
    colours: Mapping[str, CameraColour] | None, cameras: tuple[str, ...], channels: int, origin: str
) -> None:
    """Refuse colours of cameras that are not there, of other than three channels, or of impossible numbers.

    Raises:
        CaptureInputError: the message names the camera and the remedy.
    """
    for name, colour in (colours or {}).items():
        where = f"{origin} has a colour of camera {name}"
        if name not in cameras:
            raise CaptureInputError(f"{where}, which is not among its cameras; remove it or correct the name.")
        if channels != CHANNELS:
            raise CaptureInputError(
                f"{where}, and its channels are {channels}; leave the colour out unless they are red, green and blue."
            )
        rows = colour.root_polynomial
        if rows is not None and (len(rows), {len(row) for row in rows}) != (CHANNELS, {ROOT_TERMS}):
            raise CaptureInputError(f"{where} whose root polynomial is not three rows of six numbers; calibrate again.")
        if np.linalg.matrix_rank(np.array(colour.xyz_from_rgb)) < CHANNELS:
            raise CaptureInputError(
                f"{where} whose matrix cannot be inverted; calibrate again with a chart of colours."
            )
