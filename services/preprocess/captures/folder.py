"""A capture in the form of a folder: ``capture.json``, linear float images and optional variance images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.calibration.record import require_consistent
from services.core.errors import CaptureInputError
from services.core.files.arrays import as_float32, map_radiance
from services.core.raw.fullness import piled_up
from services.core.records import FolderCapture, ImageEntry, MaskBit
from services.core.store import read_record
from services.preprocess.views.flow_comparison import FlowComparison
from services.preprocess.views.source import FootprintIn, Image, LightImage, MatchedFrame, Motions, View
from services.preprocess.views.window import bands

# Largest share of the covered pixels that may be non-finite. Dead pixels are only masked, even where they are all of
# one tooth in a jaw; above this share the file is taken to be broken
NOT_FINITE_LIMIT = 0.5
NAMES_SHOWN = 3
"""Largest number of lights without an image that a note lists by name."""


class FolderSource:
    """Reader of a folder capture; everything except the pixels is checked before the first image is read."""

    measures_motion = False

    def __init__(self, root: Path, noise_relative: float, noise_floor: float) -> None:
        """Open ``root/capture.json``.

        Args:
            root: folder of the capture.
            noise_relative: standard deviation, as a fraction of a pixel's value, for images without a variance file.
            noise_floor: standard deviation, as a fraction of the image's maximum, that is added in quadrature.

        Raises:
            CaptureInputError: an entry is missing or contradicts another; the message names it.
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
        """See ``Source``. It includes every file's size and modification time, so a new export changes it."""
        lines = [self.description.model_dump_json(), repr(self._noise)]
        for entry in self._entries.values():
            for file in filter(None, (entry.file, entry.variance_file)):
                status = self._path(file).stat()
                lines.append(f"{file} {status.st_size} {status.st_mtime_ns}")
        return "\n".join(lines)

    def matched_frames(self, camera: int) -> tuple[int, ...]:  # noqa: ARG002
        """See ``Source``. Empty, because the images of a folder are assumed to show an unmoved subject."""
        return ()

    def match(
        self,
        view: View,  # noqa: ARG002
        frames: Sequence[int],  # noqa: ARG002
        footprint_in: FootprintIn,  # noqa: ARG002
    ) -> Iterator[tuple[int, MatchedFrame]]:
        """See ``Source``."""
        return iter(())

    def flow_comparison(self, view: View, motions: Motions) -> FlowComparison | None:  # noqa: ARG002
        """See ``Source``."""
        return None

    def images(self, view: View, lights: Sequence[int], motions: Motions) -> Iterator[tuple[int, LightImage]]:  # noqa: ARG002
        """See ``Source``. A variance file holds the variances of the pixel values and is used unchanged.

        Many pixels of a tooth at the largest value of a channel are taken for full ones.
        """
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
        for channel in range(radiance.shape[2]):
            if (end := piled_up(radiance[..., channel][covered & (bits == 0)], np.inf)) is not None:
                bits[radiance[..., channel] >= end] |= np.uint16(MaskBit.SATURATED)
        if broken > max(1, NOT_FINITE_LIMIT * int(np.count_nonzero(covered))):
            raise CaptureInputError(
                f"Image file {self.root / entry.file} (camera {entry.camera}, light {entry.light}) is not finite at"
                f" {broken} tooth pixels; export it again."
            )
        if variance is None:
            variance = self._assumed_variance(radiance, peak)
        for rows in bands(covered.shape):
            spread = variance[rows]
            # Flag pixels whose variance is zero or not finite, because their weight 1/variance is undefined
            usable = np.isfinite(spread) & (spread > 0)
            if not usable.all():
                bits[rows][~usable.all(axis=-1)] |= np.uint16(MaskBit.NOT_FINITE)
                spread[~np.isfinite(spread)] = 0
        return LightImage(radiance, variance, bits)

    def _assumed_variance(self, radiance: Image, peak: float) -> Image:
        """Variance (H, W, C) by the job's noise options; ``peak`` is the image's largest absolute value."""
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
        image, label = self._map(entry, file, view.number)
        return as_float32(image[view.window.rows, view.window.columns], label)

    def _map(self, entry: ImageEntry, file: str, camera: int) -> tuple[NDArray[np.floating[Any]], str]:
        label = f"Image file {self.root / file} (camera {entry.camera}, light {entry.light})"
        if Path(file).suffix.lower() != ".npy":
            raise CaptureInputError(
                f"{label} is no .npy file, the only format read here; convert it with numpy.save, linear and as"
                " float32."
            )
        width, height = self.description.cameras[camera].size
        return map_radiance(self._path(file), (height, width, len(self.description.channels)), label), label
