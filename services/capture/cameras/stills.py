"""The images of a folder capture, as the scene of simulated and playback cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.errors import CaptureInputError
from services.core.files.arrays import as_float32, map_radiance
from services.core.records import FolderCapture


class Stills:
    """Linear images (height, width, channel) of a folder capture, by camera and light; checked once, read on demand.

    Attributes:
        peak_radiance: largest radiance of all images, without the brightest thousandth of each one's pixels.
    """

    def __init__(self, folder: Path, description: FolderCapture) -> None:
        """Check every file.

        Raises:
            CaptureInputError: an image entry names an unknown camera or light, a pair has no image, or a file is
                missing, truncated, of the wrong shape, not finite or negative.
        """
        self.description = description
        self._files = _find(folder, description)
        self.peak_radiance = max(self._peak(camera, light) for camera, light in self._files)
        if self.peak_radiance <= 0:
            raise CaptureInputError(f"All images of {folder} are black; render them again with their lights on.")

    def still(self, camera: int, light: int) -> NDArray[np.float32]:
        """Radiance (height, width, channel) that the camera sees with this light alone, at ``Light.intensity``."""
        path, what = self._files[camera, light], f"Image {self._files[camera, light]}"
        radiance = as_float32(map_radiance(path, self.shape(camera), what), what)
        if not (np.isfinite(radiance).all() and (radiance >= 0).all()):
            raise CaptureInputError(f"Image {path} holds negative or non-finite values; render or export it again.")
        return radiance

    def shape(self, camera: int) -> tuple[int, int, int]:
        """Height, width and channels of one camera's images."""
        width, height = self.description.cameras[camera].size
        return height, width, len(self.description.channels)

    def _peak(self, camera: int, light: int) -> float:
        # Let the brightest thousandth of each image saturate, as highlights do.
        return float(np.quantile(self.still(camera, light).max(axis=-1), 0.999))


def _find(folder: Path, description: FolderCapture) -> dict[tuple[int, int], Path]:
    cameras = {camera.name: index for index, camera in enumerate(description.cameras)}
    lights = {light.name: index for index, light in enumerate(description.lights)}
    files = {}
    for entry in description.images:
        for kind, name, known in (("camera", entry.camera, cameras), ("light", entry.light, lights)):
            if name not in known:
                raise CaptureInputError(
                    f"Image {entry.file} in {folder / 'capture.json'} names unknown {kind} '{name}'; known are"
                    f" {', '.join(known)}."
                )
        path = folder / entry.file
        if not path.is_file():
            raise CaptureInputError(
                f"Image {path} of camera {entry.camera} and light {entry.light} does not exist; restore the file."
            )
        files[cameras[entry.camera], lights[entry.light]] = path
    for camera, i in cameras.items():
        for light, j in lights.items():
            if (i, j) not in files:
                raise CaptureInputError(
                    f"{folder / 'capture.json'} has no image of camera {camera} and light {light}; add it or remove the"
                    " light."
                )
    return files
