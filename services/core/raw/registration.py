"""``registration.json``: the pose of a scan's teeth in the rig, with its uncertainty."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from services.core.calibration.uncertainty import CalibrationUncertainty
from services.core.errors import CaptureInputError
from services.core.geometry import Matrix4, Record, Vector3
from services.core.raw.folder import DESCRIPTION, is_raw_folder, parse_raw_folder
from services.core.store import read_record

REGISTRATION = "registration.json"
REGISTERED = "registered"
"""Name of the folder within a job's folder that holds the teeth, gums and record of the job's own registration."""


class RegistrationStep(Record):
    """The result of one step of the registration."""

    name: Literal["landmarks", "outlines"]
    rig_from_scan: Matrix4 = Field(description="rigid transform, mm")
    covariance: tuple[tuple[float, ...], ...] = Field(
        description=(
            "6 x 6 of a twist about the teeth's centre: rotation vector in rad, then translation in mm, in the rig's"
            " axes"
        )
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
    pixel_mm: float | None = Field(
        default=None,
        description="what a pixel covers at the teeth, median over the cameras; null if an earlier version wrote this",
    )
    teeth: tuple[int, ...] = Field(description="FDI numbers")
    repairs: str = Field(description="what was mended in the scan, in words")
    inputs: dict[str, str] = Field(description="SHA-256 of the scan and of the calibration, by file name")
    pictures: tuple[str, ...] = Field(description="overlays, one a camera")
    warnings: tuple[str, ...] = Field(default=(), description="on its calibration and its misfit, in sentences")


def lacks_pose(capture: Path) -> bool:
    """Whether a capture is a raw folder with a scan whose teeth nobody has registered yet.

    A description that cannot be read counts as one without a scan; the preparation raises its error.
    """
    if not is_raw_folder(capture) or (capture / "teeth").exists():
        return False
    try:
        origin = capture / DESCRIPTION
        return parse_raw_folder(origin.read_bytes(), str(origin)).scan is not None
    except CaptureInputError:
        return False


def teeth_root(capture: Path, job: Path) -> Path:
    """Folder of the teeth of a raw folder: its own, or the job's where the job has registered them."""
    registered = job / REGISTERED
    return registered if not (capture / "teeth").exists() and registered.is_dir() else capture


def with_registration(root: Path, uncertainty: CalibrationUncertainty | None) -> CalibrationUncertainty | None:
    """Add the uncertainty of the teeth's pose to that of a calibration, where the teeth come from a registration.

    The registration replaces errors of the teeth that the calibration itself states. The errors of both are taken to be
    independent.

    Args:
        root: folder of the teeth, with the registration's record if there is one.

    Raises:
        CaptureInputError: the registration's record cannot be read.
    """
    path = root / REGISTRATION
    if not path.is_file():
        return uncertainty
    own = read_record(path, Registration).uncertainty
    if uncertainty is None:
        return own
    kept = [k for k, name in enumerate(uncertainty.names) if name not in own.names]
    count = len(kept)
    matrix = np.zeros((count + len(own.names),) * 2)
    matrix[:count, :count] = uncertainty.matrix[np.ix_(kept, kept)]
    matrix[count:, count:] = own.matrix
    names = (*(uncertainty.names[k] for k in kept), *own.names)
    return CalibrationUncertainty(names=names, covariance=tuple(map(tuple, matrix.tolist())))
