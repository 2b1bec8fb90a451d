"""Capture of a virtual laboratory's mouth: one light after the other, some frames with all lights, while the subject
sways a little.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.calibration.cameras_and_lights import CalibratedCamera
from services.core.calibration.record import Calibration
from services.phantom.lab.folder import RawWriter
from services.phantom.lab.mouth import LabMouth, landmarks_mm, write_scan
from services.phantom.lab.rig import Lens
from services.phantom.lab.sensor import Sensor

Floats = NDArray[np.float64]
EXPOSURES_S = (0.02, 0.06)
"""Exposure times of every light, seconds. Under lights in front the long one reaches full scale, the short one never
does."""
TRACKING_S = 0.004
"""Exposure time of a tracking frame, with all lights on, seconds."""
FRAME_S = 0.15
"""Time from one frame to the next, seconds."""
SWAY_MM = (0.15, 0.1, 0.2)
"""Amplitudes of the jaw's sway along x, y and z, mm. It begins at an extreme, so displacements reach twice this."""
SWAY_S = 7.0
"""Period of the sway along x, seconds; those along y and z are longer."""
TRACKING_EVERY = 2
"""Number of lights between two tracking frames."""
CLICK_PX = 1.0
"""Standard deviation of an operator's click, pixels."""
BLACKS, FLATS = 4, 2
"""Numbers of black frames for each exposure time and of flat frames."""


@dataclass(frozen=True)
class PinholeImages:
    """One camera's images as an ideal pinhole would see them, and their distortion by its lens."""

    camera: CalibratedCamera
    images: Floats
    """Radiance (L, H, W, 3) under each light."""

    def through_lens(self, image: Floats, moved_px: Floats) -> Floats:
        """Image (H, W, 3) behind the lens, of a mouth that has moved by ``moved_px`` (2,) pixels."""
        import cv2

        width, height = self.camera.size
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        positions = Lens(self.camera).undistorted(np.stack([x.ravel(), y.ravel()], axis=1)) - moved_px - 0.5
        maps = positions.reshape(height, width, 2).astype(np.float32)
        return np.asarray(
            cv2.remap(image, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        )


def sway_mm(time_s: float) -> Floats:
    """Displacement (3,) of the jaw at a time of the capture; at time 0 it is zero and at rest."""
    phase = 2 * np.pi * time_s / SWAY_S * np.array([1.0, 0.8, 0.6])
    return np.asarray(np.array(SWAY_MM) * (1 - np.cos(phase)))


def write_capture(
    root: Path,
    rig: Calibration,
    sensor: Sensor,
    mouth: LabMouth,
    pinhole_images: list[PinholeImages],
    calibration: str,
    seed: int,
) -> None:
    """Write a raw folder of the mouth: its frames, its scan and the operator's clicks.

    Args:
        root: folder to fill.
        rig: the true rig.
        sensor: sensor of all cameras.
        mouth: the mouth that is photographed.
        pinhole_images: images of each camera.
        calibration: path of the calibration that ``raw.toml`` names.
        seed: seed of noise and clicks.
    """
    random = np.random.default_rng([seed, 0xCA9])
    writer = RawWriter(root, rig, sensor, random)
    lights = [light.name for light in rig.lights]
    for number, one in enumerate(pinhole_images):
        writer.black(number, (*EXPOSURES_S, TRACKING_S), BLACKS)
        for flat in range(FLATS):
            uniform = np.full(one.images.shape[1:], 0.6 / (np.pi * 1e6))
            writer.shoot(number, f"flat{flat}", uniform, EXPOSURES_S[0], kind="flat")
        time_s = 0.0

        def take(
            name: str,
            image: Floats,
            exposure_s: float,
            number: int = number,
            one: PinholeImages = one,
            **frame_keys: object,
        ) -> None:
            nonlocal time_s
            moved_px = _image_displacement(one.camera, sway_mm(time_s))
            writer.shoot(
                number, name, one.through_lens(image, moved_px), exposure_s, time_s=round(time_s, 6), **frame_keys
            )
            time_s += FRAME_S

        all_lights = one.images.sum(axis=0)
        for j, light in enumerate(lights):
            if j % TRACKING_EVERY == 0:
                take(f"all{j}", all_lights, TRACKING_S, kind="tracking")
            for exposure_s in EXPOSURES_S:
                take(f"{light}_{exposure_s:g}", one.images[j], exposure_s, kind="light", light=light)
        take(f"all{len(lights)}", all_lights, TRACKING_S, kind="tracking")
    write_scan(root / "scan.ply", mouth)
    writer.finish(
        {
            "calibration": {"file": calibration},
            "scan": {"file": "scan.ply", "units": "mm", "labels": "label", "jaw": "upper"},
            "landmark": _clicks(rig, mouth, random),
        }
    )


def _image_displacement(camera: CalibratedCamera, moved_mm: Floats) -> Floats:
    """Displacement (2,) in pixels of the middle of the teeth in the pinhole image.

    At half a metre all teeth move by about the same.
    """
    start, end = camera.project(np.stack([np.zeros(3), moved_mm]))[0]
    return np.asarray(end - start)


def _clicks(rig: Calibration, mouth: LabMouth, random: np.random.Generator) -> list[dict[str, object]]:
    rotation, shift = mouth.world_from_scan[:3, :3], mouth.world_from_scan[:3, 3]
    found: list[dict[str, object]] = []
    for (tooth, point), scan_mm in landmarks_mm(mouth).items():
        world = (rotation @ scan_mm + shift)[None]
        pixels = [
            {
                "camera": one.name,
                "xy_px": (Lens(one).project(world)[0] + random.normal(0, CLICK_PX, 2)).round(2).tolist(),
            }
            for one in rig.cameras
        ]
        found.append({"tooth": tooth, "point": point, "xyz_mm": scan_mm.round(4).tolist(), "pixels": pixels})
    return found
