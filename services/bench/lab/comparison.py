"""Comparison of the chain's result with the truth and with the result of perfect calibration and pose. Only this module
and ``known`` read the truth.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.bench.lab.chain import JOB
from services.bench.lab.known import session_from_scan, true_calibration
from services.core.calibration.record import Calibration
from services.core.geometry import Record
from services.core.raw.registration import REGISTRATION, Registration
from services.core.store import read_record
from services.phantom.lab.make import CALIBRATION, CALIBRATION_FILE, LAB_RECORD, MOUTH, TRUTH, LabRecord

Floats = NDArray[np.float64]
QUANTITIES = tuple(f"{part}.{name}" for part in ("enamel", "dentin") for name in ("sigma_s_reduced", "sigma_a"))
MAX_ERROR_RATIO, MAX_Z, MAX_SE_RATIO = 1.3, 3.0, 3.0
"""Limits of the chain: of the ratio of its held-out error to that with perfect calibration and pose, of a value's
distance from the truth in standard errors, and of the ratio of a standard error to that with perfect calibration and
pose."""


class Measured(Record):
    """Estimate of one quantity of one medium, with its standard error and its truth."""

    value: float
    se: float
    truth: float

    @property
    def z(self) -> float:
        """Signed distance from the truth in standard errors."""
        return (self.value - self.truth) / self.se


class Outcome(Record):
    """Result of a fit: relative errors on held-out and on fitted images, and the quantities of the media, per mm."""

    held_out_error: float
    fit_error: float
    converged: bool
    media: dict[str, Measured]


class StepErrors(Record):
    """Errors of calibration and registration against the truth."""

    teeth_mm: float
    """Error of the teeth's centre in the frame of the calibration session."""
    teeth_deg: float
    """Error of the teeth's rotation."""
    lights_mm: float
    """Root mean square over the lights of the error of the position."""
    lights_deg: float
    """Root mean square over the lights of the error of the direction, seen from the teeth."""
    intensity: float
    """Root mean square over lights and channels of the relative error of the intensity."""
    radiance: float
    """Root mean square over cameras and channels of the relative error of the radiance per count."""


def outcome(root: Path, job: Path, channel: str = "green") -> Outcome:
    """Return the result of a job, with the truth of its laboratory."""
    truth = read_record(root / TRUTH / LAB_RECORD, LabRecord).media[channel]
    table = json.loads((job / "parameters.json").read_text())[channel]
    errors = json.loads((job / "errors.json").read_text())
    media = {
        name: Measured(value=table[name]["value"], se=table[name]["se"], truth=_true(truth, name))
        for name in QUANTITIES
    }
    return Outcome(
        held_out_error=errors["held_out_error"][channel],
        fit_error=errors["fit_error"][channel],
        converged=errors["converged"],
        media=media,
    )


def step_errors(root: Path) -> StepErrors:
    """Return the errors of calibration and pose against the truth, in the frame of the calibration session."""
    found, true = read_record(root / CALIBRATION / CALIBRATION_FILE, Calibration), true_calibration(root)
    registration = read_record(root / MOUTH / REGISTRATION, Registration)
    pose, actual = np.array(registration.rig_from_scan), session_from_scan(root)
    centre = np.array(registration.centre_mm)
    true_centre = (actual @ np.linalg.inv(pose) @ [*centre, 1.0])[:3]
    rotation = actual[:3, :3] @ pose[:3, :3].T
    lights = {light.name: light for light in true.lights}
    positions = [(np.array(one.position_mm), np.array(lights[one.name].position_mm)) for one in found.lights]
    off = np.array([np.linalg.norm(one - two) for one, two in positions])
    angle = [_angle_deg(one - centre, two - centre) for one, two in positions]
    ratios = np.log([np.array(light.intensity) / np.array(lights[light.name].intensity) for light in found.lights])
    counts = np.log(
        [
            np.array(one.radiance_per_count) / np.array(two.radiance_per_count)
            for one, two in zip(found.cameras, true.cameras, strict=True)
        ]
    )
    return StepErrors(
        teeth_mm=float(np.linalg.norm(true_centre - centre)),
        teeth_deg=float(np.degrees(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1)))),
        lights_mm=_rms(off),
        lights_deg=_rms(np.array(angle)),
        intensity=_rms(ratios),
        radiance=_rms(counts),
    )


def verdict(chain: Outcome, perfect: Outcome) -> dict[str, tuple[float, float, bool]]:
    """Return the requirements on the chain by name: value, limit, and whether the limit is kept."""
    found = {
        "held-out error over that with perfect calibration and pose": (
            chain.held_out_error / perfect.held_out_error,
            MAX_ERROR_RATIO,
        )
    }
    for name in QUANTITIES:
        found[f"{name}: distance from the truth in standard errors"] = (abs(chain.media[name].z), MAX_Z)
        found[f"{name}: ± over that with perfect calibration and pose"] = (
            chain.media[name].se / perfect.media[name].se,
            MAX_SE_RATIO,
        )
    return {what: (value, limit, value <= limit) for what, (value, limit) in found.items()}


def summary(root: Path, jobs: Mapping[str, Path]) -> dict[str, Any]:
    """Return all results of a chain as plain values.

    Args:
        root: folder of the laboratory.
        jobs: folders of the jobs of the variants that were run, by the variant's name.
    """
    chain = outcome(root, root / JOB)
    results: dict[str, Any] = {"chain": _plain(chain), "steps": step_errors(root).model_dump()}
    results["variants"] = {name: _plain(outcome(root, job)) for name, job in jobs.items()}
    if "perfect" in jobs:
        requirements = verdict(chain, outcome(root, jobs["perfect"]))
        results["asked"] = {
            what: {"value": value, "limit": limit, "kept": kept} for what, (value, limit, kept) in requirements.items()
        }
    return results


def _plain(one: Outcome) -> dict[str, Any]:
    return one.model_dump() | {"media": {name: own.model_dump() | {"z": own.z} for name, own in one.media.items()}}


def _true(media: Mapping[str, Mapping[str, float]], name: str) -> float:
    part, quantity = name.split(".")
    medium = media[part]
    return medium["sigma"] * (1 - medium["alpha"]) if quantity == "sigma_a" else medium[quantity]


def _angle_deg(one: Floats, two: Floats) -> float:
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(one, two)), one @ two)))


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))
