"""Reads the description of a capture, from which the server needs the cameras, the lights and the size; images are not
read.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Protocol

from services.api.captures.contents import content_fault
from services.core.calibration.record import MAX_LIGHTS, Calibration
from services.core.errors import CaptureInputError
from services.core.geometry import Record
from services.core.raw.description import read_any_description
from services.core.raw.folder import DESCRIPTION
from services.core.settings import UploadLimits
from services.core.store import MANIFEST

MAX_DESCRIPTION_BYTES = 4 * 2**20
"""Largest description that is parsed, in bytes. Five thousand images with the longest names, under a thousand lights,
take a third of it."""
MAX_CAMERAS = 1000
"""Largest number of cameras of a capture, more than any rig has. With as many lights, a ``CaptureDescription`` stays
below a megabyte."""
_DESCRIPTION_FILES = ("capture.json", DESCRIPTION, MANIFEST, f"capture/{MANIFEST}")


class CaptureDescription(Record):
    """Cameras, lights and size of a capture."""

    calibration: Calibration
    image_px: int
    """Number of pixels of all its images together."""


class CaptureReader(Protocol):
    """Reads files that others have written, in this process or in one of bounded memory and time."""

    def content_faults(
        self, files: Sequence[tuple[Path, str]], limits: UploadLimits, names: frozenset[str]
    ) -> Iterator[tuple[str, str]]:
        """Yield the names of faulty files, each with the fault of its content; see ``contents``.

        Args:
            files: path on this machine and name in the capture of each file.
            names: names of all files of the capture.
        """

    def describe(self, capture: Path) -> CaptureDescription:
        """See ``describe``."""


class InProcessReader:
    """Reads in this process."""

    def content_faults(
        self, files: Sequence[tuple[Path, str]], limits: UploadLimits, names: frozenset[str]
    ) -> Iterator[tuple[str, str]]:
        """See ``CaptureReader``."""
        for path, name in files:
            if (fault := content_fault(path, name, limits, names)) is not None:
                yield name, fault

    def describe(self, capture: Path) -> CaptureDescription:
        """See ``describe``."""
        return describe(capture)


Describe = Callable[[Path], CaptureDescription]


def description_file(capture: Path) -> Path | None:
    """Return the file with the description of a capture, or of the one that a job holds; None if there is none."""
    return next((path for name in _DESCRIPTION_FILES if (path := capture / name).is_file()), None)


def describe(capture: Path) -> CaptureDescription:
    """Read the description of a folder capture or of a published one.

    Raises:
        CaptureInputError: the description cannot be read or is too large. CorruptStoreError: the capture was published
            and is damaged.
    """
    path = description_file(capture)
    if path is not None and (size := path.stat().st_size) > MAX_DESCRIPTION_BYTES:
        raise CaptureInputError(
            f"{path} has {size} bytes and {MAX_DESCRIPTION_BYTES} are allowed; leave out what describes no image."
        )
    description = read_any_description(capture)
    for what, count, most in (
        ("cameras", len(description.cameras), MAX_CAMERAS),
        ("lights", len(description.lights), MAX_LIGHTS),
    ):
        if count > most:
            raise CaptureInputError(
                f"{path} lists {count} {what}, more than any rig has ({most}); remove those without images."
            )
    pixels: Mapping[str, int] = {camera.name: camera.size[0] * camera.size[1] for camera in description.cameras}
    image_cameras = [image.camera for image in description.images] or [
        name for name in pixels for _ in description.lights
    ]
    calibration = Calibration.of_capture(description)
    return CaptureDescription(calibration=calibration, image_px=sum(pixels.get(name, 0) for name in image_cameras))
