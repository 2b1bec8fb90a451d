"""The surface of the tooth or object, which is known before the fit of the media begins and is held by it."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

from services.core.errors import CaptureInputError
from services.core.records import JobSpec
from services.core.results import Estimate, Highlights, RoughSurface
from services.core.store import read_record, write_atomic
from services.core.surface.rough import FIT, ROUGHNESS
from services.fit.measurements.observations import Observations

STORED = "surface-{}.json"
"""File of a measured surface among the fit's input files, by the digest of what it was measured from. A fit that goes
on reads it, because its scenes must stay as they were to the last digit."""
MEASURED_FROM = ("ior", "multiple_scattering", "channels", "held_out_lights", "held_out_cameras", "left_out_lights")
"""Options on which a measured surface depends."""


def held_surface(
    spec: JobSpec, observations: Observations, folder: Path, log: Callable[[str], None]
) -> RoughSurface | None:
    """The rough surface that a fit holds; None for the other boundary models.

    A roughness that the job gives is taken as exact: pixels off the highlights hardly tell it from absorption.

    Args:
        spec: the job. observations: its photographs.
        folder: folder of the fit's input files. log: reports one sentence to the job's event log.

    Raises:
        CaptureInputError: the highlights do not tell the roughness; the message names the remedy.
    """
    if spec.boundary != "rough":
        return None
    if spec.roughness != FIT:
        return _surface(spec, Estimate(value=spec.roughness, se=None, unit="1", determined=False), None)
    told = observations.manifest.model_dump_json() + spec.model_dump_json(include=set(MEASURED_FROM))
    path = folder / STORED.format(hashlib.sha256(told.encode()).hexdigest()[:16])
    if path.is_file():
        return read_record(path, RoughSurface)
    log("The roughness of the surface is measured by the highlights.")
    surface = _measured(spec, observations)
    assert surface.highlights is not None
    roughness, seen = surface.roughness, surface.highlights
    log(
        f"Roughness {roughness.value:.3g} ± {roughness.se:.2g} by the highlights of {seen.photographs} photographs"
        f" under {seen.lights} lights."
    )
    for warning in seen.warnings:
        log(warning)
    folder.mkdir(parents=True, exist_ok=True)
    write_atomic(path, surface.model_dump_json().encode())
    return surface


def _measured(spec: JobSpec, observations: Observations) -> RoughSurface:
    from services.fit.measurements.roughness.measure import REMEDY, roughness_from_highlights
    from services.fit.measurements.roughness.stored import StoredPhotographs

    (subject,) = observations.teeth
    found = roughness_from_highlights(subject.outer, StoredPhotographs(observations, spec), spec.ior)
    low, high = ROUGHNESS
    if not low <= found.value <= high:
        raise CaptureInputError(
            f"The highlights tell a roughness of {found.value:.2g}, and surfaces of {low:g} to {high:g} can be"
            f" rendered; look at the highlights in the photographs, or {REMEDY}."
        )
    highlights = Highlights(
        photographs=len(found.photographs),
        lights=found.lights,
        pixels=found.pixels,
        brightness=found.brightness,
        brightness_se=found.brightness_se,
        index=found.index,
        index_se=found.index_se,
        surface_height_mm=found.surface_height_mm,
        warnings=found.warnings,
    )
    estimate = Estimate(value=found.value, se=found.standard_error, unit="1", determined=True)
    return _surface(spec, estimate, highlights)


def _surface(spec: JobSpec, roughness: Estimate, highlights: Highlights | None) -> RoughSurface:
    return RoughSurface(
        roughness=roughness,
        ior=spec.ior,
        multiple_scattering=spec.multiple_scattering == "on",
        highlights=highlights,
    )
