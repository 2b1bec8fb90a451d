"""How large a job is, as far as its time goes, and which jobs do the same to something of another size."""

from __future__ import annotations

import json
import math
from functools import lru_cache
from pathlib import Path

from pydantic import Field

from services.api.captures.descriptions import Describe, describe, description_file
from services.core.errors import DentineError
from services.core.geometry import Record
from services.core.records import JobSpec

DEMO_VALUES = 16_896
"""Of the demonstration: 8 lights in 3 images of about 21 by 33 pixels, one channel."""
_METHOD = ("kind", "boundary", "dentin", "loss", "solver", "prior", "stains", "lobes", "advise", "workers", "device")
"""Options that change what is done; the others change how much of it, or nothing that lasts."""


class JobSize(Record):
    """What a job's time is predicted from."""

    pixels: int = Field(ge=1, description="values that are fitted, over all cameras, lights and channels")
    samples: int = Field(ge=1, description="paths per pixel and pass at the start")
    steps: int = Field(ge=1, description="most steps of the solver")

    @property
    def features(self) -> tuple[float, ...]:
        """Logarithms."""
        return math.log(self.pixels), math.log(self.samples), math.log(self.steps)


def size_of(spec: JobSpec, describe: Describe = describe) -> JobSize | None:
    """Size of a job from the description of its capture; None where that cannot be read."""
    if spec.is_demo:
        return _sized(spec, DEMO_VALUES)
    try:
        folder = spec.rig.mouth if spec.rig is not None else spec.capture
        path = description_file(folder) if folder is not None else None
        if path is None or folder is None:
            return None
        images_px, channels = _images(describe, folder, (path, path.stat().st_mtime_ns))
    except (OSError, DentineError):
        return None
    return _sized(spec, images_px * (channels if spec.channels is None else len(spec.channels)))


def _sized(spec: JobSpec, values: int) -> JobSize:
    steps = spec.adam_steps if spec.solver == "adam" else spec.max_steps
    return JobSize(pixels=max(values // spec.pixel_step**2, 1), samples=spec.samples_per_pixel, steps=steps)


def method_of(spec: JobSpec) -> str:
    """The same text for jobs that do the same."""
    return json.dumps(
        spec.model_dump(mode="json", include=set(_METHOD)) | {"captures": spec.rig is not None}, sort_keys=True
    )


@lru_cache(maxsize=256)
def _images(describe: Describe, folder: Path, _version: tuple[Path, int]) -> tuple[int, int]:
    """Pixels of all images together, and channels; known of a description whose file and time of change are the
    same.
    """
    found = describe(folder)
    return found.image_px, len(found.calibration.channels)
