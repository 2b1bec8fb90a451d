"""How many rows of a photograph are worked on at once, so that a process keeps within its memory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from services.core.errors import SettingsError
from services.core.raw.records import RawCamera
from services.preprocess.window import Window

GIB = 2**30
PROCESS_BYTES = 400 * 2**20
"""Of an interpreter with its libraries, and of a scan."""
MOTION_BYTES = 13
"""For each pixel of the region: relief and outline of what moves, and where the lens takes it from."""
SHOWN_BYTES = 19
"""For each pixel of the view: the footprint, mapped from its file."""
JUDGED_BYTES = 48
"""And what masks are made of, or what is compressed to be stored."""
FLOAT_BYTES = 4
EXPOSURE_VALUES = 2
"""Single-precision numbers of a count: signal and headroom."""
MERGED_VALUES = 12
"""And while exposures are merged, all together."""
COLOUR_VALUES = 34
"""And of a pixel while a mosaic's channels are filled in, or colours are put together, and interpolated."""
OVERLAP_ROWS = 64
"""Rows that a strip needs besides its own: what filters look at, and a rotation by a degree of 3600 columns."""
MIN_ROWS = 64
"""Lower strips would read more rows for others than for themselves."""


@dataclass(frozen=True)
class Room:
    """What one image of a raw camera takes.

    Attributes:
        memory_bytes: most that the process may take.
        channels: of the images.
        window: of the view. region: of the photograph that it is made of.
    """

    memory_bytes: float
    camera: RawCamera
    channels: int
    window: Window
    region: Window

    def rows(self, exposures: int) -> int:
        """Rows of the view to work on at once.

        Args:
            exposures: of one light.

        Raises:
            SettingsError: even the fewest take too much.
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
        """Most that is taken while an image is made so many rows at a time, and then judged and stored."""
        made = self._read_bytes(exposures) + (rows + OVERLAP_ROWS) * self._row_bytes(exposures)
        return self._held_bytes(exposures) + max(made, JUDGED_BYTES * _pixels(self.window))

    def _held_bytes(self, exposures: int) -> float:
        """The process, what is known of the view, black images, and the image that is made."""
        image = 2 * FLOAT_BYTES * self.channels + 2
        black = FLOAT_BYTES * exposures * self._sites
        view = (image + SHOWN_BYTES) * _pixels(self.window)
        return PROCESS_BYTES + view + (black + MOTION_BYTES) * _pixels(self.region)

    def _read_bytes(self, exposures: int) -> float:
        """Counts of all exposures, while the last of them is decoded."""
        width, height = self.camera.size
        return self._count_bytes * self._sites * (exposures * _pixels(self.region) + 2 * width * height)

    def _row_bytes(self, exposures: int) -> float:
        """One row of the photograph, while it becomes one of the view."""
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
    """Rows of an image of so many, as many at a time as are given."""
    for top in range(0, height, rows):
        yield slice(top, min(top + rows, height))
