"""Writer of a raw folder: frames one by one, and at the end ``raw.toml``, which completes the folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.calibration.record import Calibration
from services.core.raw.folder import DESCRIPTION
from services.core.raw.toml_writing import description_toml
from services.core.store import write_atomic
from services.phantom.lab.sensor import Sensor

Floats = NDArray[np.float64]
Entry = dict[str, Any]


class RawWriter:
    """Writer that turns radiance into photographs of a rig's cameras and lists the frames."""

    def __init__(self, root: Path, rig: Calibration, sensor: Sensor, random: np.random.Generator) -> None:
        root.mkdir(parents=True, exist_ok=True)
        self.root, self.rig, self.sensor, self._random = root, rig, sensor, random
        self._frames: list[Entry] = []

    def shoot(self, camera: int, name: str, radiance: Floats, exposure_s: float, **frame_keys: Any) -> None:
        """Photograph an image (H, W, 3) and write it as NAME.npy.

        Args:
            camera: index of the camera.
            name: name of the file, after that of the camera.
            radiance: image on the sensor, behind the lens.
            exposure_s: exposure time of the frame, seconds.
            frame_keys: further keys of the frame in ``raw.toml``.
        """
        calibrated = self.rig.cameras[camera]
        file = f"{calibrated.name}_{name}.npy"
        np.save(self.root / file, self.sensor.photograph(calibrated, radiance, exposure_s, self._random))
        self._frames.append({"camera": calibrated.name, "file": file, "exposure_s": exposure_s, **frame_keys})

    def black(self, camera: int, exposures_s: Sequence[float], count: int) -> None:
        """Take ``count`` black frames with each exposure time."""
        width, height = self.rig.cameras[camera].size
        for exposure_s in exposures_s:
            for number in range(count):
                dark = np.zeros((height, width, 3))
                self.shoot(camera, f"black{number}_{exposure_s:g}", dark, exposure_s, kind="black")

    def finish(self, tables: Mapping[str, Any]) -> None:
        """Write ``raw.toml`` with cameras, lights, frames and other tables."""
        cameras = [
            {"name": one.name, "size": list(one.size), "bits": self.sensor.bits, "mosaic": self.sensor.mosaic}
            for one in self.rig.cameras
        ]
        lights = [{"name": one.name} for one in self.rig.lights]
        tree = {"units": "mm", "camera": cameras, "light": lights, "frame": self._frames, **tables}
        write_atomic(self.root / DESCRIPTION, description_toml(tree))
