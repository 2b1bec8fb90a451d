"""Calibration record of a session's results, with one joint covariance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from services.calibrate.cameras.rotations import cross_matrix, left_jacobian, pose_matrix, rotation_matrix
from services.calibrate.lights.mirror import PosedCamera
from services.calibrate.session.boards import CamerasStep
from services.calibrate.session.charts import ColourStep
from services.calibrate.session.photos import Black
from services.calibrate.session.spheres import IntensityStep, LightsStep
from services.core.calibration.cameras_and_lights import CalibratedCamera, CalibratedLight, CameraColour, Lobe
from services.core.calibration.record import Calibration
from services.core.calibration.uncertainty import LENS, TWIST, CalibrationUncertainty
from services.core.raw.records import RawFolder

Floats = NDArray[np.float64]
REFLECTANCE_SE = 0.01
"""Relative standard error of a white sphere's reflectance where raw.toml does not state it: a white standard is
certified to about 1 %."""
LIGHT_DRIFT = 1e-4
"""Relative standard error of a lamp's brightness beyond that of the fit: it changes by so much while the lamp warms
up."""


def record_of(
    folder: RawFolder,
    black: Mapping[str, Black],
    vignettings: Mapping[str, tuple[float, float, float]],
    cameras: CamerasStep,
    lights: LightsStep | None,
    intensity: IntensityStep | None,
    colours: ColourStep | None,
    made: str,
    valid_days: float,
    inputs: dict[str, str],
) -> Calibration:
    """Return the calibration record; lights whose position neither highlights nor a list gives are left out."""
    posed_cameras = cameras.posed_cameras if lights is None else lights.fit.cameras
    positions = light_positions(folder, lights)
    return Calibration(
        units="mm",
        channels=folder.channels,
        cameras=camera_records(cameras.names, posed_cameras, black, vignettings, intensity),
        lights=light_records(folder, positions, intensity),
        uncertainty=uncertainty_of(folder, cameras, lights, intensity),
        made=made,
        valid_days=valid_days,
        inputs=inputs,
        colour=(
            None
            if colours is None
            else {
                name: CameraColour.model_validate(
                    {
                        "xyz_from_rgb": fit.matrix.tolist(),
                        "root_polynomial": None if fit.root_polynomial is None else fit.root_polynomial.tolist(),
                    }
                )
                for name, fit in colours.fits.items()
            }
        ),
    )


def light_positions(folder: RawFolder, lights: LightsStep | None) -> dict[int, Floats]:
    """Return the positions (3,) in mm by number of the light: from highlights, else from the list aligned with them, or
    from the list as it is where there are no mirror spheres.
    """
    found = {} if lights is None else dict(zip(lights.fit.lights.tolist(), lights.fit.positions_mm, strict=True))
    positions = {}
    for number, light in enumerate(folder.light):
        if number in found:
            positions[number] = found[number]
        elif lights is not None and lights.aligned is not None:
            positions[number] = lights.aligned.positions_mm[number]
        elif lights is None and light.position_mm is not None:
            positions[number] = np.array(light.position_mm)
    return positions


def twist_derivative(pose: Floats) -> Floats:
    """Return the derivative (6, 6) of a camera's twist, about its own centre in world axes, with respect to its pose
    camera_from_world (6,).

    A rotation w of the camera changes the matrix R = exp(r) to R exp(−w), so w = −Rᵀ J dr with the left Jacobian J of
    r; the centre c = −Rᵀ t moves by −Rᵀ dt + w × c.
    """
    R = rotation_matrix(pose[:3])
    centre = -R.T @ pose[3:]
    rotation = -R.T @ left_jacobian(pose[:3])
    derivative = np.zeros((6, 6))
    derivative[:3, :3] = rotation
    derivative[3:, :3] = -cross_matrix(centre) @ rotation
    derivative[3:, 3:] = -R.T
    return derivative


def uncertainty_of(
    folder: RawFolder, cameras: CamerasStep | None, lights: LightsStep | None, intensity: IntensityStep | None
) -> CalibrationUncertainty:
    """Return the joint covariance of cameras, lights and intensities; errors of the cameras are propagated to the
    lights, and errors of the lights to the intensities. Without ``cameras`` theirs count as exact.
    """
    names, rows, covariance = list[str](), np.zeros((0, 0)), np.zeros((0, 0))
    if cameras is not None:
        names, rows = _camera_rows(cameras.names, cameras.posed_cameras if lights is None else lights.fit.cameras)
        covariance = cameras.camera_covariance
    first = 0
    if lights is not None:
        covariance, count = lights.fit.covariance, 3 * len(lights.fit.lights)
        first = len(covariance) - rows.shape[1]
        names += [f"light.{folder.light[number].name}.{axis}" for number in lights.fit.lights for axis in "xyz"]
        rows = np.block([[np.zeros((len(rows), first)), rows], [np.eye(count, len(covariance))]])
    noise = np.zeros((len(rows), len(rows)))
    if intensity is not None:
        fit = intensity.fit
        measured = np.flatnonzero(np.isfinite(fit.intensity[:, 0]))
        names += [f"light_gain.{folder.light[n].name}.{channel}" for n in measured for channel in folder.channels]
        gain_by_geometry = np.zeros((len(fit.covariance), covariance.shape[1]))
        if lights is not None:
            # A light whose position is estimated too near gets too low an intensity, so gains are correlated with the
            # positions from highlights.
            for place, number in enumerate(lights.fit.lights):
                gain_by_geometry[:, 3 * place : 3 * place + 3] = fit.by_positions[:, 3 * number : 3 * number + 3]
        rows = np.concatenate([rows, gain_by_geometry])
        noise = np.zeros((len(rows), len(rows)))
        noise[-len(gain_by_geometry) :, -len(gain_by_geometry) :] = fit.covariance + LIGHT_DRIFT**2 * np.eye(
            len(gain_by_geometry)
        )
    total = rows @ covariance @ rows.T + noise
    if intensity is not None:
        names += [f"gain.{channel}" for channel in folder.channels]
        both = np.zeros((len(names), len(names)))
        both[: len(total), : len(total)], both[len(total) :, len(total) :] = total, gain_covariance(intensity)
        total = both
    return CalibrationUncertainty.model_validate({"names": names, "covariance": ((total + total.T) / 2).tolist()})


def gain_covariance(intensity: IntensityStep) -> Floats:
    """Return the relative covariance (C, C) of the common brightness of all photographs by channel.

    An error of the white sphere's reflectance is the same in all channels; the photographs' scatter is independent
    between channels. The errors of the lights' positions would add hundredths of a per cent and are left out.
    """
    shared = REFLECTANCE_SE if intensity.reflectance_se is None else intensity.reflectance_se
    scatter = intensity.fit.sigma / len(intensity.photos) ** 0.5
    return np.asarray(shared**2 * np.ones((len(scatter),) * 2) + np.diag(scatter**2 + LIGHT_DRIFT**2))


def _camera_rows(names: Sequence[str], posed_cameras: Sequence[PosedCamera]) -> tuple[list[str], Floats]:
    """Return the names of the cameras' errors, and their derivative (10 K, C) with respect to the lens values and pose
    of each camera in turn.
    """
    error_names, blocks, width = [], [], sum(len(camera.lens.values) + 6 for camera in posed_cameras)
    first = 0
    for name, camera in zip(names, posed_cameras, strict=True):
        count = len(camera.lens.values)
        block = np.zeros((10, width))
        block[:6, first + count : first + count + 6] = twist_derivative(camera.pose)
        block[6:, first : first + 4] = np.diag([1 / camera.lens.values[0], 1 / camera.lens.values[1], 1, 1])
        error_names += [f"camera.{name}.{axis}" for axis in TWIST + LENS]
        blocks.append(block)
        first += count + 6
    return error_names, np.concatenate(blocks)


def camera_records(
    names: Sequence[str],
    cameras: Sequence[PosedCamera],
    black: Mapping[str, Black],
    vignettings: Mapping[str, tuple[float, float, float]],
    intensity: IntensityStep | None,
) -> tuple[CalibratedCamera, ...]:
    """Return the records of the cameras; without intensities none has a radiance per count."""
    scales = [None] * len(names) if intensity is None else intensity.fit.radiance_per_count
    return tuple(
        _camera(name, camera, black[name], vignettings.get(name), scale)
        for name, camera, scale in zip(names, cameras, scales, strict=True)
    )


def light_records(
    folder: RawFolder, positions: Mapping[int, Floats], intensity: IntensityStep | None
) -> tuple[CalibratedLight, ...]:
    """Return the records of the lights whose positions, by number, are known; one without a photograph of a white
    sphere gets the mean intensity, 1.
    """
    return tuple(
        _light(folder.light[number].name, where, number, intensity, len(folder.channels))
        for number, where in positions.items()
    )


def _camera(
    name: str, camera: PosedCamera, black: Black, vignetting: tuple[float, float, float] | None, scale: Floats | None
) -> CalibratedCamera:
    return CalibratedCamera.model_validate(
        {
            "name": name,
            "size": camera.lens.size,
            "K": camera.lens.matrix.tolist(),
            "distortion": camera.lens.distortion.tolist() or None,
            "camera_from_world": pose_matrix(camera.pose).tolist(),
            "vignetting": vignetting,
            "radiance_per_count": None if scale is None else scale.tolist(),
            "black_counts": black.counts,
            "read_noise_counts": black.noise,
        }
    )


def _light(name: str, where: Floats, number: int, step: IntensityStep | None, channels: int) -> CalibratedLight:
    known = step is not None and bool(np.isfinite(step.fit.intensity[number, 0]))
    lobe = None
    if step is not None and step.fit.exponent > 0:
        axis = np.array(step.middle_mm) - where
        lobe = Lobe.model_validate({"axis": (axis / np.linalg.norm(axis)).tolist(), "exponent": step.fit.exponent})
    intensity = step.fit.intensity[number].tolist() if step is not None and known else [1.0] * channels
    x, y, z = (float(one) for one in where)
    return CalibratedLight(name=name, position_mm=(x, y, z), intensity=tuple(intensity), lobe=lobe)
