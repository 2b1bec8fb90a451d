"""Import of a folder of named files: ``raw.toml`` is written from their names and from some files of each camera."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from services.capture.raw.listing import IMAGES, photographs_in, require_told_apart, unused_words
from services.capture.raw.names import NamedFrame, named_frame
from services.core.calibration.record import Calibration
from services.core.errors import CaptureInputError
from services.core.files.scans import FORMATS
from services.core.raw.decoded import Decoded
from services.core.raw.decoding import CAMERA_RAW, JPEG, decode, is_jpeg, read_jpeg
from services.core.raw.folder import DESCRIPTION, parse_raw_folder
from services.core.raw.records import TARGET_KEYS, RawFolder
from services.core.raw.toml_writing import description_toml, toml_value
from services.core.store import read_record, write_atomic

DEPTHS = (8, 10, 12, 14, 16)
"""Numbers of bits of cameras' analogue-to-digital converters."""
FRAMES_READ = 8
"""Largest number of a camera's frames that are read to find its number of bits."""
MIN_TRACKING = 4
"""Smallest number of tracking frames from which a smooth motion can be followed."""
MAX_NAMED = 5
"""Largest number of lights that a sentence lists by name."""
Entry = dict[str, Any]
"""Keys and values of one table of ``raw.toml``."""
_TARGET_TABLES: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "board": (
            "[[board]]",
            'name = "board"',
            'type = "charuco"',
            "squares = [?, ?]",
            "square_mm = ?",
            "marker_mm = ?",
            'dictionary = "DICT_5X5_100"',
        ),
        "mirror-sphere": ("[[sphere]]", 'name = "mirror-sphere"', 'kind = "mirror"', "radius_mm = ?"),
        "white-sphere": (
            "[[sphere]]",
            'name = "white-sphere"',
            'kind = "white"',
            "radius_mm = ?",
            "reflectance = [?, ?, ?]",
        ),
        "chart": ("[[chart]]", 'name = "chart"', 'type = "colorchecker-24"', 'reference = "?.csv"'),
    }
)
"""Lines of ``raw.toml`` for each calibration target, with question marks for the values that a person must measure."""


@dataclass(frozen=True)
class Imported:
    """Result of an import.

    Attributes:
        folder: content of the ``raw.toml`` that was written.
        missing: one sentence for each thing that a preparation lacks or would profit from.
    """

    folder: RawFolder
    missing: tuple[str, ...]


def import_folder(
    root: Path,
    exposure_s: float | None,
    mosaic: str | None,
    calibration: Path | None,
    ignored: Collection[str] = (),
) -> Imported:
    """Write ``root/raw.toml`` from the names of the files in the folder.

    Args:
        root: folder of the photographs.
        exposure_s: exposure of files whose names do not give one.
        mosaic: pattern of cameras whose files hold one number a pixel and do not state their pattern.
        calibration: calibration of the rig.
        ignored: words of file names that have no meaning.

    Raises:
        CaptureInputError: a description exists already, no file's name can be interpreted, an exposure is not given,
            two names differ only in a word without a meaning, or a file or the calibration cannot be read; the message
            names the file.
    """
    if (root / DESCRIPTION).exists():
        raise CaptureInputError(f"{root / DESCRIPTION} exists; remove it, or edit it by hand.")
    listing = photographs_in(root)
    if not listing.photographs:
        remedy = f"put {', '.join(sorted(IMAGES - CAMERA_RAW))} or camera raw files there"
        seen = "".join(f" ({note[:-1]})" for note in listing.notes)
        raise CaptureInputError(f"{root} holds no photograph of counts{seen}; {remedy}.")
    if calibration is not None:
        read_record(calibration, Calibration)
    interpreted = {file: named_frame(file, {word.lower() for word in ignored}) for file in listing.photographs}
    frames = [one for one in interpreted.values() if isinstance(one, NamedFrame)]
    unnamed = [
        f"File {file} {why}, so it is left out; rename it, such as left_L07_0.05s.tif."
        for file, why in interpreted.items()
        if isinstance(why, str)
    ]
    if not frames:
        raise CaptureInputError(unnamed[0].replace(", so it is left out", ""))
    require_told_apart(frames)
    frames = [replace(one, exposure_s=1.0) if _needs_no_exposure(one) else one for one in frames]
    if exposure_s is None and (incomplete := [one.file for one in frames if one.exposure_s is None]):
        which = (
            f"File {incomplete[0]} does"
            if len(incomplete) == 1
            else f"File {incomplete[0]} and {len(incomplete) - 1} more do"
        )
        raise CaptureInputError(
            f"{which} not say the exposure; rename them, such as left_L07_0.05s.tif, or give --exposure-s for all of"
            " those."
        )
    scans = sorted(p.name for p in root.iterdir() if p.suffix.lower() in FORMATS)
    content = (
        description_toml(_tree(root, frames, exposure_s, mosaic, calibration))
        + _target_template(frames, exposure_s)
        + b"".join(_scan_template(scan, frames[0].camera) for scan in scans[:1])
    )
    folder = parse_raw_folder(content, str(root / DESCRIPTION))
    write_atomic(root / DESCRIPTION, content)
    targets = sorted({TARGET_KEYS[one.kind] for one in frames if one.kind in TARGET_KEYS})
    target_notes = [
        f"Frames of a {target} are written as comments, since its measures are not known; give them in raw.toml and"
        " take the # away."
        for target in targets
    ]
    return Imported(
        folder, (*listing.notes, *unused_words(frames), *unnamed, *target_notes, *_missing(root, folder, scans))
    )


def _needs_no_exposure(one: NamedFrame) -> bool:
    """Whether a photograph lacks an exposure that nothing uses: a JPEG of a board."""
    return one.exposure_s is None and Path(one.file).suffix.lower() in JPEG


def _tree(
    root: Path, frames: Sequence[NamedFrame], exposure_s: float | None, mosaic: str | None, calibration: Path | None
) -> Entry:
    cameras = dict.fromkeys(one.camera for one in frames)
    lights = sorted({one.light for one in frames if one.light is not None})
    tree: Entry = {"units": "mm"}
    if calibration is not None:
        tree["calibration"] = {"file": os.path.relpath(calibration, root)}
    tree["camera"] = [_camera(root, name, [one for one in frames if one.camera == name], mosaic) for name in cameras]
    tree["light"] = [{"name": name} for name in lights]
    tree["frame"] = [_frame(one, exposure_s) for one in frames if one.kind not in TARGET_KEYS]
    return tree


def _frame(one: NamedFrame, exposure_s: float | None) -> Entry:
    entry: Entry = {"camera": one.camera, "file": one.file, "kind": one.kind}
    entry["exposure_s"] = exposure_s if one.exposure_s is None else one.exposure_s
    if one.light is not None:
        entry["light"] = one.light
    if one.gain != 1.0:
        entry["gain"] = one.gain
    if one.place is not None:
        entry["place"] = one.place
    return entry


def _camera(root: Path, name: str, frames: Sequence[NamedFrame], mosaic: str | None) -> Entry:
    """Entry of a camera with its size, bits, mosaic and channels, from some of its files."""
    # Read the frames with the most light, because they use the most bits.
    of_counts = [one for one in frames if Path(one.file).suffix.lower() not in JPEG] or list(frames)
    bright = sorted(of_counts, key=lambda one: (one.kind == "black", -(one.exposure_s or 0) * one.gain))[:FRAMES_READ]
    decoded = [_decoded(root, one) for one in bright]
    first = decoded[0]
    height, width = first.values.shape[:2]
    entry: Entry = {"name": name, "size": [width, height]}
    channels = 1 if first.values.ndim == 2 else first.values.shape[2]
    if first.pattern is not None or (channels == 1 and mosaic is not None):
        entry["mosaic"] = first.pattern or mosaic
    elif channels != 3:
        entry["channels"] = ["grey"] if channels == 1 else [f"channel{k}" for k in range(channels)]
    if np.issubdtype(first.values.dtype, np.integer):
        entry |= _bits([one.values for one in decoded])
    return entry


def _decoded(root: Path, frame: NamedFrame) -> Decoded:
    try:
        path = root / frame.file
        return read_jpeg(path) if frame.kind == "board" and is_jpeg(path) else decode(path)
    except ValueError as problem:
        raise CaptureInputError(f"File {root / frame.file} {problem}.") from problem


def _bits(images: Iterable[np.ndarray]) -> Entry:
    """Number of bits and shift of integer images; low bits that are never set are taken for padding."""
    used, most = 0, 0
    for values in images:
        used |= int(np.bitwise_or.reduce(values.ravel().astype(np.uint16)))
        most = max(most, 8 * values.dtype.itemsize)
    shift = (used & -used).bit_length() - 1 if most == 16 and used else 0
    depth = next(bits for bits in DEPTHS if bits >= (used >> shift).bit_length()) if used else most
    if shift and depth + shift != most:
        shift, depth = 0, next(bits for bits in DEPTHS if bits >= used.bit_length())
    return {"bits": depth} | ({"shift": shift} if shift else {})


def _missing(root: Path, folder: RawFolder, scans: Sequence[str]) -> Iterator[str]:
    lit = {frame.light for frame in folder.frame if frame.kind == "light"}
    if len(folder.camera) > len(lit) > 0:
        yield (
            f"Names are read as those of {len(folder.camera)} cameras and {len(lit)} lights, with the camera first;"
            " rename the files, such as left_L07_0.05s.tif, where lights stand first."
        )
    for camera in folder.camera:
        name = camera.name
        if camera.bits is not None:
            yield (
                f"Camera {name} is taken to have {camera.bits} bits, by its largest count; correct bits where that is"
                " wrong."
            )
        if camera.channels == ("grey",):
            yield f"Camera {name} has one number a pixel and is taken to have no colours; give --mosaic if it has."
        if not folder.frames_of(name, "black"):
            yield f"Camera {name} has no black frame (kind black), without which its zero is unknown."
        if not folder.frames_of(name, "flat"):
            yield f"Camera {name} has no flat frame; two of one exposure would tell its noise and its fall of light."
        if len(folder.frames_of(name, "tracking")) < MIN_TRACKING:
            yield (
                f"Camera {name} has fewer than {MIN_TRACKING} tracking frames (all lights on), so motion is followed"
                " less well; for a subject that cannot move give motion = 'off' in the job."
            )
        elif _is_out_of_order(folder, name):
            yield (
                f"Tracking frames of camera {name} all stand before or after its lights, as names do not tell when they"
                " were taken, and motion would be followed wrongly: put the [[frame]] entries in the order taken, or"
                " give each its time_s."
            )
        if missing_lights := sorted(
            str(one) for one in lit - {frame.light for frame in folder.frames_of(name, "light")}
        ):
            shown = ", ".join(missing_lights[:MAX_NAMED]) + (" and more" if len(missing_lights) > MAX_NAMED else "")
            yield f"Camera {name} has no frame of light {shown}, which another camera has."
    if not lit:
        yield "No frame shows teeth under a light (kind light)."
    if folder.calibration is None:
        yield "No calibration is named; add [calibration] file, or give a job one by its option 'calibration'."
    if not any((root / subject).is_dir() for subject in ("teeth", "object")) and folder.scan is None:
        found = f"; lines to be filled in for {scans[0]} stand at the end of {DESCRIPTION}" if scans else ""
        yield (
            "There are no teeth; add teeth/<FDI>/outer.ply, or a [scan] and landmarks, which are clicked in the page of"
            f" dentine landmarks{found}."
        )


def _is_out_of_order(folder: RawFolder, camera: str) -> bool:
    """Whether all tracking frames come before or after all light frames, and a frame lacks its time."""
    own = [frame for frame in folder.frame if frame.camera == camera and frame.kind in {"light", "tracking"}]
    changes = sum(one.kind != other.kind for one, other in pairwise(own))
    return changes == 1 and any(frame.time_s is None for frame in own)


def _scan_template(file: str, camera: str) -> bytes:
    """Comment lines with the entry of a scan and of one landmark, to be filled in."""
    lines = ["", "[scan]", f'file = "{file}"', 'units = "mm"', 'jaw = "upper"', ""]
    lines += ["[[landmark]]", "tooth = ?", 'point = "edge"', "xyz_mm = [?, ?, ?]"]
    lines += [f'pixels = [{{camera = "{camera}", xy_px = [?, ?]}}]']
    return _commented(lines)


def _target_template(frames: Sequence[NamedFrame], exposure_s: float | None) -> bytes:
    """Comment lines with the calibration targets that frames show, to be filled in, and with those frames."""
    shown = [one for one in frames if one.kind in TARGET_KEYS]
    templates = {kind: _TARGET_TABLES[kind] for kind in dict.fromkeys(one.kind for one in shown)}
    lines = [line for template in templates.values() for line in ("", *template)]
    for one in shown:
        entry = _frame(one, exposure_s) | {TARGET_KEYS[one.kind]: one.kind}
        lines += ["", "[[frame]]", *(f"{name} = {toml_value(value)}" for name, value in entry.items())]
    return _commented(lines)


def _commented(lines: Iterable[str]) -> bytes:
    return "".join(f"# {line}\n" if line else "\n" for line in lines).encode()
