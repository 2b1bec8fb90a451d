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

    def shoot(self, camera: int, name: str, radiance: Floats, exposure_s: float, **told: Any) -> None:
        """Photograph an image (H, W, 3) and write it as NAME.npy.

        Args:
            camera: index of the camera.
            name: name of the file, after that of the camera.
            radiance: image on the sensor, behind the lens.
            exposure_s: exposure time of the frame, seconds.
            told: further keys of the frame in ``raw.toml``.
        """
        taken = self.rig.cameras[camera]
        file = f"{taken.name}_{name}.npy"
        np.save(self.root / file, self.sensor.photograph(taken, radiance, exposure_s, self._random))
        self._frames.append({"camera": taken.name, "file": file, "exposure_s": exposure_s, **told})

    def black(self, camera: int, exposures_s: Sequence[float], count: int) -> None:
        """Take ``count`` black frames with each exposure time."""
        width, height = self.rig.cameras[camera].size
        for exposure_s in exposures_s:
            for number in range(count):
                nothing = np.zeros((height, width, 3))
                self.shoot(camera, f"black{number}_{exposure_s:g}", nothing, exposure_s, kind="black")

    def finish(self, others: Mapping[str, Any]) -> None:
        """Write ``raw.toml`` with cameras, lights, frames and other tables."""
        cameras = [
            {"name": one.name, "size": list(one.size), "bits": self.sensor.bits, "mosaic": self.sensor.mosaic}
            for one in self.rig.cameras
        ]
        lights = [{"name": one.name} for one in self.rig.lights]
        tree = {"units": "mm", "camera": cameras, "light": lights, "frame": self._frames, **others}
        write_atomic(self.root / DESCRIPTION, description_toml(tree))
