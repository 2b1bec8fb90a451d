"""The export stage: turns a published fit into an asset, and writes its report."""

from __future__ import annotations

import importlib
import json
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from services.core.consent import require_allowed
from services.core.installed import require_packages
from services.core.provenance.record import PROVENANCE
from services.core.records import JobSpec
from services.core.results import AssetManifest, FitReport
from services.core.stage import StageContext, StageEvent
from services.core.store import StageWriter, write_atomic, write_record
from services.core.verdict import verdict_of

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from services.core.geometry import Tooth

PACKAGES = ("jinja2", "mitsuba", "PIL")
"""Packages of the extra ``fit`` that an export needs, by the names under which they are imported."""


def check() -> None:
    """Import the modules that an export needs.

    Raises:
        PlatformError: a package is missing.
    """
    require_packages(PACKAGES, "fit")
    for module in ("services.assets.asset", "services.assets.fit_pictures", "services.assets.report_page"):
        importlib.import_module(module)


def export(spec: JobSpec, context: StageContext) -> AssetManifest:
    """Write the asset, and parameters.json, errors.json and report.html beside it in the job's folder.

    Raises:
        StoreError: the fit or the prepared stage is missing or damaged.
    """
    from services.assets.asset import errors_json, middle_of, parameters_json, write_asset
    from services.assets.colour.develop import CapturedColours
    from services.assets.fitted_job import read_fitted
    from services.assets.job_report import write_job_report
    from services.assets.lead_picture import write_lead_picture
    from services.core.files.meshes import read_mesh
    from services.core.provenance.inputs import recorded_inputs
    from services.transport.provenance import provenance_of
    from services.transport.scene.rigid_moves import moved_camera, moved_light

    context.report(StageEvent(stage="export", kind="started"))
    context.raise_if_cancelled()
    job = read_fitted(context.root, spec)
    report, prepared, teeth, channels = job.report, job.prepared, job.teeth, job.channels
    provenance = provenance_of(spec, context.root, recorded_inputs(job.prepared_folder), datetime.now(UTC))
    require_allowed(provenance.consent, None, datetime.now(UTC))
    writer = StageWriter(context.root, "asset", context.attempt)
    surroundings = [job.prepared_folder / name for name in ("gums.ply", "cavity.ply")]
    gums, cavity = (read_mesh(path) if spec.kind == "jaw" and path.is_file() else None for path in surroundings)
    index = [prepared.channels.index(channel) for channel in channels]
    lights = tuple(
        light.model_copy(
            update={"intensity": tuple(light.intensity[k if len(light.intensity) > 1 else 0] for k in index)}
        )
        for light in prepared.lights
    )
    move = found_pose(report, teeth)
    cameras = tuple(moved_camera(camera, move) for camera in prepared.cameras)
    lights = tuple(moved_light(light, move) for light in lights)
    files = write_asset(
        writer.folder,
        report,
        teeth,
        cameras,
        lights,
        channels=channels,
        boundary=spec.boundary,
        ior=spec.ior,
        gums=gums,
        cavity=cavity,
        stains=job.stains,
        colours=CapturedColours(prepared.channels, prepared.colour) if prepared.colour else None,
    )
    write_record(writer.folder / PROVENANCE, provenance)
    lead = write_lead_picture(writer.folder, job, cameras, lights, cavity)
    files = tuple(sorted((*files, PROVENANCE, *lead)))

    write_job_report(context.root / "report.html", job, writer.folder, provenance)
    write_atomic(context.root / "parameters.json", _json(parameters_json(report)))
    write_atomic(context.root / "errors.json", _json(errors_json(report)))

    verdict = verdict_of(report)
    manifest = AssetManifest(
        files=files,
        held_out_error=verdict.held_out_error,
        converged=verdict.converged,
        advice=report.advice,
        verdict=verdict,
        centre_mm=middle_of(teeth),
    )
    write_record(writer.folder / "asset.json", manifest)
    writer.publish(manifest)
    context.report(
        StageEvent(stage="export", kind="finished", done=1.0, message=f"Asset of {len(files)} files written.")
    )
    return manifest


def found_pose(report: FitReport, teeth: Sequence[Tooth]) -> NDArray[np.float64]:
    """Rigid transform (4, 4) by which the photographs put the scan elsewhere than the calibration does: the channels'
    mean by their precision, and the identity where no fit estimated it.

    The asset keeps the scan's own frame, so its cameras and lights are placed by this transform instead.
    """
    import numpy as np

    from services.transport.scene.rigid_moves import SCAN, rigid

    found = [own for own in report.instrument.values() if all(name in own for name in SCAN)]
    if not found:
        return np.eye(4)
    values = np.array([[own[name].value for name in SCAN] for own in found])
    precisions = np.array([[1 / (own[name].se or 1.0) ** 2 for name in SCAN] for own in found])
    twist = (precisions * values).sum(axis=0) / precisions.sum(axis=0)
    return rigid(twist, np.concatenate([tooth.outer.vertices_mm for tooth in teeth]).mean(axis=0))


def _json(value: object) -> bytes:
    return (json.dumps(value, indent=1) + "\n").encode()
