"""A calibration job that ends at once: it publishes the calibration that lies in its capture's folder."""

from __future__ import annotations

import shutil
from pathlib import Path

from services.core.calibration.record import CALIBRATION_FILE
from services.core.records import JobSpec
from services.core.results import AssetManifest
from services.core.store import StageWriter
from services.pipeline.event_log import EventAddress


def publish_calibration(spec: JobSpec, folder: Path, events: EventAddress) -> None:
    """Publish the files that the stage of a calibration job publishes, without measuring anything."""
    assert spec.capture is not None
    with events.open() as log:
        writer = StageWriter(folder, "asset", log.begin_stage("export"))
        shutil.copy(spec.capture / CALIBRATION_FILE, writer.folder)
        writer.publish(AssetManifest(files=(CALIBRATION_FILE,)))
