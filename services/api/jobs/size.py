"""The size of a job, from which its duration is predicted, and its method, by which jobs are compared."""

from __future__ import annotations

import json
import math
from functools import lru_cache
from pathlib import Path

from pydantic import Field

from services.api.captures.descriptions import Describe, describe, description_file
from services.core.errors import DentineError
from services.core.geometry import Record
from services.core.light.safety import FREE_FLASHES_PER_S
from services.core.records import JobSpec
from services.core.values import AUTO

DEMO_VALUES = 252_288
"""Number of values in the demonstration's images: 8 lights in 3 images of about 48 by 73 pixels, three channels."""
_METHOD = ("kind", "boundary", "dentin", "loss", "solver", "prior", "stains", "lobes", "advise", "workers", "device")
"""Options that make up the method of a job. The others change only its size, or nothing that takes time."""


class JobSize(Record):
    """Quantities from which the duration of a job is predicted."""

    pixels: int = Field(ge=1, description="values that are fitted, over all cameras, lights and channels")
    samples: int = Field(ge=1, description="paths per pixel and pass at the start")
    steps: int = Field(ge=1, description="most steps of the solver")

    @property
    def features(self) -> tuple[float, ...]:
        """Natural logarithms of the three quantities."""
        return math.log(self.pixels), math.log(self.samples), math.log(self.steps)


def size_of(spec: JobSpec, describe: Describe = describe) -> JobSize | None:
    """Return the size of a job from the description of its capture; None where the description cannot be read."""
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
    edge = 1 if spec.pixel_step == AUTO else int(spec.pixel_step)
    return JobSize(pixels=max(values // edge**2, 1), samples=spec.samples_per_pixel, steps=steps)


def method_of(spec: JobSpec) -> str:
    """Return a text that is the same for jobs of the same method."""
    captures: bool | str = spec.rig is not None
    if spec.rig is not None and not spec.rig.is_simulated:  # a real dome's flashes take most of its capture
        per_s = FREE_FLASHES_PER_S if spec.rig.flashes is None else spec.rig.flashes.per_s
        captures = f"{per_s:g} flashes a second"
    return json.dumps(spec.model_dump(mode="json", include=set(_METHOD)) | {"captures": captures}, sort_keys=True)


@lru_cache(maxsize=256)
def _images(describe: Describe, folder: Path, _version: tuple[Path, int]) -> tuple[int, int]:
    """Return the pixels of all images together, and the number of channels. The result is cached as long as the
    description has the same file and time of change (``_version``).
    """
    found = describe(folder)
    return found.image_px, len(found.calibration.channels)
