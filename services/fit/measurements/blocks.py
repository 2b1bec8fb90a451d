"""Input files of a fit's tasks, small enough for every worker to read: scene recipes and blocks of measurements.

The files hold no pickles. A job writes them once, at its start; they fix the block partition and the order of summation
for the life of the job.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.files.content_files import StoredFile, write_arrays
from services.core.geometry import Camera
from services.transport.optics.parameters import Mouth, Tissue
from services.transport.scene.recipe import View

Array = NDArray[np.float64]

BLOCK_BYTES = 4 * 2**20
"""Largest residual block that travels between tasks, in bytes: mean and variance, float64."""
BLOCK_PIXELS = 4096
"""Largest number of pixels in a block: enough to fill a kernel, and few enough that a lost worker costs little."""
MIN_BLOCKS = 4
"""Least number of blocks of all views together, so that two workers have enough to do; fewer where there are too few
pixels."""
MIN_BLOCK_PIXELS = 64
"""Least number of pixels for which a block is split: a smaller block would not fill a kernel. With one block for each
of three views two workers were busy for 78 % of a fit."""


GUMS, CAVITY = -1, -2
"""Codes of pixels that show no tooth but gums or oral cavity."""


@dataclass(frozen=True)
class PixelParts:
    """Part of a jaw that each pixel shows; arrays (N,)."""

    shown: NDArray[np.int16]
    """Position of the tooth among the scene's, or GUMS or CAVITY."""
    tooth: NDArray[np.int16]
    """Position of the nearest tooth: the one that is shown, if any is."""

    def of(self, pixels: NDArray[Any]) -> PixelParts:
        """The parts of some pixels, by index or mask."""
        return PixelParts(self.shown[pixels], self.tooth[pixels])


@dataclass(frozen=True)
class BlockInstrument:
    """Names of the instrument's errors that act on a block's photographs."""

    gain: str
    lights: tuple[str, ...]
    """One error for each of the block's lights."""
    flare: str
    brightest: float
    """Largest radiance among the camera's valid pixels in this channel; a flare is given as a share of it."""
    shifts: tuple[str, ...] = ()
    """Name of the shift of each light's photograph, '' where it stands still; empty where all do."""


@dataclass(frozen=True)
class BlockMotion:
    """How photographs change where the scan moves, or where a photograph itself is shifted."""

    slopes: Array
    """Slopes (2, L, N) of the photographs along x and y, per pixel."""
    slope_noise: Array
    """Variance (2, L, N) of each slope, in variances of the photograph."""
    displacement: Array
    """Displacement (6, 2, N), in px, of what each pixel shows by each coordinate of the scan's pose, per rad and per
    mm (``instrument.pose``)."""
    brightening: Array
    """Relative change (6, L, N) of the irradiance by each coordinate."""
    centre_mm: Array
    """Point (3,) about which the scan turns."""

    def of(self, lights: NDArray[np.bool_], pixels: NDArray[Any]) -> BlockMotion:
        """The changes of some pixels, by index or mask, under the lights of a mask (L,)."""
        return BlockMotion(
            self.slopes[:, lights][:, :, pixels],
            self.slope_noise[:, lights][:, :, pixels],
            self.displacement[:, :, pixels],
            self.brightening[:, lights][:, :, pixels],
            self.centre_mm,
        )


@dataclass(frozen=True)
class PixelBlock:
    """Measurements of some pixels of one view; arrays over (light, pixel) are (L, N)."""

    view: View
    reference: Array
    variance: Array
    fit_weight: Array
    """Weight in the fitted loss, 1/variance units; 0 where masked or held out."""
    held_out: NDArray[np.bool_]
    """Mask (L, N) of valid measurements that are held out of the fit."""
    parts: PixelParts | None = None
    """Parts of a jaw that the pixels show; None where the scene is one tooth."""
    cell: NDArray[np.int32] | None = None
    """Index (N,) of the cell of each pixel, within which losses are compared as means; None where each pixel stands
    alone."""
    instrument: BlockInstrument | None = None
    """The instrument's errors; None where the instrument counts as exact."""
    motion: BlockMotion | None = None
    """Changes by moves; None where the fit estimates none."""
    functions: Array | None = None
    """Smooth functions (K, N) of the pixel that derivatives to the media follow (``normal_equations.smoothed``); None
    where derivatives are taken pixel by pixel."""

    @property
    def fitted_view(self) -> View:
        """The view without the lights under which no pixel is fitted; these are not rendered."""
        return self.view_under(np.any(self.fit_weight > 0, axis=1))

    def view_under(self, lights: NDArray[np.bool_]) -> View:
        """The view under the lights of the mask (L,); under all lights where the mask is empty."""
        return (
            replace(self.view, lights=tuple(np.flatnonzero(lights).tolist()))
            if lights.any() and not lights.all()
            else self.view
        )


@dataclass(frozen=True)
class BlockTask:
    """Common arguments of every task on a block."""

    block: StoredFile
    index: int
    recipe: StoredFile
    step: str
    tissue: Tissue | Mouth
    samples: int
    errors: tuple[tuple[str, float], ...] = ()
    """Errors of the instrument, by name, which are applied to renders before they are compared."""


def pixels_per_block(lights: int) -> int:
    """Number of pixels whose residuals under all lights stay within ``BLOCK_BYTES``."""
    return max(1, min(BLOCK_PIXELS, BLOCK_BYTES // (16 * lights)))


def split_pixels(pixels: NDArray[np.int64], lights: int, views: int) -> list[NDArray[np.int64]]:
    """Pixels of a view split into blocks, each of which one worker renders at a time.

    There are enough blocks for two workers, none too small to fill a kernel and none too large to travel; the partition
    does not depend on the number of workers.
    """
    preferred = min(-(-MIN_BLOCKS // views), max(1, len(pixels) // MIN_BLOCK_PIXELS))
    return np.array_split(pixels, max(preferred, -(-len(pixels) // pixels_per_block(lights))))


def write_block(folder: Path, block: PixelBlock) -> StoredFile:
    """Store a block in ``folder``."""
    parts = {} if block.parts is None else {"shown": block.parts.shown, "tooth": block.parts.tooth}
    instrument: dict[str, NDArray[Any]] = {}
    if (errors := block.instrument) is not None:
        instrument = {
            "error_names": np.array([errors.gain, errors.flare, *errors.lights]),
            "shift_names": np.array(errors.shifts, dtype=np.str_),
            "brightest": np.array(errors.brightest),
        }
    motion: dict[str, NDArray[Any]] = {}
    if (moved := block.motion) is not None:
        motion = {
            "slopes": moved.slopes.astype(np.float32),
            "slope_noise": moved.slope_noise.astype(np.float16),
            "displacement": moved.displacement.astype(np.float32),
            "brightening": moved.brightening.astype(np.float16),
            "centre_mm": moved.centre_mm,
        }
    return write_arrays(
        folder,
        "block",
        camera=np.frombuffer(block.view.camera.model_dump_json().encode(), dtype=np.uint8),
        pixels=block.view.pixels,
        reference=block.reference,
        variance=block.variance,
        fit_weight=block.fit_weight,
        held_out=block.held_out,
        **parts,
        **({} if block.cell is None else {"cell": block.cell}),
        **({} if block.functions is None else {"functions": block.functions.astype(np.float32)}),
        **instrument,
        **motion,
    )


def read_block(stored: StoredFile) -> PixelBlock:
    """Read a block."""
    a = stored.load()
    camera = Camera.model_validate_json(a["camera"].tobytes())
    view = View(camera, a["pixels"].astype(np.int32))
    parts = PixelParts(a["shown"].astype(np.int16), a["tooth"].astype(np.int16)) if "shown" in a else None
    cell = a["cell"].astype(np.int32) if "cell" in a else None
    instrument = None
    if "error_names" in a:
        gain, flare, *lights = map(str, a["error_names"])
        shifts = tuple(map(str, a["shift_names"])) if "shift_names" in a else ()
        instrument = BlockInstrument(gain, tuple(lights), flare, float(np.asarray(a["brightest"], dtype=float)), shifts)
    motion = None
    if "slopes" in a:
        names = "slopes", "slope_noise", "displacement", "brightening", "centre_mm"
        motion = BlockMotion(*(a[name].astype(float) for name in names))
    return PixelBlock(
        view,
        a["reference"].astype(float),
        a["variance"].astype(float),
        a["fit_weight"].astype(float),
        a["held_out"].astype(bool),
        parts,
        cell,
        instrument,
        motion,
        a["functions"].astype(float) if "functions" in a else None,
    )
