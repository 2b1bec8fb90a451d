"""A capture that comes as a folder: ``capture.json``, linear float images, optional variances."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.calibration.record import require_consistent
from services.core.errors import CaptureInputError
from services.core.files.arrays import as_float32, map_radiance
from services.core.records import FolderCapture, ImageEntry, MaskBit
from services.core.store import read_record
from services.preprocess.source import Image, LightImage, Motions, View
from services.preprocess.stabilisation.seen import SeenFlow
from services.preprocess.window import bands

# Dead pixels are masked, also all of one tooth in a jaw; more than this share of all that is shown means the file is
# broken
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
                    f"{origin}: image {entry.file} names camera {entry.camera}, which is not among the cameras; correct"
                    " the name."
                )
            if entry.light not in lights:
                raise CaptureInputError(
                    f"{origin}: image {entry.file} names light {entry.light}, which is not among the lights; correct"
                    " the name."
                )
            if (entry.camera, entry.light) in self._entries:
                raise CaptureInputError(
                    f"{origin} lists camera {entry.camera} under light {entry.light} twice; keep one of the images."
                )
            self._entries[entry.camera, entry.light] = entry
            for file in (entry.file, entry.variance_file):
                if file is not None and not self._path(file).is_file():
                    raise CaptureInputError(
                        f"Image file {root / file} (camera {entry.camera}, light {entry.light}) does not exist; put it"
                        " there or remove its entry."
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

    def identity(self) -> str:
        """See ``Source``: every image's size and time of change, so that one that was exported again counts."""
        lines = [self.description.model_dump_json(), repr(self._noise)]
        for entry in self._entries.values():
            for file in filter(None, (entry.file, entry.variance_file)):
                told = self._path(file).stat()
                lines.append(f"{file} {told.st_size} {told.st_mtime_ns}")
        return "\n".join(lines)

    def matched(self, camera: int) -> tuple[int, ...]:  # noqa: ARG002
        """See ``Source``; images of a folder are taken to show the subject unmoved."""
        return ()

    def match(self, view: View, frames: Sequence[int]) -> Iterator[tuple[int, NDArray[np.float64]]]:  # noqa: ARG002
        """See ``Source``."""
        return iter(())

    def seen_flow(self, view: View, motions: Motions) -> SeenFlow | None:  # noqa: ARG002
        """See ``Source``."""
        return None

    def images(self, view: View, lights: Sequence[int], motions: Motions) -> Iterator[tuple[int, LightImage]]:  # noqa: ARG002
        """See ``Source``. A variance file is the variance of the pixel's value and used as it is."""
        for light in lights:
            yield light, self._image(self._entries[view.whole.name, self.description.lights[light].name], view)

    def _image(self, entry: ImageEntry, view: View) -> LightImage:
        covered = view.footprint.covered
        radiance = self._read(entry, entry.file, view)
        variance = None if entry.variance_file is None else self._read(entry, entry.variance_file, view)
        peak, broken = 0.0, 0
        bits = np.zeros(covered.shape, dtype=np.uint16)
        for rows in bands(covered.shape):
            values = radiance[rows]
            finite = np.isfinite(values)
            if not finite.all():
                lost = ~finite.all(axis=-1)
                broken += int(np.count_nonzero(lost & covered[rows]))
                bits[rows][lost] = MaskBit.NOT_FINITE
                values[~finite] = 0
            peak = max(peak, float(np.abs(values).max(initial=0)))
        if broken > max(1, NOT_FINITE_LIMIT * int(np.count_nonzero(covered))):
            raise CaptureInputError(
                f"Image file {self.root / entry.file} (camera {entry.camera}, light {entry.light}) is not finite at"
                f" {broken} tooth pixels; export it again."
            )
        if variance is None:
            variance = self._assumed(radiance, peak)
        for rows in bands(covered.shape):
            spread = variance[rows]
            # A weight is 1/variance, so a variance of zero is as unusable as NaN
            usable = np.isfinite(spread) & (spread > 0)
            if not usable.all():
                bits[rows][~usable.all(axis=-1)] = MaskBit.NOT_FINITE
                spread[~np.isfinite(spread)] = 0
        return LightImage(radiance, variance, bits)

    def _assumed(self, radiance: Image, peak: float) -> Image:
        """The variance (H, W, C) that the job's options assume where none is given; ``peak`` is the brightest value."""
        relative, floor = self._noise
        variance = np.empty_like(radiance)
        for rows in bands(radiance.shape[:2]):
            np.multiply(radiance[rows], np.float32(relative), out=variance[rows])
            variance[rows] *= variance[rows]
            variance[rows] += np.float32((floor * peak) ** 2)
        return variance

    def _path(self, file: str) -> Path:
        path = (self.root / file).resolve()
        if not path.is_relative_to(self.root.resolve()):
            raise CaptureInputError(f"Image file {file} lies outside the capture folder {self.root}; put it inside.")
        return path

    def _read(self, entry: ImageEntry, file: str, view: View) -> NDArray[np.float32]:
        image, place = self._map(entry, file, view.number)
        return as_float32(image[view.window.rows, view.window.columns], place)

    def _map(self, entry: ImageEntry, file: str, camera: int) -> tuple[NDArray[np.floating[Any]], str]:
        place = f"Image file {self.root / file} (camera {entry.camera}, light {entry.light})"
        if Path(file).suffix.lower() != ".npy":
            raise CaptureInputError(
                f"{place} is no .npy file, the only format read here; convert it with numpy.save, linear and as"
                " float32."
            )
        width, height = self.description.cameras[camera].size
        return map_radiance(self._path(file), (height, width, len(self.description.channels)), place), place
