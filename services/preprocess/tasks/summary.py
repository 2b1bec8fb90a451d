"""Summary of all images of a preparation: refusals, notes, the quality report and the stage's manifest."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from services.core.errors import CaptureInputError
from services.core.geometry import OBJECT, inner_file, teeth_folder
from services.core.pages.object_words import of_an_object
from services.core.results import PreparedManifest
from services.core.stage import StageContext, StageEvent
from services.core.store import write_record
from services.preprocess.quality.brightness import Brightness
from services.preprocess.quality.images import QualityReport, moved_note, unusable_note
from services.preprocess.quality.page import write_page
from services.preprocess.tasks.attempt_files import AttemptFiles
from services.preprocess.tasks.records import ImageDone
from services.preprocess.views.colours import require_like_colours
from services.preprocess.views.source import Source
from services.preprocess.views.subject import Subject

Known = dict[str, tuple[int, str]]
"""Path of a file in the store -> its size in bytes and its SHA-256."""


def summarise(
    files: AttemptFiles,
    source: Source,
    subject: Subject,
    held_out: tuple[tuple[str, str], ...],
    masks: str,
    context: StageContext,
) -> tuple[PreparedManifest, Known]:
    """Check the capture as a whole, and write the quality report, its page and the meshes into the store.

    Args:
        held_out: (camera, light) pairs held out from the fit.
        masks: digest of the manual masks.

    Returns:
        The stage's manifest, and size and checksum of the images' files.

    Raises:
        CaptureInputError: no pixel is valid, the teeth's brightness is implausible, or channels look exchanged.
            FencedError: another attempt has begun. StoreError: the server of the arrays refuses, does not answer or has
            lost an object.
    """
    files.writer.require_lease()
    images = _images(files, source)
    reports, brightness = [done.quality for done in images], Brightness()
    for done in images:
        brightness.add(done.quality.camera, done.quality.light, done.light)
    for camera in source.description.cameras:
        colours = [done.colour for done in images if done.quality.camera == camera.name and done.colour is not None]
        require_like_colours(colours, camera.name)
    tooth_pixels = np.sum([done.tooth_pixels for done in images], axis=0)
    valid_pixels = sum(report.valid_pixels for report in reports)
    if valid_pixels == 0:
        if brightness.dark:
            what, remedy = (
                "is dark: no tooth is above the noise",
                "check exposure, lights and noise, then capture again",
            )
        elif all(max(report.masked, key=report.masked.__getitem__, default="") == "motion" for report in reports):
            what = "lacks a valid tooth pixel, mostly as motion is not known there"
            remedy = (
                "see that its frames are listed in the order taken, or have time_s, and that tracking frames stand"
                " between the lights"
            )
        else:
            what, remedy = "lacks a valid tooth pixel", "check exposure, lights, noise and masks, then capture again"
        raise CaptureInputError(f"Every image of {source.root} {what}; {remedy}.")
    brightness.require_plausible()
    fdi = tuple(tooth.fdi for tooth in subject.teeth)
    # Collect the notes that sources made while they read, each once
    source_notes = dict.fromkeys([*source.notes, *(note for done in images for note in done.notes)])
    notes = [*source_notes, *brightness.notes(), *unusable_note(reports), *moved_note(reports)]
    if hidden := [str(number) for number, count in zip(fdi, tooth_pixels, strict=True) if count == 0]:
        notes.append(f"No image has a valid pixel of tooth {', '.join(hidden)}; nothing will be known of it.")
    if subject.surroundings:
        around = [*(["gums"] if subject.gums is not None else []), *(str(tooth.fdi) for tooth in subject.others)]
        notes.append(f"Rendered around tooth {fdi[0]}, with light passing between them: {', '.join(around)}.")
    if fdi == (OBJECT,):
        notes = [of_an_object(note) for note in notes]
    for note in notes:
        context.report(StageEvent(stage="prepare", kind="log", message=note))
    covered = tuple(
        done.quality.model_copy(update={"valid_by_tooth": dict(zip(fdi, done.tooth_pixels, strict=True))})
        for done in images
    )
    flow_records = [files.flow(k) for k in range(len(source.description.cameras))]
    flows = tuple(done.flow for done in flow_records if done is not None and done.flow is not None)
    write_record(files.folder / "quality.json", QualityReport(images=covered, flows=flows))
    write_page(files.folder, covered, flows, notes)
    _copy_meshes(source.root, files.folder, fdi + tuple(tooth.fdi for tooth in subject.others if subject.surroundings))
    # Remove partly written files that a killed process left
    for partial in files.folder.rglob("*.partial"):
        partial.unlink()
    files.seal(images)
    motions = [report.motion_px for report in reports if report.motion_px is not None]
    manifest = PreparedManifest(
        channels=source.description.channels,
        cameras=source.description.cameras,
        lights=source.description.lights,
        held_out=held_out,
        fdi=fdi,
        dentin_known=tuple(tooth.fdi for tooth in subject.teeth if tooth.dentin is not None),
        gums=subject.whole and subject.gums is not None,
        cavity=subject.whole and subject.cavity is not None,
        surroundings=subject.surroundings,
        tooth_pixels=tuple(tooth_pixels.tolist()),
        median_motion_px=float(np.median(motions)) if motions else None,
        uncertainty=source.description.uncertainty,
        colour=source.description.colour,
        masks=masks,
        notes=tuple(notes),
        valid_fraction=valid_pixels / sum(report.tooth_pixels for report in reports),
    )
    known = {name: (one.bytes, one.sha256) for done in images for name, one in done.files.items()}
    return manifest, known


def _images(files: AttemptFiles, source: Source) -> list[ImageDone]:
    """Records of all images in the order of cameras and lights."""
    found = [files.image(k, j) for k in range(len(source.description.cameras)) for j in source.lights_of(k)]
    assert all(done is not None for done in found), "every block has ended"
    return [done for done in found if done is not None]


def _copy_meshes(source: Path, target: Path, fdi: tuple[int, ...]) -> None:
    mesh_files = [teeth_folder(Path(), number) / name for number in fdi for name in ("outer.ply", inner_file(number))]
    for relative in [*mesh_files, Path("gums.ply"), Path("cavity.ply")]:
        if (source / relative).is_file():
            (target / relative).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source / relative, target / relative)
