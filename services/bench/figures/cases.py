"""Captures and fits that the figures show, made once by ``dentine phantom`` and ``dentine run`` and kept below one
folder.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.bench.fits.tooth_capture import write_photograph
from services.core.errors import InputError
from services.core.records import FolderCapture, JobSpec
from services.core.settings import read_job
from services.core.store import read_record, write_record

Array = NDArray[np.float64]
JOB = "job.toml"


@dataclass(frozen=True)
class Capture:
    """A virtual capture. Its folder's name contains a fingerprint of its options, so that a capture with other options
    is never used in its place.
    """

    name: str
    options: Mapping[str, Any]
    """Options of ``dentine phantom`` without their leading dashes; True for a switch."""

    @property
    def arguments(self) -> tuple[str, ...]:
        """The options as arguments of the command line."""
        named = ((f"--{name}", value) for name, value in sorted(self.options.items()) if value is not False)
        return tuple(word for option, value in named for word in ((option,) if value is True else (option, str(value))))

    def rendered(self, work: Path) -> Path:
        """Return the capture's folder below ``work``, and render it if it does not exist."""
        folder = work / f"capture-{self.name}-{fingerprint(self.arguments)}"
        if not (folder / "capture.json").is_file():
            run_dentine("phantom", "--out", str(folder), *self.arguments)
        return folder


@dataclass(frozen=True)
class Case:
    """A fit of some images of a capture."""

    name: str
    capture: Capture
    cameras: tuple[str, ...]
    """Cameras whose images are kept, fitted or held out."""
    fitted_cameras: tuple[str, ...]
    fitted_lights: tuple[str, ...]
    """Images of the fitted cameras under these lights are fitted, all others are held out."""
    job: Mapping[str, Any] = field(default_factory=dict)
    """Options of the job other than the capture."""

    def fitted(self, work: Path) -> Path:
        """Return the job's folder below ``work``, and run the fit if it is not finished."""
        return self.fitted_with(work, {})

    def fitted_with(self, work: Path, added: Mapping[str, Array], label: str = "") -> Path:
        """Return the folder of the job with radiance added to the photographs, and run the fit if it is not finished.

        Args:
            work: folder of all captures and fits.
            added: radiance (H, W) by camera, added to each of its images.
            label: part of the folder's name that distinguishes such jobs.
        """
        source = self.capture.rendered(work)
        options = {"capture": "capture", **self.job}
        chosen = (source.name, self.cameras, self.fitted_cameras, self.fitted_lights, options)
        folder = work / f"fit-{self.name}{label}-{fingerprint(chosen)}"
        if not (folder / JOB).is_file():
            write_photographs(source, folder / "capture", self, added)
            (folder / JOB).write_text("".join(f"{name} = {json.dumps(value)}\n" for name, value in options.items()))
        run_dentine("run", str(folder / JOB), "--out", str(folder / "job"))
        return folder

    def is_fitted(self, camera: str, light: str) -> bool:
        """Whether the fit may use an image."""
        return camera in self.fitted_cameras and light in self.fitted_lights


def job_of(folder: Path) -> tuple[Path, JobSpec]:
    """Return the folder of the stages of a case's fit, and the fit's options."""
    return folder / "job", read_job(folder / JOB)


def write_photographs(source: Path, target: Path, case: Case, added: Mapping[str, Array], seed: int = 1) -> None:
    """Copy a capture's images of the case's cameras, with sensor noise and added radiance, each marked as fitted or
    held out.

    Args:
        source: folder of the capture.
        target: folder to write, replaced if it exists.
        case: the case.
        added: radiance (H, W) by camera, added to each of its images.
        seed: seed of the sensor noise.

    Raises:
        InputError: the case names a camera or light that the capture lacks, or holds all images out.
    """
    description = read_record(source / "capture.json", FolderCapture)
    for kind, wanted, known in (
        ("camera", case.cameras, description.cameras),
        ("light", case.fitted_lights, description.lights),
    ):
        for name in wanted:
            if name not in {one.name for one in known}:
                raise InputError(
                    f"Figure's fit {case.name} names {kind} {name}, which its capture does not have; it has"
                    f" {len(known)}."
                )
    images = [
        image.model_copy(update={"held_out": not case.is_fitted(image.camera, image.light)})
        for image in description.images
        if image.camera in case.cameras
    ]
    if all(image.held_out for image in images):
        raise InputError(f"Figure's fit {case.name} holds every image out; name cameras and lights to fit.")
    random = np.random.default_rng(seed)
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(source / "teeth", target / "teeth")
    for name in ("gums.ply", "cavity.ply"):
        if (source / name).is_file():
            shutil.copyfile(source / name, target / name)
    for image in images:
        assert image.variance_file is not None
        more = added[image.camera][..., None] if image.camera in added else 0.0
        write_photograph(source, target, (image.file, image.variance_file), random, more)
    cameras = tuple(camera for camera in description.cameras if camera.name in case.cameras)
    write_record(target / "capture.json", description.model_copy(update={"cameras": cameras, "images": tuple(images)}))


def fingerprint(value: object) -> str:
    """Return eight hexadecimal digits of the hash of a JSON value."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:8]


def run_dentine(*arguments: str) -> None:
    """Run ``dentine`` with these arguments in a process of its own, and show its output.

    Raises:
        InputError: the command failed; the reason is in its output.
    """
    done = subprocess.run([sys.executable, "-m", "services", *arguments], check=False)  # noqa: S603 - our own command
    if done.returncode:
        raise InputError(
            f"dentine {arguments[0]} ended with status {done.returncode} for a reason given above; remove that, and run"
            " this again."
        )
