"""Number of rows of a photograph that are processed at once, so that a process stays within its memory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from services.core.errors import SettingsError
from services.core.raw.records import RawCamera
from services.preprocess.views.window import Window

GIB = 2**30
PROCESS_BYTES = 400 * 2**20
"""Bytes of an interpreter with its libraries, and of a scan."""
MOTION_BYTES = 13
"""Bytes per pixel of the region for relief and outline of the moving bodies, and for the map of the lens."""
FOOTPRINT_BYTES = 19
"""Bytes per pixel of the view for the footprint, which is mapped from its file."""
MASKING_BYTES = 48
"""Bytes per pixel of the view while masks are made or arrays are compressed for storage."""
FLOAT_BYTES = 4
EXPOSURE_VALUES = 2
"""Number of float32 values per count of each exposure: signal and headroom."""
MERGED_VALUES = 12
"""Number of further float32 values per count while exposures are merged, for all exposures together."""
COLOUR_VALUES = 34
"""Number of further float32 values per pixel while channels are demosaiced or concatenated, and interpolated."""
OVERLAP_ROWS = 64
"""Number of rows that a strip needs besides its own, for the filters' support and a rotation by one degree over 3600
columns."""
MIN_ROWS = 64
"""Smallest height of a strip, rows. Lower strips would read more overlap than rows of their own."""


@dataclass(frozen=True)
class MemoryBudget:
    """Memory that one image of a raw camera takes.

    Attributes:
        memory_bytes: upper limit for the process.
        camera: description of the camera.
        channels: number of channels of the images.
        window: window of the view.
        region: part of the photograph from which the view is made.
    """

    memory_bytes: float
    camera: RawCamera
    channels: int
    window: Window
    region: Window

    def rows(self, exposures: int) -> int:
        """Number of rows of the view to process at once.

        Args:
            exposures: number of exposures of one light.

        Raises:
            SettingsError: even the smallest strip takes too much memory.
        """
        height = self.window.shape[0]
        free = self.memory_bytes - self._held_bytes(exposures) - self._read_bytes(exposures)
        rows = int(min(free / self._row_bytes(exposures) - OVERLAP_ROWS, height))
        if rows < min(MIN_ROWS, height) or self.peak_bytes(exposures, rows) > self.memory_bytes:
            need = self.peak_bytes(exposures, min(MIN_ROWS, height)) / GIB
            raise SettingsError(
                f"An image of camera {self.camera.name} takes {need:.2f} GiB of memory, and option 'memory_gib' leaves "
                f"{self.memory_bytes / GIB:.2f} to each thread of a worker; raise it, or give workers fewer threads."
            )
        return rows

    def peak_bytes(self, exposures: int, rows: int) -> float:
        """Largest memory in bytes while an image is made in strips of ``rows`` rows, and then masked and stored."""
        made = self._read_bytes(exposures) + (rows + OVERLAP_ROWS) * self._row_bytes(exposures)
        return self._held_bytes(exposures) + max(made, MASKING_BYTES * _pixels(self.window))

    def _held_bytes(self, exposures: int) -> float:
        """Bytes held throughout: process, footprint and motion of the view, black images, and the image being made."""
        image = 2 * FLOAT_BYTES * self.channels + 2
        black = FLOAT_BYTES * exposures * self._sites
        view = (image + FOOTPRINT_BYTES) * _pixels(self.window)
        return PROCESS_BYTES + view + (black + MOTION_BYTES) * _pixels(self.region)

    def _read_bytes(self, exposures: int) -> float:
        """Bytes of the counts of all exposures while the last of them is decoded."""
        width, height = self.camera.size
        return self._count_bytes * self._sites * (exposures * _pixels(self.region) + 2 * width * height)

    def _row_bytes(self, exposures: int) -> float:
        """Bytes of one row of the photograph while it is converted to a row of the view."""
        merged = self._sites * (EXPOSURE_VALUES * exposures + MERGED_VALUES)
        return FLOAT_BYTES * (merged + COLOUR_VALUES) * self.region.shape[1]

    @property
    def _sites(self) -> int:
        return self.channels if self.camera.mosaic == "none" else 1

    @property
    def _count_bytes(self) -> int:
        return 2 if self.camera.full_counts is not None else FLOAT_BYTES


def _pixels(window: Window) -> int:
    return window.shape[0] * window.shape[1]


def strips(height: int, rows: int) -> Iterator[slice]:
    """Split ``height`` rows into slices of ``rows`` rows."""
    for top in range(0, height, rows):
        yield slice(top, min(top + rows, height))
