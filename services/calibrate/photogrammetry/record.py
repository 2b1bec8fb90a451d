"""The calibration that a model's cameras and the lights around it make up."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from services.calibrate.photogrammetry.colmap import ColmapModel, KnownDistance, named_images
from services.core.calibration.cameras_and_lights import CalibratedCamera, CalibratedLight
from services.core.calibration.record import Calibration, require_consistent
from services.core.calibration.uncertainty import CalibrationUncertainty
from services.core.errors import CaptureInputError
from services.core.store import sha256_of

MODEL_FILES = ("cameras", "images", "points3D")
"""Names, without their endings, of the files of a COLMAP model that are read."""


def scale_of(model: ColmapModel, mm_per_unit: float | None, known: KnownDistance | None) -> float:
    """Millimetres per unit of a model, given or by a measured distance.

    Raises:
        CaptureInputError: neither or both are given, or what is given is not positive.
    """
    if (mm_per_unit is None) == (known is None):
        raise CaptureInputError(
            f"The COLMAP model in {model.folder} has no unit of length; give either --scale, the millimetres per unit,"
            " or --distance with two points or images and the millimetres between them."
        )
    scale = mm_per_unit if known is None else model.mm_per_unit(known)
    if scale is None or not scale > 0:
        raise CaptureInputError("A model's scale must be more than 0 mm per unit; give what was measured.")
    return scale


def cameras_of(model: ColmapModel, chosen: Sequence[str], mm_per_unit: float) -> tuple[CalibratedCamera, ...]:
    """The cameras of a model in mm: those that ``CAMERA=IMAGE`` name, or one for each of its images.

    Raises:
        CaptureInputError: an image has no pose, a lens model that cannot be used, or the name of another one.
    """
    images = named_images(model.images, chosen)
    return tuple(model.camera(image, name, mm_per_unit) for name, image in images.items())


def calibration_of(
    model: ColmapModel,
    cameras: Sequence[CalibratedCamera],
    lights: Sequence[CalibratedLight],
    channels: Sequence[str],
    others: Sequence[Path] = (),
    uncertainty: CalibrationUncertainty | None = None,
) -> Calibration:
    """The calibration of cameras and lights.

    Args:
        others: files that it was made from besides the model.
        uncertainty: of the lights; None where it was not measured.

    Raises:
        CaptureInputError: they contradict each other, or a length or an intensity is impossible.
    """
    files = [path for name in MODEL_FILES for path in model.folder.glob(f"{name}.*")] + list(others)
    record = Calibration(
        units="mm",
        channels=tuple(channels),
        cameras=tuple(cameras),
        lights=tuple(lights),
        uncertainty=uncertainty,
        made=datetime.now(UTC).isoformat(timespec="seconds"),
        inputs={path.name: sha256_of(path) for path in files},
    )
    require_consistent(record, f"The calibration by {model.folder}")
    return record


def with_scale_of_counts(
    cameras: Sequence[CalibratedCamera], per_count: float, channels: int
) -> tuple[CalibratedCamera, ...]:
    """The cameras with the radiance of one count, at 1 s and gain 1, in the unit of the lights' intensities per mm²."""
    return tuple(camera.model_copy(update={"radiance_per_count": (per_count,) * channels}) for camera in cameras)
