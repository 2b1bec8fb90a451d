"""Which source a job's capture is."""

from __future__ import annotations

from pathlib import Path

from services.core.calibration.record import published_capture, recalibrated
from services.core.raw.folder import is_raw_folder
from services.core.records import CaptureManifest, JobSpec
from services.core.store import open_stage
from services.preprocess.folder import FolderSource
from services.preprocess.raw.source import RawSource
from services.preprocess.rig import RigSource
from services.preprocess.source import Source


def open_source(spec: JobSpec, root: Path, *, verify: bool = True) -> Source:
    """The folder or store that ``spec.capture`` names, or else the job's published capture.

    Args:
        verify: compare a published capture's files with their checksums first.

    Raises:
        CaptureInputError: it cannot be read, or contradicts itself. StoreError: a published capture is damaged.
    """
    if spec.capture is not None and is_raw_folder(spec.capture):
        return RawSource(spec.capture, spec.calibration, spec.sensor_noise_relative, spec.sensor_noise_floor)
    published = (root, "capture") if spec.capture is None else published_capture(spec.capture)
    if published is not None:
        source: FolderSource | RigSource = RigSource(*open_stage(*published, CaptureManifest, verify=verify))
    else:
        assert spec.capture is not None
        source = FolderSource(spec.capture, spec.sensor_noise_relative, spec.sensor_noise_floor)
    if spec.calibration is not None:
        source.description = recalibrated(source.description, spec.calibration)
        source.notes += (
            f"Cameras and lights are those of calibration {spec.calibration.stem}, not the capture's own.",
        )
    return source
