"""Lights around the cameras of a model, by the mirror and white spheres of a raw folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from services.calibrate.cameras.lens import Lens
from services.calibrate.cameras.rotations import pose_vector
from services.calibrate.lights.mirror import PosedCamera
from services.calibrate.session.flats import measure_vignetting
from services.calibrate.session.photos import Photos
from services.calibrate.session.record import camera_records, light_positions, light_records, uncertainty_of
from services.calibrate.session.spheres import find_lights, measure_intensity
from services.core.calibration.cameras_and_lights import CalibratedCamera, CalibratedLight
from services.core.calibration.uncertainty import CalibrationUncertainty
from services.core.errors import CaptureInputError
from services.core.raw.folder import DESCRIPTION, read_raw_folder


@dataclass(frozen=True)
class LitRig:
    """The cameras and lights of a raw folder."""

    channels: tuple[str, ...]
    cameras: tuple[CalibratedCamera, ...]
    """Those of the model, with black level and, by a white sphere, radiance per count."""
    lights: tuple[CalibratedLight, ...]
    uncertainty: CalibrationUncertainty
    """Of the lights alone: a model states no errors of its cameras."""


def lights_by_spheres(root: Path, cameras: Sequence[CalibratedCamera], distance_mm: float) -> LitRig:
    """Find the lights of a raw folder, whose cameras are those of a model.

    Args:
        root: folder with ``raw.toml``, which lists frames of mirror spheres and, for intensities, of white ones.
        cameras: cameras of the model; the folder's are among them.
        distance_mm: approximate distance of the spheres from the cameras.

    Raises:
        CaptureInputError: the folder has no mirror sphere, a camera is not in the model or has other images there, or a
            photograph cannot be used.
    """
    folder = read_raw_folder(root)
    known = {camera.name: camera for camera in cameras}
    for camera in folder.camera:
        if (own := known.get(camera.name)) is None:
            raise CaptureInputError(
                f"Camera {camera.name} of {root / DESCRIPTION} is not in the model; name its image by --camera"
                f" {camera.name}=IMAGE."
            )
        if own.size != camera.size:
            theirs, ours = (" x ".join(map(str, size)) for size in (own.size, camera.size))
            raise CaptureInputError(
                f"Camera {camera.name} has images of {theirs} pixels in the model and of {ours} in {root}; reconstruct"
                " the model from images of full size."
            )
    photos = Photos(root, folder)
    names = [camera.name for camera in folder.camera]
    posed = [posed_camera(known[name]) for name in names]
    lights = find_lights(photos, posed, None, distance_mm)
    if lights is None:
        raise CaptureInputError(
            f"{root / DESCRIPTION} lists no frame of kind mirror-sphere; add them, or give a table by --lights."
        )
    positions = light_positions(folder, lights)
    places = np.array([positions.get(number, np.full(3, np.nan)) for number in range(len(folder.light))])
    vignettings = {
        name: found
        for name, camera in zip(names, posed, strict=True)
        if (found := measure_vignetting(photos, name, camera.lens.values[2:4])) is not None
    }
    intensity = measure_intensity(photos, posed, places, distance_mm, vignettings)
    return LitRig(
        folder.channels,
        camera_records(names, posed, photos.black, vignettings, intensity),
        light_records(folder, positions, intensity),
        uncertainty_of(folder, None, lights, intensity),
    )


def posed_camera(camera: CalibratedCamera) -> PosedCamera:
    """The lens and pose of a calibrated camera."""
    K = np.array(camera.K)
    values = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *(camera.distortion or ())])
    return PosedCamera(Lens(camera.size, values), pose_vector(np.array(camera.camera_from_world)))
