"""The prepare stage: a capture in, the published ``prepared`` store out."""

from __future__ import annotations

import importlib
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

from services.core.calibration import published_capture, recalibrated
from services.core.errors import CaptureInputError, SettingsError
from services.core.geometry import teeth_folder
from services.core.installed import require_packages
from services.core.raw.folder import is_raw_folder
from services.core.records import CaptureManifest, JobSpec, MaskBit, PreparedManifest
from services.core.stage import StageContext, StageEvent
from services.core.store import StageWriter, create_array, open_stage, write_record

if TYPE_CHECKING:
    import zarr

    from services.preprocess.source import Source


PACKAGES = ("cv2", "imagecodecs", "rtree", "tifffile")
"""What the extra ``preprocess`` brings, by the names under which it is imported."""


def check() -> None:
    """Import what a preparation needs.

    Raises:
        PlatformError: something is missing.
    """
    require_packages(PACKAGES, "preprocess")
    for module in ("source", "raw.source", "brightness", "masks", "quality", "subject", "valid"):
        importlib.import_module(f"services.preprocess.{module}")


def run(spec: JobSpec, context: StageContext) -> PreparedManifest:
    """Prepare ``spec.capture``, or the job's own published capture, and publish ``prepared``.

    Streams: one frame with its radiance and variance is held, whatever the capture's size.

    Raises:
        CaptureInputError: a file, frame, camera or light is missing or malformed. MeshError: a surface cannot bound a medium.
        SettingsError: an option names an unknown light or channel. StoreError: the capture store is damaged. JobCancelledError.
    """
    import numpy as np

    from services.preprocess.brightness import Brightness, light_of
    from services.preprocess.masks import HandMasks
    from services.preprocess.motion import stored_step
    from services.preprocess.quality import QualityReport, assess, unusable_note, write_picture
    from services.preprocess.subject import NOTHING, read_subject
    from services.preprocess.valid import require_plausible_scale, require_seen, valid_bits

    # Check everything that needs no pixel
    source = _open_source(spec, context.root)
    cameras, lights, channels = source.description.cameras, source.description.lights, source.description.channels
    held_out = _held_out(spec, source)
    if spec.channels == ():
        raise SettingsError("Option 'channels' is empty; name a channel, or leave it out to fit all.")
    if unknown := set(spec.channels or ()) - set(channels):
        raise SettingsError(
            f"Option 'channels' names {min(unknown)}, but the capture has {', '.join(channels)}; correct it."
        )
    masks = HandMasks(context.root, source.description)
    subject = read_subject(source.root, whole=spec.kind == "jaw")
    teeth = subject.teeth
    require_plausible_scale(cameras, lights, teeth)

    writer = StageWriter(context.root, "prepared", context.attempt)
    shutil.rmtree(writer.folder)
    writer.folder.mkdir()
    images_in_all = sum(len(source.lights_of(k)) for k in range(len(cameras)))
    context.report(
        StageEvent(stage="prepare", kind="started", message=f"{images_in_all} images of {len(cameras)} cameras.")
    )

    height, width = max(c.size[1] for c in cameras), max(c.size[0] for c in cameras)
    planes = (len(cameras), len(lights), height, width)
    radiance, variance, valid, surface, motion = _create_arrays(
        writer.folder / "prepared.zarr", planes, len(channels), with_motion=source.measures_motion
    )

    brightness, reports, done, seen = Brightness(), [], 0, np.zeros(len(teeth), dtype=np.int64)
    for k, camera in enumerate(cameras):
        context.raise_if_cancelled()
        view = subject.view_of(k, camera)
        window, footprint = view.window, view.footprint
        require_seen(footprint, len(teeth), camera)
        glossy = subject.glossy(footprint)
        labels = np.full((height, width), NOTHING, dtype=np.int16)
        labels[window.rows, window.columns] = footprint.mesh
        surface[k] = labels
        for j in set(range(len(lights))) - set(source.lights_of(k)):
            valid[k, j] = np.uint16(MaskBit.UNLIT | MaskBit.OUTSIDE)
        motions_of = dict(source.match(view, source.matched(k)))
        for j, image in source.images(view, source.lights_of(k), motions_of):
            context.raise_if_cancelled()
            bits = valid_bits(image, footprint, view.camera, lights[j], glossy)
            bits |= masks.bits(camera.name, lights[j].name, camera.size)[window.rows, window.columns]
            of_teeth = (bits == 0) & (footprint.mesh < len(teeth))
            shown = light_of(image, view, lights[j], of_teeth)
            brightness.add(camera.name, lights[j].name, shown)
            if shown is not None and shown.dark:
                bits |= np.uint16(MaskBit.UNLIT)
            seen += subject.pixels_of_teeth(footprint, bits)
            radiance[k, j, window.rows, window.columns] = image.radiance
            variance[k, j, window.rows, window.columns] = image.variance
            all_bits = np.full((height, width), MaskBit.OUTSIDE, dtype=np.uint16)
            all_bits[window.rows, window.columns] = bits
            valid[k, j] = all_bits
            if motion is not None and image.displacement is not None:
                step = stored_step((height, width))
                first = (-(-window.top // step), -(-window.left // step))
                motion[
                    k,
                    j,
                    first[0] : first[0] + image.displacement.shape[0],
                    first[1] : first[1] + image.displacement.shape[1],
                ] = image.displacement
            quality = assess(camera.name, lights[j].name, bits, footprint.covered, image.motion_px)
            reports.append(quality)
            write_picture(writer.folder / "quality" / f"{camera.name}_{lights[j].name}.png", image.radiance, bits)
            done += 1
            context.report(
                StageEvent(
                    stage="prepare",
                    kind="progress",
                    message=f"Camera {camera.name}, light {lights[j].name}: {quality.valid_pixels} valid pixels.",
                    done=done / images_in_all,
                    data=quality.model_dump(),
                )
            )
            if quality.valid_pixels == 0:
                reasons = ", ".join(
                    f"{name} {share:.0%}" for name, share in sorted(quality.masked.items(), key=lambda item: -item[1])
                )
                context.report(
                    StageEvent(
                        stage="prepare",
                        kind="log",
                        message=f"Camera {camera.name}, light {lights[j].name} has no valid pixel left ({reasons}).",
                    )
                )

    valid_pixels = sum(report.valid_pixels for report in reports)
    if valid_pixels == 0:
        what = "is dark: no tooth is above the noise" if brightness.dark else "lacks a valid tooth pixel"
        raise CaptureInputError(
            f"Every image of {source.root} {what}; check exposure, lights, noise and masks, then capture again."
        )
    brightness.require_plausible()
    fdi = tuple(tooth.fdi for tooth in teeth)
    notes = [*source.notes, *brightness.notes(), *unusable_note(reports)]
    if hidden := [str(number) for number, count in zip(fdi, seen, strict=True) if count == 0]:
        notes.append(f"No image has a valid pixel of tooth {', '.join(hidden)}; nothing will be known of it.")
    for note in notes:
        context.report(StageEvent(stage="prepare", kind="log", message=note))
    write_record(writer.folder / "quality.json", QualityReport(images=tuple(reports)))
    _copy_meshes(source.root, writer.folder, fdi)
    motions = [report.motion_px for report in reports if report.motion_px is not None]
    manifest = PreparedManifest(
        channels=channels,
        cameras=cameras,
        lights=lights,
        held_out=held_out,
        fdi=fdi,
        dentin_known=tuple(tooth.fdi for tooth in teeth if tooth.dentin is not None),
        gums=subject.whole and subject.gums is not None,
        cavity=subject.whole and subject.cavity is not None,
        tooth_pixels=tuple(seen.tolist()),
        median_motion_px=float(np.median(motions)) if motions else None,
        uncertainty=source.description.uncertainty,
        masks=masks.digest,
        notes=tuple(notes),
        valid_fraction=valid_pixels / sum(report.tooth_pixels for report in reports),
    )
    writer.publish(manifest)
    context.report(
        StageEvent(stage="prepare", kind="finished", message=f"{valid_pixels} valid pixels in {done} images.", done=1.0)
    )
    return manifest


def _create_arrays(
    store: Path, planes: tuple[int, int, int, int], channels: int, *, with_motion: bool
) -> tuple[zarr.Array[Any], zarr.Array[Any], zarr.Array[Any], zarr.Array[Any], zarr.Array[Any] | None]:
    """Radiance, variance, valid, surface and, where it is measured, motion; one chunk per image, so that each is written once."""
    from services.preprocess.motion import stored_step

    cameras, _, height, width = planes
    stack = ("camera", "light", "y", "x")
    radiance, variance = (
        create_array(store, name, (*planes, channels), (1, 1, height, width, channels), "float32", (*stack, "channel"))
        for name in ("radiance", "variance")
    )
    valid = create_array(store, "valid", planes, (1, 1, height, width), "uint16", stack)
    surface = create_array(
        store, "surface", (cameras, height, width), (1, height, width), "int16", ("camera", "y", "x")
    )
    if not with_motion:
        return radiance, variance, valid, surface, None
    step = stored_step((height, width))
    grid = (-(-height // step), -(-width // step))
    motion = create_array(store, "motion", (*planes[:2], *grid, 2), (1, 1, *grid, 2), "float32", (*stack, "axis"))
    motion.attrs["step_px"] = step
    return radiance, variance, valid, surface, motion


def _open_source(spec: JobSpec, root: Path) -> Source:
    """The folder or store that ``spec.capture`` names, or else the job's published capture."""
    from services.preprocess.folder import FolderSource
    from services.preprocess.raw.source import RawSource
    from services.preprocess.rig import RigSource

    if spec.capture is not None and is_raw_folder(spec.capture):
        return RawSource(spec.capture, spec.calibration, spec.sensor_noise_relative, spec.sensor_noise_floor)
    published = (root, "capture") if spec.capture is None else published_capture(spec.capture)
    if published is not None:
        source: FolderSource | RigSource = RigSource(*open_stage(*published, CaptureManifest))
    else:
        assert spec.capture is not None
        source = FolderSource(spec.capture, spec.sensor_noise_relative, spec.sensor_noise_floor)
    if spec.calibration is not None:
        source.description = recalibrated(source.description, spec.calibration)
        source.notes += (
            f"Cameras and lights are those of calibration {spec.calibration.stem}, not the capture's own.",
        )
    return source


def _held_out(spec: JobSpec, source: Source) -> tuple[tuple[str, str], ...]:
    """(camera, light) pairs kept from the fit: as the job says, else as the capture marks, else every fourth light."""
    names = [light.name for light in source.description.lights]
    if spec.held_out_lights is None and source.held_out:
        return source.held_out
    chosen = spec.held_out_lights if spec.held_out_lights is not None else tuple(names[3::4])
    if unknown := [name for name in chosen if name not in names]:
        raise SettingsError(
            f"Option 'held_out_lights' names {unknown[0]}, but the capture has {', '.join(names)}; correct it."
        )
    if set(chosen) == set(names):
        raise SettingsError("Option 'held_out_lights' keeps every light from the fit; leave at least one to it.")
    return tuple(
        (camera.name, names[j])
        for k, camera in enumerate(source.description.cameras)
        for j in source.lights_of(k)
        if names[j] in chosen
    )


def _copy_meshes(source: Path, target: Path, fdi: tuple[int, ...]) -> None:
    wanted = [teeth_folder(Path(), number) / name for number in fdi for name in ("outer.ply", "dentin.ply")]
    for relative in [*wanted, Path("gums.ply"), Path("cavity.ply")]:
        if (source / relative).is_file():
            (target / relative).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source / relative, target / relative)
