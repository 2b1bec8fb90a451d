"""Cameras and lights with the properties that a calibration measures besides their positions.

The radiance of a pixel follows from its counts, where q is the squared distance of the pixel from the principal point,
in units of half the image's diagonal and in the image as it was taken:

    radiance = (counts - black_counts) / (exposure_s * gain * (1 + a q + b q² + c q³)) * radiance_per_count

Photographs determine the lights' intensities and the cameras' radiance_per_count only up to a common factor, so the
intensities are scaled to a mean of 1 in every channel.
"""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import Field, model_validator

from services.core.geometry import Camera, Light, Matrix3, Record, Vector3

DISTORTION_LENGTHS = frozenset({4, 5, 8, 12, 14})
"""Numbers of coefficients of OpenCV's lens models."""
Positive = Annotated[float, Field(gt=0)]


def is_absent(value: object) -> bool:
    """Whether a field is None and is therefore not stored.

    So a record that an earlier version wrote keeps its stored form, and with it the digest that names it.
    """
    return value is None


class CalibratedCamera(Camera):
    """A camera with its lens and the way from its counts to radiance."""

    distortion: tuple[float, ...] | None = Field(
        default=None, exclude_if=is_absent, description="of the lens, in OpenCV's order; null for a pinhole"
    )
    vignetting: Vector3 | None = Field(
        default=None, exclude_if=is_absent, description="a, b, c of the fall of light; null where there is none"
    )
    radiance_per_count: tuple[Positive, ...] | None = Field(
        default=None, exclude_if=is_absent, description="at 1 s and gain 1, one number a channel"
    )
    black_counts: float | None = Field(default=None, exclude_if=is_absent, ge=0, description="counts without light")
    read_noise_counts: float | None = Field(
        default=None, exclude_if=is_absent, ge=0, description="standard deviation without light, before rounding"
    )
    counts_per_electron: Positive | None = Field(default=None, exclude_if=is_absent, description="at gain 1")
    crosstalk: tuple[tuple[float, ...], ...] | None = Field(
        default=None,
        exclude_if=is_absent,
        description="what each channel (row) reads of each channel's own light (column); its diagonal is 1",
    )

    @model_validator(mode="after")
    def _possible_lens(self) -> CalibratedCamera:
        if self.distortion is not None and len(self.distortion) not in DISTORTION_LENGTHS:
            lengths = ", ".join(map(str, sorted(DISTORTION_LENGTHS)))
            raise ValueError(f"distortion has {len(self.distortion)} numbers, and OpenCV's models have {lengths}")
        if self.vignetting is not None and min(self.vignetting_factor(k / 100) for k in range(201)) <= 0:
            raise ValueError("vignetting leaves no light at some distance from the principal point; fit it again")
        if self.crosstalk is not None and {len(row) for row in self.crosstalk} != {len(self.crosstalk)}:
            raise ValueError("crosstalk has not as many columns as rows; give one row and one column a channel")
        return self

    def vignetting_factor(self, q: float) -> float:
        """Relative brightness of a uniform source at squared relative distance q from the principal point.

        It is 1 at q = 0.
        """
        a, b, c = self.vignetting or (0.0, 0.0, 0.0)
        return 1 + q * (a + q * (b + q * c))


class Lobe(Record):
    """How a light's intensity falls beside its axis: as the cosine to a power."""

    axis: Vector3 = Field(description="unit vector along which it is brightest")
    exponent: float = Field(ge=0)


class CalibratedLight(Light):
    """A light with its lobe.

    Its intensity is that along the lobe's axis, which a calibration lays through the white spheres' middle.
    """

    lobe: Lobe | None = Field(default=None, exclude_if=is_absent, description="null for a light that is even")

    def towards(self, point_mm: Vector3) -> Light:
        """The light with its intensity towards a point, and without a lobe; the intensity is 0 behind the light."""
        if self.lobe is None:
            return self
        off = [there - here for there, here in zip(point_mm, self.position_mm, strict=True)]
        cosine = sum(a * b for a, b in zip(off, self.lobe.axis, strict=True)) / (
            math.hypot(*off) * math.hypot(*self.lobe.axis)
        )
        share = max(cosine, 0.0) ** self.lobe.exponent
        return Light(
            name=self.name, position_mm=self.position_mm, intensity=tuple(share * one for one in self.intensity)
        )


class CameraColour(Record):
    """From a camera's radiance, divided by that of a perfect diffuser in the same light, to XYZ with Y = 1 for that
    diffuser.
    """

    xyz_from_rgb: Matrix3
    root_polynomial: tuple[tuple[float, ...], ...] | None = Field(
        default=None,
        description="of three rows, on the terms of degree 2 after Finlayson 2015; null for the matrix alone",
    )
