"""``registration.json``: where the teeth of a scan stand in the rig, and how well that is known."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from services.core.geometry import Matrix4, Record, Vector3
from services.core.uncertainty import CalibrationUncertainty

REGISTRATION = "registration.json"


class RegistrationStep(Record):
    """What one step towards the pose has found."""

    name: Literal["landmarks", "outlines"]
    rig_from_scan: Matrix4 = Field(description="rigid transform, mm")
    covariance: tuple[tuple[float, ...], ...] = Field(
        description="6 x 6 of a twist about the teeth's centre: rotation vector in rad, then translation in mm, in the rig's axes"
    )
    residual_px: dict[str, float] = Field(
        description="camera -> median distance between what is predicted and what is seen"
    )
    residual_mm: float = Field(description="the same at the teeth, over all cameras")
    points: int = Field(description="that were used")
    left_out: tuple[str, ...] = Field(default=(), description="what did not fit, in words")


class Registration(Record):
    """The record of a registration. Teeth and gums beside it are in the rig's frame already."""

    units: Literal["mm"] = "mm"
    rig_from_scan: Matrix4 = Field(description="rigid transform of the last step, mm; the scan is in mm before it")
    centre_mm: Vector3 = Field(description="mean of all vertices of the teeth, in the rig")
    uncertainty: CalibrationUncertainty = Field(description="of teeth.rx to teeth.tz, about that centre")
    steps: tuple[RegistrationStep, ...]
    misfit_mm: float = Field(description="median distance of the teeth's outlines from those in the photographs")
    teeth: tuple[int, ...] = Field(description="FDI numbers")
    repairs: str = Field(description="what was mended in the scan, in words")
    inputs: dict[str, str] = Field(description="SHA-256 of the scan and of the calibration, by file name")
    pictures: tuple[str, ...] = Field(description="overlays, one a camera")
