"""Collects what an asset comes from when it is exported: an asset of a fit, or of a slab."""

from __future__ import annotations

import platform
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from services.core.consent import ABSENT
from services.core.provenance.inputs import stated_by
from services.core.provenance.record import SUBJECT_FILE, Inputs, Provenance
from services.core.records import JobSpec
from services.transport.numerics import NUMERICS
from services.transport.platform import import_renderer

PACKAGES = (
    "numpy",
    "scipy",
    "mitsuba",
    "drjit",
    "numba",
    "manifold3d",
    "trimesh",
    "xatlas",
    "opencv-contrib-python-headless",
    "zarr",
)
"""Packages whose version may change a number or a surface."""


def provenance_of(spec: JobSpec, job: Path, inputs: Inputs | None, now: datetime) -> Provenance:
    """What the asset of a job comes from.

    Subject and consent are those that the capture states at present, if it is still there, because a person may give or
    withdraw consent after the preparation.

    Args:
        job: the job's folder.
        inputs: what its preparation has recorded, or what a slab was fitted to; None where that was not recorded.
        now: the present, with its time zone.

    Raises:
        CaptureInputError: what the capture states cannot be read.
    """
    stated = stated_by(spec.capture) or inputs
    consent = None if stated is None else stated.consent
    seeds = {"job": spec.seed} | ({} if spec.rig is None else {"simulated cameras": spec.rig.simulation.seed})
    return Provenance(
        made=now.astimezone(UTC).isoformat(timespec="seconds"),
        job=job.resolve().name,
        subject=(None if stated is None else stated.subject) or _uploaded_subject(job),
        source=spec.capture.name if spec.capture is not None else "rig",
        versions=versions(),
        platform=machine(),
        options=options_of(spec),
        seeds=seeds,
        inputs=None if inputs is None else inputs.files,
        consent=consent,
        consent_said=ABSENT if consent is None else consent.sentence,
    )


def versions() -> dict[str, str]:
    """Versions of dentine, of its numerics, of Python, of the compiler of kernels and of the packages that compute."""
    found = {"dentine": _version("dentine"), "numerics": str(NUMERICS), "python": platform.python_version()}
    found["llvm"] = ".".join(map(str, import_renderer()[0].detail.llvm_version()))
    return found | {name: told for name in PACKAGES if (told := _version(name))}


def machine() -> str:
    """System and processor, whose vector instructions decide the last digits of a render."""
    told = f"{platform.system()} {platform.machine()}"
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
        told += next((f", {line.partition(':')[2].strip()}" for line in lines if line.startswith("model name")), "")
    return told


def options_of(spec: JobSpec) -> dict[str, Any]:
    """All options of a job as JSON values, without the folders and names of people in them."""
    told: dict[str, Any] = spec.model_dump(mode="json", exclude={"capture", "calibration", "store"})
    told |= {name: path.name for name in ("capture", "calibration") if (path := getattr(spec, name)) is not None}
    if spec.rig is not None:
        told["rig"] = spec.rig.model_dump(mode="json", exclude={"mouth", "dome", "assessment", "flashes"})
    return told


def _uploaded_subject(job: Path) -> str | None:
    file = job / SUBJECT_FILE
    return file.read_text(encoding="utf-8").strip() if file.is_file() else None


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""
