"""The uncertainty of a calibration: names of the instrument's errors and their covariance, as a capture states them.

=============================  ===========================================================  ==================
name                           what it is                                                   unit
=============================  ===========================================================  ==================
gain.CHANNEL                   all photographs are brighter than stated                     relative
light_gain.LIGHT               one light is brighter; with .CHANNEL only in that channel    relative
flare.CAMERA.CHANNEL           a constant is added to the radiance of all valid pixels      brightest pixel = 1
teeth.AXIS, dome.AXIS          the scan, or all lights together, moved as one               rad or mm
camera.CAMERA.AXIS             a camera moved; also its fx, fy, cx, cy                      rad, mm, relative, px
light.LIGHT.x, .y, .z          one light moved                                              mm
=============================  ===========================================================  ==================

AXIS is rx, ry, rz (a rotation vector, rad) or tx, ty, tz (mm), in the world's axes; teeth turn about the mean of their
vertices, the dome about the mean of its lights. Moves of single cameras are read and checked, but no fit uses them. A
tooth's fit uses the moves of single lights, together with light_gain, by their effect on the light's irradiance at the
teeth. The brightest pixel of a camera is the greatest radiance among its valid pixels in that channel, over all its
photographs.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from services.core.errors import CaptureInputError
from services.core.geometry import Camera, Light, Record

MAX_ERRORS = 1000
"""Largest number of errors that one calibration may name; a dome of 155 lights with three cameras has some 650."""
MAX_ROTATION_SE_RAD = 0.2
"""Largest standard error of a rotation, rad. No pose is uncertain by 11 degrees, so a larger number is one in
degrees."""
SYMMETRY = 1e-9
"""Largest difference between a covariance and its transpose, as a fraction of the largest variance. Rounding the two
halves in different ways leaves such differences."""
TWIST = ("rx", "ry", "rz", "tx", "ty", "tz")
LENS = ("fx", "fy", "cx", "cy")


class CalibrationUncertainty(Record):
    """Covariance of a calibration's errors.

    Errors that it does not name take the fit's defaults, independent of these.
    """

    names: tuple[str, ...] = Field(max_length=MAX_ERRORS, fail_fast=True, description="such as gain.red")
    covariance: tuple[tuple[float, ...], ...] = Field(
        max_length=MAX_ERRORS, fail_fast=True, description="of the errors in the order of names, in their units"
    )

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The covariance, (K, K)."""
        return np.array(self.covariance, dtype=np.float64).reshape(len(self.names), len(self.names))

    @model_validator(mode="after")
    def _a_covariance(self) -> CalibrationUncertainty:
        count, sizes = len(self.names), {len(row) for row in self.covariance}
        if len(self.covariance) != count or sizes - {count}:
            rows = f"{len(self.covariance)} rows of {', '.join(map(str, sorted(sizes)))} numbers"
            raise ValueError(f"the covariance has {rows} for {count} names; give one row and one column a name")
        if len(set(self.names)) < count:
            twice = next(name for name in self.names if self.names.count(name) > 1)
            raise ValueError(f"{twice} is named twice; name every error once")
        matrix = self.matrix
        if count and np.abs(matrix - matrix.T).max() > SYMMETRY * np.abs(matrix).max():
            raise ValueError("the covariance is not symmetric; give both halves alike")
        if (flat := [name for name, own in zip(self.names, np.diag(matrix), strict=True) if own <= 0]) != []:
            raise ValueError(f"the variance of {flat[0]} is not positive; give a small one where it is well known")
        if count and np.linalg.eigvalsh(matrix / np.sqrt(np.outer(np.diag(matrix), np.diag(matrix)))).min() <= 0:
            raise ValueError("the covariance is not positive definite: errors cannot go together more than entirely")
        for name, own in zip(self.names, np.diag(matrix), strict=True):
            if name.rpartition(".")[2] in TWIST[:3] and own > MAX_ROTATION_SE_RAD**2:
                raise ValueError(f"{name} is unsure by {own**0.5:.3g} rad; rotations are in radians, not in degrees")
        return self


def error_names(channels: Sequence[str], cameras: Sequence[Camera], lights: Sequence[Light]) -> Iterator[str]:
    """Every error that a calibration of these channels, cameras and lights may name."""
    yield from (f"gain.{channel}" for channel in channels)
    yield from (f"{body}.{axis}" for body in ("teeth", "dome") for axis in TWIST)
    for light in lights:
        yield f"light_gain.{light.name}"
        yield from (f"light_gain.{light.name}.{channel}" for channel in channels)
        yield from (f"light.{light.name}.{axis}" for axis in "xyz")
    for camera in cameras:
        yield from (f"flare.{camera.name}.{channel}" for channel in channels)
        yield from (f"camera.{camera.name}.{axis}" for axis in TWIST + LENS)


def require_known_names(
    uncertainty: CalibrationUncertainty | None,
    channels: Sequence[str],
    cameras: Sequence[Camera],
    lights: Sequence[Light],
    origin: str,
) -> None:
    """Refuse an uncertainty that names the error of an unknown channel, camera or light.

    Raises:
        CaptureInputError: there is such a name; the message states the first one.
    """
    if uncertainty is None:
        return
    known = frozenset(error_names(channels, cameras, lights))
    if unknown := [name for name in uncertainty.names if name not in known]:
        raise CaptureInputError(
            f"{origin}: uncertainty names {unknown[0]}, which is no error of its channels, cameras and lights; "
            "correct the name, such as gain.red, light_gain.LIGHT or flare.CAMERA.red."
        )
