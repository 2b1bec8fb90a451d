"""Use cases of the masks of a job that are drawn by hand."""

from __future__ import annotations

import hashlib
import threading
from pathlib import Path

import numpy as np
from pydantic import Field

from services.api.jobs.jobs import Jobs
from services.api.jobs.records import Job
from services.api.masks.images import picture_of, require_mask
from services.api.tables.lifecycle import JobState
from services.client.errors import JobStateError, MaskError, UnknownMaskError
from services.core.calibration.record import Calibration
from services.core.files.image_metadata import plain_png
from services.core.geometry import Camera, Record
from services.core.masks import ALL_LIGHTS, LONGEST_NAME, is_stale, mask_path, read_masks
from services.core.results import PreparedManifest
from services.core.store import StoredArray, is_published, open_stage, write_atomic

MAX_PREPARED_PX = 2**26
"""Largest number of pixels of a camera whose prepared mask is shown: 67 million, more than any camera of a dome has.
Encoding takes some 5 bytes of memory a pixel."""
_AT_WORK = frozenset({JobState.RUNNING, JobState.CANCELLING, JobState.DELETING})


class Mask(Record):
    """A mask by hand as it is listed."""

    camera: str
    light: str = Field(description="'all' for every light of the camera")
    bytes: int
    sha256: str


class MaskList(Record):
    """A job's masks by hand."""

    masks: tuple[Mask, ...]
    is_stale: bool = Field(
        description="whether what the job has prepared was prepared with other masks; a retry prepares and fits again"
    )


class Masks:
    """Use cases of masks over the jobs of a server."""

    def __init__(self, jobs: Jobs) -> None:
        self._jobs = jobs
        self._drawing = threading.Lock()  # one picture in memory at a time

    def list(self, job: Job) -> MaskList:
        """Return a job's masks by hand."""
        root = self._jobs.present_folder(job.id)
        masks = tuple(
            Mask(camera=camera, light=light, bytes=len(content), sha256=hashlib.sha256(content).hexdigest())
            for (camera, light), content in read_masks(root).items()
        )
        return MaskList(masks=masks, is_stale=is_stale(root))

    def get(self, job: Job, camera: str, light: str) -> Path:
        """Return the file of a mask by hand.

        Raises:
            UnknownMaskError: there is none.
        """
        path = mask_path(self._jobs.present_folder(job.id), camera, light)
        if len(path.name) > LONGEST_NAME or not path.is_file():
            raise UnknownMaskError(
                f"The job has no mask by hand of camera {camera} and light {light}; list its masks to see which there"
                " are."
            )
        return path

    def put(self, job: Job, camera: str, light: str, content: bytes) -> None:
        """Store a mask, without its metadata, in place of an earlier one.

        Raises:
            MaskError: the content is no mask of this camera. UnknownMaskError: there is no such camera or light.
                JobStateError: the job is at work.
        """
        require_mask(content, self._camera(job, camera, light))
        self._require_idle(job)
        path = mask_path(self._jobs.present_folder(job.id), camera, light)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, plain_png(content))

    def delete(self, job: Job, camera: str, light: str) -> None:
        """Remove a mask.

        Raises:
            UnknownMaskError: there is none. JobStateError: the job is at work.
        """
        self._require_idle(job)
        self.get(job, camera, light).unlink()

    def prepared(self, job: Job, camera: str, light: str) -> bytes:
        """Return a PNG with the bits of ``MaskBit`` that the preparation has set, 0 where the fit may use the pixel.

        Raises:
            UnknownMaskError: nothing is prepared, or there is no such camera or light. MaskError: the camera has too
                many pixels.
        """
        root = self._jobs.present_folder(job.id)
        if not is_published(root, "prepared"):
            raise UnknownMaskError(f"Job {job.id} has prepared nothing yet; wait for its stage prepare.")
        folder, manifest = open_stage(root, "prepared", PreparedManifest, verify=False)
        cameras, lights = [one.name for one in manifest.cameras], [one.name for one in manifest.lights]
        if camera not in cameras or light not in lights:
            raise UnknownMaskError(
                f"Job {job.id} has prepared no camera {camera} under light {light}; it has {', '.join(cameras)} and"
                f" {', '.join(lights)}."
            )
        width, height = manifest.cameras[cameras.index(camera)].size
        if width * height > MAX_PREPARED_PX:
            raise MaskError(
                f"Camera {camera} has {width} x {height} pixels, and prepared masks of up to {MAX_PREPARED_PX} are"
                " shown; bin its images."
            )
        with self._drawing:
            valid = StoredArray(folder / "prepared.zarr" / "valid")
            return picture_of(valid[cameras.index(camera), lights.index(light), :height, :width].astype(np.uint8))

    def _camera(self, job: Job, camera: str, light: str) -> Camera:
        description = self._calibration(job)
        found = next((one for one in description.cameras if one.name == camera), None)
        lights = [one.name for one in description.lights]
        if found is None or light not in {*lights, ALL_LIGHTS}:
            cameras = ", ".join(one.name for one in description.cameras)
            raise UnknownMaskError(
                f"The job's capture has no camera {camera} with light {light}; it has {cameras} and"
                f" {', '.join(lights)}, or '{ALL_LIGHTS}'."
            )
        if len(mask_path(Path(), camera, light).name) > LONGEST_NAME:
            raise UnknownMaskError(
                f"The names of camera {camera} and light {light} are too long for a mask; shorten them in the capture."
            )
        return found

    def _calibration(self, job: Job) -> Calibration:
        spec, root = self._jobs.locate(job.spec), self._jobs.present_folder(job.id)
        if spec.capture is not None:
            return self._jobs.reader.describe(spec.capture).calibration
        assert spec.rig is not None
        return self._jobs.reader.describe(root if is_published(root, "capture") else spec.rig.mouth).calibration

    def _require_idle(self, job: Job) -> None:
        if (state := self._jobs.repository.get(job.id).state) in _AT_WORK:
            raise JobStateError(f"Job {job.id} is {state}; wait for it or cancel it, then change its masks.")
