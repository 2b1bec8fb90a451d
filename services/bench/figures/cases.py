"""The captures and fits behind the figures, made once by ``dentine phantom`` and ``dentine run`` and kept below one
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
    """A virtual capture; its folder's name holds its options, so that others are never taken for it."""

    name: str
    options: Mapping[str, Any]
    """Of ``dentine phantom``, without their dashes; True for a switch."""

    @property
    def arguments(self) -> tuple[str, ...]:
        """As the command line takes them."""
        named = ((f"--{name}", value) for name, value in sorted(self.options.items()) if value is not False)
        return tuple(word for option, value in named for word in ((option,) if value is True else (option, str(value))))

    def rendered(self, work: Path) -> Path:
        """Its folder, rendered unless that is done."""
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
    """Those that are kept at all."""
    fitted_cameras: tuple[str, ...]
    fitted_lights: tuple[str, ...]
    """Images of these cameras under these lights are fitted, all others are held out."""
    job: Mapping[str, Any] = field(default_factory=dict)
    """Options beside the capture."""

    def fitted(self, work: Path) -> Path:
        """The job's folder, fitted unless that is done."""
        return self.fitted_with(work, {})

    def fitted_with(self, work: Path, added: Mapping[str, Array], label: str = "") -> Path:
        """The same with something added to the photographs.

        Args:
            added: radiance (H, W) by camera, added to each of its images.
            label: tells such jobs apart.
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
    """The folder of the stages and the options of a case's fit."""
    return folder / "job", read_job(folder / JOB)


def write_photographs(source: Path, target: Path, case: Case, added: Mapping[str, Array], seed: int = 1) -> None:
    """Copy a capture's images of the case's cameras, with sensor noise and what else is added, marked as fitted or held
    out.

    Raises:
        InputError: the case names a camera or light that the capture lacks, or nothing is left to fit.
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
    """Eight digits that differ where a JSON value does."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:8]


def run_dentine(*arguments: str) -> None:
    """Run the command in a process of its own, its output shown.

    Raises:
        InputError: it failed; what it said stands above.
    """
    done = subprocess.run([sys.executable, "-m", "services", *arguments], check=False)  # noqa: S603 - our own command
    if done.returncode:
        raise InputError(
            f"dentine {arguments[0]} ended with status {done.returncode} for a reason given above; remove that, and run"
            " this again."
        )
