"""Open a job's capture as the source that matches its form: folder, raw folder or published rig capture."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from services.core.calibration.record import Calibration, lit_at, published_capture, recalibrated
from services.core.calibration.state import broken_limits, require_within_limits, warning_of_age
from services.core.files.meshes import read_teeth
from services.core.geometry import OBJECT
from services.core.raw.folder import is_raw_folder
from services.core.raw.registration import teeth_root
from services.core.records import JobSpec
from services.core.results import CaptureManifest
from services.core.store import open_stage, read_record
from services.preprocess.captures.folder import FolderSource
from services.preprocess.captures.rig import RigSource
from services.preprocess.raw.memory_budget import GIB
from services.preprocess.raw.source import RawSource
from services.preprocess.views.source import Source
from services.tasks.executors import threads_here


def open_source(spec: JobSpec, root: Path, *, verify: bool = True) -> Source:
    """Open the folder or store that ``spec.capture`` names, or else the job's own published capture.

    Args:
        root: folder of the job.
        verify: whether to compare a published capture's files with their checksums first.

    Raises:
        CaptureInputError: the capture cannot be read or contradicts itself, or its calibration exceeds its limits.
        StoreError: a published capture is damaged.
    """
    if spec.capture is not None and is_raw_folder(spec.capture):
        raw = RawSource(
            spec.capture,
            spec.calibration,
            spec.sensor_noise_relative,
            spec.sensor_noise_floor,
            teeth_root(spec.capture, root),
            spec.memory_gib * GIB / threads_here(),
            spec.motion,
        )
        return _calibrated(raw, raw.calibration, "of the raw folder" if spec.calibration is None else "", spec)
    published = (root, "capture") if spec.capture is None else published_capture(spec.capture)
    if published is not None:
        source: FolderSource | RigSource = RigSource(
            *open_stage(*published, CaptureManifest, verify=verify), spec.motion
        )
    else:
        assert spec.capture is not None
        source = FolderSource(spec.capture, spec.sensor_noise_relative, spec.sensor_noise_floor)
    if spec.calibration is None:
        return source
    calibration = read_record(spec.calibration, Calibration)
    source.description = recalibrated(source.description, calibration, spec.calibration)
    source.notes += (f"Cameras and lights are those of calibration {spec.calibration.stem}, not the capture's own.",)
    return _calibrated(source, calibration, "", spec)


def _calibrated(
    source: FolderSource | RigSource | RawSource, calibration: Calibration, name: str, spec: JobSpec
) -> Source:
    """Check a calibration's limits, add notes on it to the source, and apply its lights' lobes at the teeth's centre.

    Raises:
        CaptureInputError: the calibration exceeds its limits and was not accepted, or a light shines away from the
            teeth.
    """
    name = name or (spec.calibration.stem if spec.calibration is not None else "")
    require_within_limits(calibration, name, accepted=spec.accept_calibration)
    if (old := warning_of_age(calibration, name, time.time())) is not None:
        source.notes += (old,)
    if broken := broken_limits(calibration):
        source.notes += (f"Calibration {name} was accepted beyond its limits: {broken[0]}.",)
    if any(light.lobe is not None for light in calibration.lights):
        numbers = (OBJECT,) if spec.kind == "object" else None
        vertices = np.concatenate([tooth.outer.vertices_mm for tooth in read_teeth(source.root, numbers)])
        x, y, z = (float(one) for one in vertices.mean(axis=0))
        source.description = lit_at(source.description, (x, y, z))
    return source
