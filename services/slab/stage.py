"""Entry points of the job kind ``slab``: ``run`` fits a folder's wavelengths on the workers, ``export`` writes the
results.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from services.core.errors import CaptureInputError
from services.core.job_kinds import SLAB_OPTIONS
from services.core.placement import WEIGHTS
from services.core.provenance.inputs import hashed_inputs
from services.core.provenance.record import PROVENANCE, Inputs
from services.core.records import JobSpec
from services.core.results import AssetManifest, Figure
from services.core.slab.folder import Light, SlabCamera, SlabFolder, read_folder
from services.core.stage import CANCEL_FLAG, StageContext, StageEvent
from services.core.store import StageWriter, open_stage, write_atomic, write_record
from services.core.verdict import VERDICT, percent

if TYPE_CHECKING:
    from services.slab.results.result import SlabFit, SlabReport
    from services.slab.solve.checkpoint import Checkpoint

CHECKPOINT = "fit-checkpoint"
"""Folder within the job's folder, with one folder per wavelength. Its journal has the result once that is done, and
until then the state of the fit, from which a new attempt continues."""


def run(spec: JobSpec, context: StageContext) -> SlabReport:
    """Fit every wavelength on the workers, report each as it is done, and publish ``fit/`` with their images.

    Raises:
        CaptureInputError: the folder cannot be read.
        JobCancelledError: between two blocks of paths.
    """
    from services.slab.dictionaries.chosen import dictionary_of
    from services.slab.options import SlabOptions
    from services.slab.read.images import read_images
    from services.slab.results.result import SlabReport
    from services.slab.results.stored import copy_result_images, read_result
    from services.slab.schedule import WavelengthTask, run_wavelengths
    from services.tasks.executors import executor

    context.report(StageEvent(stage="fit", kind="started"))
    context.raise_if_cancelled()
    root, folder = _folder(spec)
    options = SlabOptions.model_validate(spec.model_dump(include={"seed", *SLAB_OPTIONS}))
    reported = set[str]()
    for wavelength_nm in folder.wavelengths_nm:  # report a fault in the last one before the first has cost its time
        dictionary_of(root, folder, wavelength_nm, options)
        for fault in read_images(root, folder, wavelength_nm).faults:
            reported.add(message := f"{wavelength_nm:g} nm: {fault}")
            context.report(StageEvent(stage="fit", kind="log", message=message))
    writer = StageWriter(context.root, "fit", context.attempt)
    flag = context.root / CANCEL_FLAG
    result_folders = {nm: context.root / CHECKPOINT / f"{nm:g}" for nm in folder.wavelengths_nm}
    prefix = hashlib.sha256(f"{context.root}/{context.attempt}".encode()).hexdigest()[:12]
    tasks = [
        WavelengthTask(root, nm, options, result_folder, flag, writer.require_lease)
        for nm, result_folder in result_folders.items()
    ]
    for task in tasks:
        for note in task.journal().notes:
            context.report(StageEvent(stage="fit", kind="log", message=f"{task.wavelength_nm:g} nm: {note}"))

    def report_checkpoint(wavelength_nm: float, checkpoint: Checkpoint) -> None:
        where = f"before step {checkpoint.step + 1} of stage {checkpoint.stage + 1}"
        message = f"{wavelength_nm:g} nm: {where}, σs {checkpoint.material.scattering_per_mm:.4g} per mm."
        context.report(StageEvent(stage="fit", kind="log", message=message))

    with executor(flag, prefix=prefix, weight=WEIGHTS[spec.priority]) as run_on:
        for number, result_folder in enumerate(run_wavelengths(run_on, tasks, spec.workers, report_checkpoint), 1):
            fit = read_result(result_folder)
            assert fit is not None
            progress = {"wavelength_nm": fit.wavelength_nm, "wavelengths": len(result_folders)}
            done = number / len(result_folders)
            context.report(
                StageEvent(stage="fit", kind="progress", done=done, message=_progress_message(fit), data=progress)
            )
    fits = []
    for result_folder in result_folders.values():
        fit = read_result(result_folder)
        assert fit is not None
        fits.append(fit)
        for message in (f"{result_folder.name} nm: {note}" for note in fit.notes):
            if message not in reported:
                context.report(StageEvent(stage="fit", kind="log", message=message))
        copy_result_images(result_folder, writer.folder / f"{result_folder.name}.npz")
    report = SlabReport(fits=tuple(fits))
    writer.publish(report)
    verdict = report.verdict()
    data = {VERDICT: verdict.model_dump(mode="json")}
    context.report(StageEvent(stage="fit", kind="finished", done=1.0, message=verdict.headline, data=data))
    return report


def export(spec: JobSpec, context: StageContext) -> AssetManifest:
    """Write parameters.json, phase.json and its pictures, errors.json and report.html. The asset has the numbers too,
    with tables and scenes for Mitsuba and what it was made from.

    Raises:
        StoreError: the fit is missing or damaged.
        CaptureInputError: the folder is gone.
    """
    from services.slab.fit import write_results
    from services.slab.results.chart import phase_picture
    from services.slab.results.report_page import write_report
    from services.slab.results.result import SlabReport
    from services.slab.results.stored import read_result_images
    from services.slab.results.tabphase import scene_xml, values_text
    from services.transport.provenance import provenance_of

    context.report(StageEvent(stage="export", kind="started"))
    context.raise_if_cancelled()
    root, folder = _folder(spec)
    fit_folder, report = open_stage(context.root, "fit", SlabReport)
    writer = StageWriter(context.root, "asset", context.attempt)
    files = []
    for fit in report.fits:
        name = f"{fit.wavelength_nm:g}"
        for file, text in (
            (f"tabphase_{name}.txt", values_text(fit)),
            (f"slab_{name}.xml", scene_xml(fit, folder.cell)),
        ):
            write_atomic(writer.folder / file, text.encode())
            files.append(file)
    images = {fit.wavelength_nm: read_result_images(fit_folder / f"{fit.wavelength_nm:g}.npz") for fit in report.fits}
    verdict = report.verdict()
    provenance = {
        "Source": root.name,
        "Cell": f"{folder.cell.width_mm:g} mm wide; beam {folder.beam.profile}, {folder.beam.size_mm:g} mm",
        "Lights": _angles(folder.lights),
        "Cameras": _angles(folder.cameras),
        "Seed": str(spec.seed),
        "Effort": f"{spec.effort:g}",
        "Dictionary": spec.dictionary,
    }
    write_report(context.root / "report.html", report, verdict, images, provenance)
    write_results(report.fits, context.root)
    for fit in report.fits:
        picture = phase_picture(f"Phase function at {fit.wavelength_nm:g} nm", fit.phase)
        write_atomic(context.root / f"phase_{fit.wavelength_nm:g}.svg", picture.encode())
    write_results(report.fits, writer.folder)
    inputs = Inputs(files=hashed_inputs(spec, context.root))
    write_record(writer.folder / PROVENANCE, provenance_of(spec, context.root, inputs, datetime.now(UTC)))
    files += ["parameters.json", "phase.json", "errors.json", PROVENANCE]
    manifest = AssetManifest(
        files=tuple(files),
        held_out_error=verdict.held_out_error,
        converged=verdict.converged,
        advice=verdict.advice,
        verdict=verdict,
    )
    write_record(writer.folder / "asset.json", manifest)
    writer.publish(manifest)
    message = f"Asset of {len(files)} files written."
    context.report(StageEvent(stage="export", kind="finished", done=1.0, message=message))
    return manifest


def _folder(spec: JobSpec) -> tuple[Path, SlabFolder]:
    assert spec.capture is not None  # a slab has no rig
    if not (spec.capture / "slab.json").is_file():
        raise CaptureInputError(
            f"{spec.capture} holds no slab.json, which a job of kind slab is fitted from; check option 'capture'."
        )
    return spec.capture, read_folder(spec.capture)


def _angles(entries: Sequence[Light | SlabCamera]) -> str:
    return ", ".join(f"{entry.name} {entry.side} {entry.angle_deg:g}°" for entry in entries)


def _progress_message(fit: SlabFit) -> str:
    parameters = fit.parameters
    parts = (
        f"{label} {value.value:.4g} ± {value.se:.2g}"
        for label, value in (("σs", parameters.sigma_s), ("σs′", parameters.sigma_s_reduced))
    )
    error = percent(Figure(value=fit.errors.fit_error, se=fit.errors.fit_error_se))
    return f"{fit.wavelength_nm:g} nm: {', '.join(parts)} per mm; error on fitted images {error}."
