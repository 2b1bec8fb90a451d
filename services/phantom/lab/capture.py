"""The capture of a virtual laboratory's mouth: lights in turn, some frames with all of them, while the subject sways a
little.
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
"""Of every light: the long one reaches full scale where a light stands in front, the short one nowhere."""
TRACKING_S = 0.004
"""With all lights on."""
FRAME_S = 0.15
"""From one frame to the next."""
SWAY_MM = (0.15, 0.1, 0.2)
"""How far the jaw moves from where it was at first, at most about twice that, along x, y and z."""
SWAY_S = 7.0
TRACKING_EVERY = 2
"""Lights between two frames with all of them."""
CLICK_PX = 1.0
"""Standard deviation of an operator's click."""
BLACKS, FLATS = 4, 2


@dataclass(frozen=True)
class Shown:
    """One camera's images as a pinhole has them, and the way of its lens from them to photographs."""

    camera: CalibratedCamera
    images: Floats
    """(L, H, W, 3)"""

    def through_lens(self, image: Floats, moved_px: Floats) -> Floats:
        """An image (H, W, 3) behind the lens, of a mouth that has moved by some pixels (2,)."""
        import cv2

        width, height = self.camera.size
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        places = Lens(self.camera).undistorted(np.stack([x.ravel(), y.ravel()], axis=1)) - moved_px - 0.5
        maps = places.reshape(height, width, 2).astype(np.float32)
        return np.asarray(
            cv2.remap(image, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        )


def sway_mm(time_s: float) -> Floats:
    """Where the jaw is (3,) at a time of the capture; at its beginning it is at rest in the origin."""
    phase = 2 * np.pi * time_s / SWAY_S * np.array([1.0, 0.8, 0.6])
    return np.asarray(np.array(SWAY_MM) * (1 - np.cos(phase)))


def write_capture(
    root: Path, rig: Calibration, sensor: Sensor, mouth: LabMouth, shown: list[Shown], calibration: str, seed: int
) -> None:
    """Write a raw folder of the mouth: its frames, its scan and the operator's clicks.

    Args:
        root: to fill.
        rig: the true one.
        sensor: of all cameras.
        mouth: what is photographed.
        shown: each camera's images.
        calibration: where ``raw.toml`` says that the calibration is.
        seed: of noise and clicks.
    """
    random = np.random.default_rng([seed, 0xCA9])
    writer = RawWriter(root, rig, sensor, random)
    lights = [light.name for light in rig.lights]
    for number, one in enumerate(shown):
        writer.black(number, (*EXPOSURES_S, TRACKING_S), BLACKS)
        for flat in range(FLATS):
            even = np.full(one.images.shape[1:], 0.6 / (np.pi * 1e6))
            writer.shoot(number, f"flat{flat}", even, EXPOSURES_S[0], kind="flat")
        time_s = 0.0

        def take(
            name: str, image: Floats, exposure_s: float, number: int = number, one: Shown = one, **told: object
        ) -> None:
            nonlocal time_s
            moved_px = _seen_move(one.camera, sway_mm(time_s))
            writer.shoot(number, name, one.through_lens(image, moved_px), exposure_s, time_s=round(time_s, 6), **told)
            time_s += FRAME_S

        together = one.images.sum(axis=0)
        for j, light in enumerate(lights):
            if j % TRACKING_EVERY == 0:
                take(f"all{j}", together, TRACKING_S, kind="tracking")
            for exposure_s in EXPOSURES_S:
                take(f"{light}_{exposure_s:g}", one.images[j], exposure_s, kind="light", light=light)
        take(f"all{len(lights)}", together, TRACKING_S, kind="tracking")
    write_scan(root / "scan.ply", mouth)
    writer.finish(
        {
            "calibration": {"file": calibration},
            "scan": {"file": "scan.ply", "units": "mm", "labels": "label", "jaw": "upper"},
            "landmark": _clicks(rig, mouth, random),
        }
    )


def _seen_move(camera: CalibratedCamera, moved_mm: Floats) -> Floats:
    """By how many pixels (2,) the middle of the teeth moves in a pinhole's image; at half a metre all of them move
    alike.
    """
    start, end = camera.project(np.stack([np.zeros(3), moved_mm]))[0]
    return np.asarray(end - start)


def _clicks(rig: Calibration, mouth: LabMouth, random: np.random.Generator) -> list[dict[str, object]]:
    turn, shift = mouth.world_from_scan[:3, :3], mouth.world_from_scan[:3, 3]
    found: list[dict[str, object]] = []
    for (tooth, point), scan_mm in landmarks_mm(mouth).items():
        world = (turn @ scan_mm + shift)[None]
        pixels = [
            {"camera": one.name, "xy_px": (Lens(one).seen(world)[0] + random.normal(0, CLICK_PX, 2)).round(2).tolist()}
            for one in rig.cameras
        ]
        found.append({"tooth": tooth, "point": point, "xyz_mm": scan_mm.round(4).tolist(), "pixels": pixels})
    return found
