"""How large a job is, as far as its time goes, and which jobs do the same to something of another size."""

from __future__ import annotations

import json
import math
from functools import lru_cache
from pathlib import Path

from pydantic import Field

from services.core.errors import StoreError
from services.core.geometry import Record
from services.core.records import CaptureManifest, FolderCapture, JobSpec
from services.core.store import MANIFEST, open_stage

LARGEST_DESCRIPTION_BYTES = 64 * 2**20
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


def size_of(spec: JobSpec) -> JobSize | None:
    """Size of a job from the description of its capture; None where that cannot be read."""
    if spec.is_demo:
        return _sized(spec, DEMO_VALUES)
    try:
        path = _description(spec)
        if path is None:
            return None
        images_px, channels = _images(path, path.stat().st_mtime_ns)
    except (OSError, ValueError, KeyError, StoreError):
        return None
    return _sized(spec, images_px * (channels if spec.channels is None else len(spec.channels)))


def _sized(spec: JobSpec, values: int) -> JobSize:
    steps = spec.adam_steps if spec.solver == "adam" else spec.max_steps
    return JobSize(pixels=max(values // spec.pixel_step**2, 1), samples=spec.samples_per_pixel, steps=steps)


def method_of(spec: JobSpec) -> str:
    """The same text for jobs that do the same."""
    return json.dumps(spec.model_dump(mode="json", include=set(_METHOD)) | {"captures": spec.rig is not None}, sort_keys=True)


def _description(spec: JobSpec) -> Path | None:
    folder = spec.rig.mouth if spec.rig is not None else spec.capture
    places = [] if folder is None else [folder / "capture.json", folder / MANIFEST, folder / "capture" / MANIFEST]
    return next((path for path in places if path.is_file() and path.stat().st_size <= LARGEST_DESCRIPTION_BYTES), None)


@lru_cache(maxsize=256)
def _images(path: Path, _changed_ns: int) -> tuple[int, int]:
    """Pixels of all images together, and channels."""
    if path.name == MANIFEST:
        description = open_stage(path.parent.parent, path.parent.name, CaptureManifest, verify=False)[1].description
    else:
        description = FolderCapture.model_validate_json(path.read_bytes())
    pixels = {camera.name: camera.size[0] * camera.size[1] for camera in description.cameras}
    seen = [image.camera for image in description.images] or [name for name in pixels for _ in description.lights]
    return sum(pixels[name] for name in seen), len(description.channels)
