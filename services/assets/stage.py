"""The export stage: turns a published fit into an asset, and writes its report."""

from __future__ import annotations

import importlib
import json
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from services.core.consent import require_allowed
from services.core.geometry import Mesh
from services.core.installed import require_packages
from services.core.provenance.record import PROVENANCE
from services.core.records import JobSpec
from services.core.results import AssetManifest, FitReport, PreparedManifest, ToothReport
from services.core.stage import StageContext, StageEvent
from services.core.store import StageWriter, open_stage, write_atomic, write_record
from services.core.verdict import verdict_of

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from services.anatomy.dentin_shape import DentinShape
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
    from services.assets.fit_pictures import report_pictures
    from services.assets.provenance.made import provenance_of
    from services.assets.report_page import write_report
    from services.core.files.meshes import read_mesh
    from services.transport.scene.rigid_moves import moved_camera, moved_light
    from services.transport.scene.stain_uv import read_stains
    from services.transport.thickness import fitted_thickness

    context.report(StageEvent(stage="export", kind="started"))
    context.raise_if_cancelled()
    fit_folder, report = open_stage(context.root, "fit", FitReport)
    prepared_folder, prepared = open_stage(context.root, "prepared", PreparedManifest, verify=False)
    now = datetime.now(UTC)
    provenance = provenance_of(spec, context.root, prepared_folder, now)
    require_allowed(provenance.consent, None, now)
    writer = StageWriter(context.root, "asset", context.attempt)
    channels = tuple(report.parameters)
    shaped = fitted_dentins(prepared_folder, prepared, spec, report)
    teeth = tuple(_with_dentin(*each) for each in shaped)
    surroundings = [prepared_folder / name for name in ("gums.ply", "cavity.ply")]
    gums, cavity = (read_mesh(path) if spec.kind == "jaw" and path.is_file() else None for path in surroundings)
    index = [prepared.channels.index(channel) for channel in channels]
    lights = tuple(
        light.model_copy(
            update={"intensity": tuple(light.intensity[k if len(light.intensity) > 1 else 0] for k in index)}
        )
        for light in prepared.lights
    )
    stains = read_stains(fit_folder)
    move = found_pose(report, teeth)
    files = write_asset(
        writer.folder,
        report,
        teeth,
        tuple(moved_camera(camera, move) for camera in prepared.cameras),
        tuple(moved_light(light, move) for light in lights),
        channels=channels,
        boundary=spec.boundary,
        ior=spec.ior,
        gums=gums,
        cavity=cavity,
        stains=stains,
        colours=CapturedColours(prepared.channels, prepared.colour) if prepared.colour else None,
    )
    write_record(writer.folder / PROVENANCE, provenance)
    files = tuple(sorted((*files, PROVENANCE)))

    history = json.loads((fit_folder / "history.json").read_text())
    title = f"Tooth {teeth[0].fdi}" if spec.kind == "tooth" else f"Jaw of {len(teeth)} teeth"
    facts = {
        "title": title,
        "boundary": spec.boundary,
        "ior": spec.ior,
        "provenance": {"source": _source(spec), "seed": str(spec.seed), "options": describe_options(spec)},
    }
    thickness = None
    if spec.kind == "tooth":
        ((tooth, dentin, shape),) = shaped
        thickness = fitted_thickness(tooth.outer, dentin, shape, report.shape_covariance, prepared.cameras[0])
    pictures = report_pictures(
        fit_folder, channels, teeth[0] if spec.kind == "tooth" else None, prepared.cameras, thickness, stains
    )
    write_report(context.root / "report.html", report, pictures, history, facts)
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


def fitted_teeth(
    prepared_folder: Path, prepared: PreparedManifest, spec: JobSpec, report: FitReport
) -> tuple[Tooth, ...]:
    """The teeth with the fitted dentin surfaces."""
    return tuple(_with_dentin(*each) for each in fitted_dentins(prepared_folder, prepared, spec, report))


def fitted_dentins(
    prepared_folder: Path, prepared: PreparedManifest, spec: JobSpec, report: FitReport
) -> list[tuple[Tooth, DentinShape | None, tuple[float, ...]]]:
    """Each tooth as it was prepared, its dentin as it was modelled, and the fitted weights of its blend modes."""
    from services.anatomy.job_dentin import dentin_shape, jaw_dentins
    from services.core.files.meshes import read_teeth

    teeth = read_teeth(prepared_folder, prepared.fdi)
    if spec.kind == "jaw":
        shapes = [(report.teeth[str(tooth.fdi)].shape, _is_layered(report.teeth[str(tooth.fdi)])) for tooth in teeth]
        dentins = [
            dentin if layered else None
            for dentin, (_, layered) in zip(jaw_dentins(teeth, prepared.cameras, spec), shapes, strict=True)
        ]
        return [(tooth, dentin, shape) for tooth, dentin, (shape, _) in zip(teeth, dentins, shapes, strict=True)]
    (tooth,) = teeth
    return [(tooth, dentin_shape(tooth, prepared.cameras, spec), report.shape)]


def _is_layered(tooth: ToothReport) -> bool:
    return all("dentin.sigma" in table for table in tooth.parameters.values())


def _with_dentin(tooth: Tooth, dentin: DentinShape | None, shape: tuple[float, ...]) -> Tooth:
    return replace(tooth, dentin=None if dentin is None else Mesh(dentin.vertices_mm(shape), dentin.base.faces))


def describe_options(spec: JobSpec) -> str:
    """Options of a fit that differ from their defaults, as one sentence.

    Paths are left out, because they mean nothing to the reader of a report.
    """
    named = spec.changed_options - {"kind", "capture", "rig", "calibration", "seed", "workers", "priority"}
    values = spec.model_dump(mode="json", include=set(named))
    rows = [f"{name} = {value if isinstance(value, str) else json.dumps(value)}" for name, value in values.items()]
    return "; ".join(rows) + "; all others at their defaults" if rows else "all at their defaults"


def _source(spec: JobSpec) -> str:
    return spec.capture.name if spec.capture is not None else f"rig {spec.rig.dome if spec.rig else ''}"


def _json(value: object) -> bytes:
    return (json.dumps(value, indent=1) + "\n").encode()
