"""Checks the contents of received files before their capture is accepted, by what they declare; no image is decoded."""

from __future__ import annotations

import math
from pathlib import Path, PurePosixPath
from typing import Any

from pydantic import ValidationError
from pydantic_core import from_json

from services.core.calibration.record import require_own_files
from services.core.errors import CaptureInputError
from services.core.files.image_headers import declared
from services.core.files.image_metadata import metadata_fault
from services.core.files.validation import fault_of, first_error, parse_record
from services.core.raw.folder import DESCRIPTION, parse_raw_folder
from services.core.raw.records import RawFolder
from services.core.records import FolderCapture
from services.core.results import CaptureManifest
from services.core.settings import UploadLimits
from services.core.slab.folder import SlabFolder

MAX_TIMES_PACKED = 1100
"""Largest ratio of the size that an image declares to the size of its file. Deflate packs at most 1032 to 1, so a
larger ratio belongs to a decompression bomb or a torn file."""
_ITEM_BYTES = {
    "bool": 1,
    "int8": 1,
    "uint8": 1,
    "int16": 2,
    "uint16": 2,
    "float16": 2,
    "int32": 4,
    "uint32": 4,
    "float32": 4,
}
_PIXEL_BYTES, _SLAB_PIXEL_BYTES = 4, 8


def content_fault(path: Path, name: str, limits: UploadLimits, names: frozenset[str]) -> str | None:
    """Describe in one sentence what is wrong with the content of one file; None if nothing is.

    Args:
        path: path of the content on this machine.
        name: its path in the capture.
        names: paths of all files of the capture.
    """
    pure = PurePosixPath(name)
    try:
        if name == "capture.json":
            return _description_fault(name, parse_record(path.read_bytes(), FolderCapture, name), limits, names)
        if name == DESCRIPTION:
            return _raw_fault(name, parse_raw_folder(path.read_bytes(), name), limits, names)
        if name == "slab.json":
            return _slab_fault(name, parse_record(path.read_bytes(), SlabFolder, name), limits, names)
        if name == "manifest.json":
            return _published_fault(name, from_json(path.read_bytes()), limits, names)
        if pure.name == "zarr.json":
            return _array_fault(name, from_json(path.read_bytes()), limits)
        return _image_fault(path, name, pure.suffix.lower(), limits)
    except CaptureInputError as problem:
        return problem.message
    except ValidationError as problem:
        return f"{name}: {fault_of(first_error(problem), CaptureManifest)}."
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError, AttributeError) as problem:
        return f"{name} cannot be read: {str(problem) or type(problem).__name__}; export it again."


def _image_fault(path: Path, name: str, suffix: str, limits: UploadLimits) -> str | None:
    image = declared(path, suffix)
    if image is None:
        return None
    size = path.stat().st_size
    if image.decoded_bytes > limits.largest_image_bytes:
        return (
            f"Image {name} declares {image.size}, more than {limits.largest_image_bytes} bytes when decoded; crop or"
            " bin it."
        )
    if image.file_bytes is not None and image.file_bytes != size:
        return (
            f"Image {name} declares {image.size} and has {size} bytes instead of {image.file_bytes}; export it again."
        )
    if image.decoded_bytes > MAX_TIMES_PACKED * size:
        return f"Image {name} declares {image.size} in {size} bytes, which no photograph packs to; export it again."
    return metadata_fault(path, name, suffix)


def _description_fault(
    name: str, description: FolderCapture, limits: UploadLimits, names: frozenset[str]
) -> str | None:
    for camera in description.cameras:
        if math.prod(camera.size) * len(description.channels) * _PIXEL_BYTES > limits.largest_image_bytes:
            size = " x ".join(map(str, camera.size))
            return (
                f"{name}: camera {camera.name} has {size} pixels, more than {limits.largest_image_bytes} bytes when"
                " decoded; crop or bin its images."
            )
    require_own_files(description, name)
    for image in description.images:
        for file in (image.file, image.variance_file):
            if file is not None and str(PurePosixPath(file)) not in names:
                return f"{name} names image file {file}, which is not among the files; add it or remove its entry."
    return None


def _raw_fault(name: str, folder: RawFolder, limits: UploadLimits, names: frozenset[str]) -> str | None:
    for camera in folder.camera:
        if math.prod(camera.size) * len(camera.channels) * _PIXEL_BYTES > limits.largest_image_bytes:
            size = " x ".join(map(str, camera.size))
            return (
                f"{name}: camera {camera.name} has {size} pixels, more than {limits.largest_image_bytes} bytes when"
                " decoded; crop or bin its images."
            )
    files = [(f"image file {frame.file}", frame.file) for frame in folder.frame]
    files += [(f"reference {chart.reference}", chart.reference) for chart in folder.chart]
    files += [] if folder.scan is None else [(f"scan {folder.scan.file}", folder.scan.file)]
    files += [] if folder.calibration is None else [(f"calibration {folder.calibration.file}", folder.calibration.file)]
    absent = next((what for what, file in files if str(PurePosixPath(file)) not in names), None)
    return (
        None if absent is None else f"{name} names {absent}, which is not among the files; add it or remove its entry."
    )


def _slab_fault(name: str, folder: SlabFolder, limits: UploadLimits, names: frozenset[str]) -> str | None:
    if folder.pixels.columns * folder.pixels.rows * _SLAB_PIXEL_BYTES > limits.largest_image_bytes:
        size = f"{folder.pixels.columns} x {folder.pixels.rows}"
        return f"{name} has images of {size} pixels, more than {limits.largest_image_bytes} bytes; bin them."
    for file in folder.files():
        if str(PurePosixPath(file)) not in names:
            return f"{name} names image file {file}, which is not among the files; add it or remove its entry."
    return None


def _published_fault(name: str, manifest: Any, limits: UploadLimits, names: frozenset[str]) -> str | None:
    if absent := sorted(set(manifest["files"]) - names):
        return f"{name} lists {absent[0]}, which is not among the files; add it."
    return _description_fault(name, CaptureManifest.model_validate(manifest["record"]).description, limits, names)


def _array_fault(name: str, array: Any, limits: UploadLimits) -> str | None:
    if array["node_type"] != "array":
        return None
    lengths = [int(length) for length in array["chunk_grid"]["configuration"]["chunk_shape"]]
    if math.prod(lengths) * _ITEM_BYTES.get(str(array["data_type"]), 8) > limits.largest_image_bytes:
        size = " x ".join(map(str, lengths))
        return (
            f"{name} declares chunks of {size} numbers, more than {limits.largest_image_bytes} bytes when decoded;"
            " export it in smaller ones."
        )
    return None
