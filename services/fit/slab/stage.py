"""Entry points of the job kind ``slab``: ``run`` fits a folder's wavelengths on the workers, ``export`` writes the
results.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from services.core.errors import CaptureInputError
from services.core.job_kinds import SLAB_OPTIONS
from services.core.placement import WEIGHTS
from services.core.records import JobSpec
from services.core.results import AssetManifest
from services.core.slab.folder import SlabFolder, read_folder
from services.core.stage import CANCEL_FLAG, StageContext, StageEvent
from services.core.store import StageWriter, open_stage, write_atomic, write_record
from services.core.verdict import VERDICT

if TYPE_CHECKING:
    from services.fit.slab.results.result import SlabReport
    from services.fit.slab.solve.standing import Standing

CHECKPOINT = "fit-checkpoint"
"""Folder within the job's folder, with one folder per wavelength: its result once it is done, until then the state of
its fit, from which a new attempt continues."""


def run(spec: JobSpec, context: StageContext) -> SlabReport:
    """Fit every wavelength on the workers, report each as it is done, and publish ``fit/`` with their images.

    Raises:
        CaptureInputError: the folder cannot be read.
        JobCancelledError: between two blocks of paths.
    """
    from services.fit.execution.executors import executor
    from services.fit.slab.dictionaries.chosen import dictionary_of
    from services.fit.slab.images import read_images
    from services.fit.slab.options import SlabOptions
    from services.fit.slab.results.kept import IMAGES, read_kept
    from services.fit.slab.results.result import SlabReport
    from services.fit.slab.schedule import WavelengthTask, run_wavelengths

    context.report(StageEvent(stage="fit", kind="started"))
    context.raise_if_cancelled()
    root, folder = _folder(spec)
    options = SlabOptions.model_validate(spec.model_dump(include={"seed", *SLAB_OPTIONS}))
    for wavelength_nm in folder.wavelengths_nm:  # report a fault in the last one before the first has cost its time
        dictionary_of(root, folder, wavelength_nm, options)
        for fault in read_images(root, folder, wavelength_nm).faults:
            context.report(StageEvent(stage="fit", kind="log", message=f"{wavelength_nm:g} nm: {fault}"))
    writer = StageWriter(context.root, "fit", context.attempt)
    flag = context.root / CANCEL_FLAG
    places = {nm: context.root / CHECKPOINT / f"{nm:g}" for nm in folder.wavelengths_nm}
    prefix = hashlib.sha256(f"{context.root}/{context.attempt}".encode()).hexdigest()[:12]
    tasks = [WavelengthTask(root, nm, options, place, flag) for nm, place in places.items()]

    def told(wavelength_nm: float, standing: Standing) -> None:
        where = f"before step {standing.step + 1} of stage {standing.stage + 1}"
        message = f"{wavelength_nm:g} nm: {where}, σs {standing.material.scattering_per_mm:.4g} per mm."
        context.report(StageEvent(stage="fit", kind="log", message=message))

    with executor(flag, prefix=prefix, weight=WEIGHTS[spec.priority]) as run_on:
        for number, place in enumerate(run_wavelengths(run_on, tasks, spec.workers, told), 1):
            kept = read_kept(place)
            assert kept is not None
            which = {"wavelength_nm": kept.fit.wavelength_nm, "wavelengths": len(places)}
            done = number / len(places)
            context.report(StageEvent(stage="fit", kind="progress", done=done, message=_told(kept.fit), data=which))
    fits = []
    for place in places.values():
        kept = read_kept(place)
        assert kept is not None
        fits.append(kept.fit)
        write_atomic(writer.folder / f"{place.name}.npz", (place / IMAGES).read_bytes())
    report = SlabReport(fits=tuple(fits))
    writer.publish(report)
    verdict = report.verdict()
    data = {VERDICT: verdict.model_dump(mode="json")}
    context.report(StageEvent(stage="fit", kind="finished", done=1.0, message=verdict.headline, data=data))
    return report


def export(spec: JobSpec, context: StageContext) -> AssetManifest:
    """Write parameters.json, phase.json and its pictures, errors.json and report.html, and tables and scenes for
    Mitsuba as the asset.

    Raises:
        StoreError: the fit is missing or damaged.
        CaptureInputError: the folder is gone.
    """
    from services.fit.slab.fit import write_results
    from services.fit.slab.results.chart import phase_picture
    from services.fit.slab.results.kept import read_images_of
    from services.fit.slab.results.report import write_report
    from services.fit.slab.results.result import SlabReport
    from services.fit.slab.results.tabphase import scene_xml, values_text

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
    images = {fit.wavelength_nm: read_images_of(fit_folder / f"{fit.wavelength_nm:g}.npz") for fit in report.fits}
    verdict = report.verdict()
    provenance = {"Source": root.name, "Seed": str(spec.seed)}
    write_report(context.root / "report.html", report, verdict, images, provenance)
    write_results(report.fits, context.root)
    for fit in report.fits:
        picture = phase_picture(f"Phase function at {fit.wavelength_nm:g} nm", fit.phase)
        write_atomic(context.root / f"phase_{fit.wavelength_nm:g}.svg", picture.encode())
    manifest = AssetManifest(
        files=tuple(files),
        held_out_error=verdict.error.value,
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


def _told(fit: Any) -> str:
    told = fit.parameters
    parts = (
        f"{label} {value.value:.4g} ± {value.se:.1g}"
        for label, value in (("σs", told.sigma_s), ("σs′", told.sigma_s_reduced))
    )
    return (
        f"{fit.wavelength_nm:g} nm: {', '.join(parts)} per mm; error on fitted images"
        f" {100 * fit.errors.fit_error:.2f} %."
    )
