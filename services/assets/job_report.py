"""The report of a job's fit: its pictures, maps and facts, collected from what the job has published."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from services.assets.provenance.departing import BESIDE_PHOTOGRAPH
from services.core.choices import chosen
from services.core.provenance.record import Provenance
from services.core.records import JobSpec
from services.core.results import FitReport

if TYPE_CHECKING:
    from services.assets.appearance.sections import Appearance
    from services.assets.fitted_job import FittedJob
    from services.assets.report_page import ReportPictures


def write_job_report(
    path: Path, job: FittedJob, asset: Path, provenance: Provenance | None, *, with_photographs: bool = True
) -> None:
    """Write the report of a fitted job as one HTML file.

    Args:
        asset: folder of its asset, which has the picture to begin with where ``lead_picture`` could make one.
        provenance: what the asset comes from; None of an asset that an earlier version wrote.
        with_photographs: whether photographs, and pictures from which one could be computed, are shown.
    """
    from services.assets.appearance.sections import appearance_sections
    from services.assets.fit_pictures import report_pictures
    from services.assets.report_page import write_report
    from services.transport.thickness import fitted_thickness

    spec, prepared = job.spec, job.prepared
    is_tooth = spec.kind == "tooth"
    thickness = None
    if is_tooth:
        ((tooth, dentin, shape),) = job.shaped
        thickness = fitted_thickness(tooth.outer, dentin, shape, job.report.shape_covariance, prepared.cameras[0])
    pictures = report_pictures(
        job.folder, job.channels, job.teeth[0] if is_tooth else None, prepared.cameras, thickness, job.stains
    )
    history = json.loads((job.folder / "history.json").read_text())
    titles = {"tooth": f"Tooth {job.teeth[0].fdi}", "jaw": f"Jaw of {len(job.teeth)} teeth", "object": "Object"}
    facts: dict[str, Any] = {
        "title": chosen("Kind of fit", spec.kind, titles),
        "boundary": spec.boundary,
        "ior": spec.ior,
        "provenance": {**facts_of(spec, provenance), **facts_of_fit(job.report)},
    }
    facts["appearance"] = appearance_sections(_appearance(job, asset, pictures), with_photographs=with_photographs)
    if with_photographs and (asset / BESIDE_PHOTOGRAPH).is_file():
        facts["lead"] = f"data:image/png;base64,{base64.b64encode((asset / BESIDE_PHOTOGRAPH).read_bytes()).decode()}"
    write_report(path, job.report, pictures, history, facts, with_photographs=with_photographs)


def _appearance(job: FittedJob, asset: Path, pictures: ReportPictures) -> Appearance:
    """Colours of a job with red, green and blue; empty of any other."""
    import numpy as np

    from services.assets.appearance.differences import colour_difference
    from services.assets.appearance.sections import Appearance
    from services.assets.appearance.shade import read_shade
    from services.assets.appearance.translucency import translucencies
    from services.assets.appearance.white import camera_white
    from services.assets.asset import middle_of
    from services.assets.colour.develop import diffuser_radiance
    from services.assets.lead_picture import read_differences

    whites = {camera.name: camera_white(asset, camera.name) for camera in job.prepared.cameras}
    first = whites[job.prepared.cameras[0].name]
    if first is None:
        return Appearance()
    middle_mm = middle_of(job.teeth)
    index = [job.prepared.channels.index(channel) for channel in job.channels]
    radiance = {
        light.name: np.broadcast_to(diffuser_radiance(light, middle_mm), len(job.prepared.channels))[index]
        for light in job.prepared.lights
    }
    compared = [
        colour_difference(picture, radiance[picture.light], white)
        for picture in sorted(pictures.pictures, key=lambda p: (p.camera, p.held_out))
        if (white := whites.get(picture.camera)) is not None
    ]
    tables = {fdi: tooth.parameters for fdi, tooth in job.report.teeth.items()} or {"": job.report.parameters}
    layers = [
        (fdi, one)
        for fdi, table in tables.items()
        for one in translucencies(table, job.spec.boundary, job.spec.ior, first)
    ]
    found = [one for one in compared if one is not None]
    return Appearance(first.source, [*read_differences(asset), *found], layers, read_shade(asset.parent, asset))


def facts_of_fit(report: FitReport) -> Mapping[str, str]:
    """Which surface the fit held, what it compared and what its time was for, by label."""
    told = {}
    if (rough := report.surface) is not None:
        se = "" if rough.roughness.se is None else f" ± {rough.roughness.se:.3f}"
        told["surface"] = (
            f"rough dielectric, index {rough.ior:g}, GGX roughness {rough.roughness.value:.3g}{se}; light that meets"
            f" several facets is {'given back' if rough.multiple_scattering else 'lost'}"
        )
        if (seen := rough.highlights) is not None:
            told["highlights"] = (
                f"{seen.photographs} photographs under {seen.lights} lights tell the roughness; they are"
                f" {seen.brightness:.2f} ± {seen.brightness_se:.2f} times as bright as predicted, as with an index of"
                f" {seen.index:.2f} ± {seen.index_se:.2f} or with other lights"
            )
    if report.pixel_edge_mm is not None:
        told["squares"] = f"{report.pixel_step} × {report.pixel_step} pixels, {report.pixel_edge_mm:.2f} mm wide"
    if total := sum(report.seconds_by_purpose.values()):
        shares = {name: 100 * seconds / total for name, seconds in report.seconds_by_purpose.items()}
        told["time by purpose"] = ", ".join(f"{name} {share:.0f} %" for name, share in shares.items() if share >= 0.5)
    return told


def facts_of(spec: JobSpec, provenance: Provenance | None) -> Mapping[str, str]:
    """Labels and texts on where a report comes from."""
    facts = {"source": _source(spec), "seed": str(spec.seed), "options": describe_options(spec)}
    if provenance is None:
        return facts
    files = provenance.inputs
    photographs = [] if files is None else [file for file in files if file.is_photograph]
    others = [] if files is None else [file for file in files if not file.is_photograph]
    told = {
        "date": provenance.made,
        "job": provenance.job,
        "subject": provenance.subject or "no label was given",
        "consent": provenance.consent_said,
        "version": ", ".join(f"{name} {version}" for name, version in provenance.versions.items()),
        "machine": provenance.platform,
    }
    if files is None:
        told["inputs"] = "not listed, as an earlier version prepared them"
    elif provenance.photographs_left_out is not None:
        told["photographs"] = f"{provenance.photographs_left_out} files, which are left out here with their hashes"
    else:
        told["photographs"] = f"{len(photographs)} files; their hashes are in provenance.json"
    if others:
        told["other inputs, SHA-256"] = "; ".join(f"{file.name} {file.sha256}" for file in others)
    return told | facts


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
