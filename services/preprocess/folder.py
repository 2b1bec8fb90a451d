"""A capture that comes as a folder: ``capture.json``, linear float images, optional variances."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.calibration import require_consistent
from services.core.errors import CaptureInputError
from services.core.files.arrays import as_float32, map_radiance
from services.core.records import FolderCapture, ImageEntry, MaskBit
from services.core.store import read_record
from services.preprocess.projection import Footprint
from services.preprocess.source import LightImage

# Dead pixels are masked, also all of one tooth in a jaw; more than this share of all that is shown means the file is broken
NOT_FINITE_LIMIT = 0.5
NAMES_SHOWN = 3
"""Lights that a note names, of those without an image."""


class FolderSource:
    """Reads a folder capture; everything but the pixels is checked before the first image is opened."""

    measures_motion = False

    def __init__(self, root: Path, noise_relative: float, noise_floor: float) -> None:
        """Open ``root/capture.json``.

        Args:
            noise_relative: assumed noise where no variance is given, fraction of the value.
            noise_floor: and of the image's maximum.

        Raises:
            CaptureInputError: names what is missing or contradictory.
        """
        self.root = root
        self.notes: tuple[str, ...] = ()
        self.description = read_record(root / "capture.json", FolderCapture)
        self._noise = noise_relative, noise_floor
        origin = str(root / "capture.json")
        require_consistent(self.description, origin)
        if not self.description.images:
            raise CaptureInputError(f"{origin} lists no image; add one entry per camera and light.")
        cameras = {camera.name for camera in self.description.cameras}
        lights = {light.name for light in self.description.lights}
        numbers = {camera.name: number for number, camera in enumerate(self.description.cameras)}
        self._entries: dict[tuple[str, str], ImageEntry] = {}
        for entry in self.description.images:
            if entry.camera not in cameras:
                raise CaptureInputError(
                    f"{origin}: image {entry.file} names camera {entry.camera}, which is not among the cameras; correct the name."
                )
            if entry.light not in lights:
                raise CaptureInputError(
                    f"{origin}: image {entry.file} names light {entry.light}, which is not among the lights; correct the name."
                )
            if (entry.camera, entry.light) in self._entries:
                raise CaptureInputError(
                    f"{origin} lists camera {entry.camera} under light {entry.light} twice; keep one of the images."
                )
            self._entries[entry.camera, entry.light] = entry
            for file in (entry.file, entry.variance_file):
                if file is not None and not self._path(file).is_file():
                    raise CaptureInputError(
                        f"Image file {root / file} (camera {entry.camera}, light {entry.light}) does not exist; put it there or remove its entry."
                    )
                if file is not None:
                    self._map(entry, file, numbers[entry.camera])
        used = {light for _, light in self._entries}
        if unused := [light.name for light in self.description.lights if light.name not in used]:
            shown = ", ".join(unused[:NAMES_SHOWN]) + (
                f" and {len(unused) - NAMES_SHOWN} more" if len(unused) > NAMES_SHOWN else ""
            )
            self.notes = (f"No image names light {shown}; remove what the rig does not have, or add its images.",)
        self.held_out = tuple(pair for pair, entry in self._entries.items() if entry.held_out)

    def lights_of(self, camera: int) -> tuple[int, ...]:
        """See ``Source``."""
        name = self.description.cameras[camera].name
        return tuple(k for k, light in enumerate(self.description.lights) if (name, light.name) in self._entries)

    def images(self, camera: int, footprint: Footprint) -> Iterator[tuple[int, LightImage]]:
        """See ``Source``. A variance file is the variance of the pixel's value and used as it is."""
        name = self.description.cameras[camera].name
        for light in self.lights_of(camera):
            entry = self._entries[name, self.description.lights[light].name]
            radiance = self._read(entry, entry.file, camera)
            finite = np.isfinite(radiance)
            broken = int(np.count_nonzero(~finite.all(axis=-1) & footprint.covered))
            if broken > max(1, NOT_FINITE_LIMIT * int(np.count_nonzero(footprint.covered))):
                raise CaptureInputError(
                    f"Image file {self.root / entry.file} (camera {name}, light {entry.light}) is not finite at {broken} tooth pixels; export it again."
                )
            radiance = np.where(finite, radiance, 0)
            if entry.variance_file is not None:
                variance = self._read(entry, entry.variance_file, camera)
            else:
                relative, floor = self._noise
                variance = (relative * radiance) ** 2 + np.float32((floor * float(np.abs(radiance).max())) ** 2)
            # A weight is 1/variance, so a variance of zero is as unusable as NaN
            usable = (finite & np.isfinite(variance) & (variance > 0)).all(axis=-1)
            bits = np.where(usable, 0, MaskBit.NOT_FINITE).astype(np.uint16)
            yield light, LightImage(radiance, np.where(np.isfinite(variance), variance, 0), bits)

    def _path(self, file: str) -> Path:
        path = (self.root / file).resolve()
        if not path.is_relative_to(self.root.resolve()):
            raise CaptureInputError(f"Image file {file} lies outside the capture folder {self.root}; put it inside.")
        return path

    def _read(self, entry: ImageEntry, file: str, camera: int) -> NDArray[np.float32]:
        return as_float32(*self._map(entry, file, camera))

    def _map(self, entry: ImageEntry, file: str, camera: int) -> tuple[NDArray[np.floating[Any]], str]:
        place = f"Image file {self.root / file} (camera {entry.camera}, light {entry.light})"
        if Path(file).suffix.lower() != ".npy":
            raise CaptureInputError(
                f"{place} is no .npy file, the only format read here; convert it with numpy.save, linear and as float32."
            )
        width, height = self.description.cameras[camera].size
        return map_radiance(self._path(file), (height, width, len(self.description.channels)), place), place
