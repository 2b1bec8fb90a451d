"""The layout of a job on disk, which no other module knows.

::

    JOB/
      phantom/     published by the phantom stage, of a demonstration alone
      capture/     published by the capture stage
      registered/  published by the register stage, where a raw folder has a scan and no teeth
      registration/          pictures of a registration that was refused
      prepared/    published by the prepare stage
      fit/         published by the fit stage
      asset/       published by the export stage
      <stage>.lease          highest attempt that has started the stage
      .<stage>.lock          held while the lease is compared and written, and while the stage is published
      .<stage>.<attempt>/    being written; never read by others

A stage is written into its own hidden folder and published by one rename, with ``manifest.json`` inside that lists
every file's size and SHA-256 and the stage's record. A reader sees all of a stage or none of it, and a missing shard,
which zarr would read as zeros, is an error here.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import os
import secrets
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from services.core.errors import (
    CaptureInputError,
    CorruptStoreError,
    DiskFullError,
    FencedError,
    MissingStageError,
    ReadOnlyStoreError,
)
from services.core.files.object_store import array_location, discard, remote_folder
from services.core.files.validation import parse_record
from services.core.geometry import Record

if TYPE_CHECKING:
    import zarr

R = TypeVar("R", bound=Record)
FORMAT_VERSION = 1
MANIFEST = "manifest.json"
CHUNK_PX = 512
"""Edge of an image's chunks, pixels; a chunk is read, or left empty, as a whole. Whole rows, or 256 or 1024 px, took
longer to write a tooth's window; with one chunk for a whole image, reading the window takes 1.6 times as long."""
NOTHING_KNOWN: Mapping[str, tuple[int, str]] = MappingProxyType({})


def write_atomic(path: Path, content: bytes) -> None:
    """Write a file so that a reader sees the old or the new content, also after a power cut."""
    # The name is random, because threads share a process id, and so may hosts or containers that share a disk.
    partial = path.with_name(f".{path.name}.{secrets.token_hex(8)}.partial")
    try:
        with partial.open("xb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        partial.replace(path)
    except BaseException:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
        raise
    sync_to_disk(path.parent)


def sync_to_disk(path: Path) -> None:
    """Make a file's content, or the names in a folder, survive a power cut."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def write_record(path: Path, record: Record) -> None:
    """Write a record as readable JSON, atomically."""
    write_atomic(path, (record.model_dump_json(indent=1) + "\n").encode())


def read_record(path: Path, kind: type[R]) -> R:
    """Read a record that a person or a program wrote.

    Raises:
        CaptureInputError: the file is absent, no JSON, or no record of this kind; the message names the first wrong
            field.
    """
    if not path.is_file():
        raise CaptureInputError(f"{path} does not exist; check the path.")
    return parse_record(path.read_bytes(), kind, str(path))


class StageWriter:
    """One attempt's right to write one stage."""

    def __init__(self, root: Path, stage: str, attempt: int) -> None:
        """Take the stage's lease for this attempt.

        Raises:
            FencedError: a newer attempt has started this stage.
        """
        self.root, self.stage, self.attempt = Path(root), stage, attempt
        self.root.mkdir(parents=True, exist_ok=True)
        with self._locked():
            self.require_lease(starting=True)
            write_atomic(self._lease, str(attempt).encode())
        self.folder = self.root / f".{stage}.{attempt}"
        self.folder.mkdir(exist_ok=True)

    @property
    def _lease(self) -> Path:
        return self.root / f"{self.stage}.lease"

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Hold the stage's lock, so that no other attempt starts or publishes the stage meanwhile; the system releases
        the lock however this process ends.
        """
        with (self.root / f".{self.stage}.lock").open("w") as stream:
            fcntl.flock(stream, fcntl.LOCK_EX)
            yield

    def require_lease(self, *, starting: bool = False) -> None:
        """Raise FencedError if a newer attempt has started the stage. Call before every durable write."""
        newest = int(self._lease.read_text()) if self._lease.exists() else 0
        if newest > self.attempt or (not starting and newest != self.attempt):
            raise FencedError(
                f"Attempt {self.attempt} of stage {self.stage} was overtaken by attempt {newest}; its writes are"
                " refused."
            )

    def publish(self, record: Record, known: Mapping[str, tuple[int, str]] = NOTHING_KNOWN) -> Path:
        """Make everything in ``folder`` visible at once as ``root/stage``; returns that path.

        Args:
            known: size and SHA-256 of files, by name, as their writers computed them; a file of another size is hashed
                again.
        """
        files = {}
        for path in sorted(
            p for p in self.folder.rglob("*") if p.is_file() and not p.name.endswith(".partial") and p.name != MANIFEST
        ):
            name, size = path.relative_to(self.folder).as_posix(), path.stat().st_size
            known_size, known_sha256 = known.get(name, (-1, ""))
            files[name] = {"bytes": size, "sha256": known_sha256 if known_size == size else sha256_of(path)}
        manifest = {
            "format": FORMAT_VERSION,
            "stage": self.stage,
            "attempt": self.attempt,
            "files": files,
            "record": json.loads(record.model_dump_json()),
        }
        write_atomic(self.folder / MANIFEST, (json.dumps(manifest, indent=1) + "\n").encode())
        final, retired = self.root / self.stage, self.root / f".{self.stage}.retired"
        with self._locked():
            self.require_lease()
            if final.exists():
                discard(retired)
                final.rename(retired)
            self.folder.rename(final)
            sync_to_disk(self.root)
        discard(retired)
        return final


def withdraw(root: Path, stage: str) -> None:
    """Remove a stage's published result by one rename, so that readers see all of it or nothing."""
    published, retired = Path(root) / stage, Path(root) / f".{stage}.retired"
    discard(retired)
    if published.exists():
        published.rename(retired)
        sync_to_disk(Path(root))
        discard(retired)


def is_published(root: Path, stage: str) -> bool:
    """Whether the stage has a complete result."""
    return (Path(root) / stage / MANIFEST).is_file()


def open_stage(root: Path, stage: str, kind: type[R], *, verify: bool = True) -> tuple[Path, R]:
    """Open a published stage: its folder and its record.

    Args:
        verify: compare every file's size and SHA-256 with the manifest.

    Raises:
        MissingStageError: the stage is not published. CorruptStoreError: a file is not as it was published; the message
            names the first one.
    """
    folder, manifest = Path(root) / stage, _manifest(Path(root), stage)
    if verify:
        _require_intact(folder, stage, manifest["files"])
    try:
        return folder, kind.model_validate(manifest["record"])
    except ValidationError as problem:
        what = f"{folder / MANIFEST} of published stage {stage} holds no {kind.__name__} of this version"
        raise CorruptStoreError(f"{what}; {_remedy(stage)}.") from problem


def require_intact(root: Path, stage: str) -> None:
    """Compare every file of a published stage with what was published.

    Raises:
        MissingStageError: the stage is not published. CorruptStoreError: a file is not as it was published; the message
            names the first one.
    """
    _require_intact(Path(root) / stage, stage, _manifest(Path(root), stage)["files"])


def published_record(root: Path, stage: str) -> dict[str, Any]:
    """The record of a published stage as it is stored, without validation.

    Raises:
        MissingStageError: the stage is not published. CorruptStoreError: the record cannot be read.
    """
    return dict(_manifest(Path(root), stage)["record"])


def _manifest(root: Path, stage: str) -> dict[str, Any]:
    if not is_published(root, stage):
        raise MissingStageError(f"Stage {stage} has no published result in {root}; run the job from that stage.")
    path = root / stage / MANIFEST
    try:
        manifest = json.loads(path.read_bytes())
        return {"files": dict(manifest["files"]), "record": manifest["record"]}
    except (ValueError, KeyError, TypeError, RecursionError) as problem:
        raise CorruptStoreError(
            f"{path}, the list of what stage {stage} published, cannot be read; {_remedy(stage)}."
        ) from problem


def _require_intact(folder: Path, stage: str, files: dict[str, Any]) -> None:
    for name, expected in files.items():
        path = folder / name
        if not path.is_file():
            raise CorruptStoreError(f"{path} is missing from published stage {stage}; {_remedy(stage)}.")
        if path.stat().st_size != expected["bytes"]:
            what = (
                f"{path} of published stage {stage} has {path.stat().st_size} bytes instead of {expected['bytes']}"
                " (truncated?)"
            )
            raise CorruptStoreError(f"{what}; {_remedy(stage)}.")
        if sha256_of(path) != expected["sha256"]:
            raise CorruptStoreError(
                f"{path} of published stage {stage} differs from its published checksum; {_remedy(stage)}."
            )
        if path.suffix == ".zarr" and (remote := remote_folder(path)) is not None:
            remote.require_intact(_remedy(stage))


def _remedy(stage: str) -> str:
    # A capture's photographs cannot be computed again.
    return (
        "restore it or capture again"
        if stage == "capture"
        else f"restore it, or retry the job, which then makes {stage} anew"
    )


def create_array(
    folder: Path,
    name: str,
    shape: tuple[int, ...],
    shard: tuple[int, ...],
    dtype: str,
    dimensions: tuple[str, ...],
    chunk: tuple[int, ...] | None = None,
    codec: Literal["zstd", "lz4"] = "zstd",
) -> zarr.Array[Any]:
    """Create a zarr v3 array at the place that ``array_location`` gives.

    Each shard may have only one writer. ``shard`` is also the shape of a chunk unless ``chunk`` divides it.

    Args:
        codec: compression; lz4 takes a third of zstd's time and 5 % more space for noisy single-precision numbers.
    """
    import zarr
    from zarr.codecs import BloscCodec, Crc32cCodec

    return zarr.create_array(
        array_location(folder / name),
        shape=shape,
        chunks=chunk or shard,
        shards=shard if chunk else None,
        dtype=dtype,
        fill_value=0,
        compressors=[BloscCodec(cname=codec, clevel=1, shuffle="bitshuffle"), Crc32cCodec()],
        dimension_names=dimensions,
    )


def image_pieces(height: int, width: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """Shapes (rows, columns) of chunk and shard for arrays of large images.

    A shard holds a whole image in one file, and chunks let a window of it be read alone.
    """
    chunk = min(CHUNK_PX, height), min(CHUNK_PX, width)
    rows, columns = (-(-length // edge) * edge for length, edge in zip((height, width), chunk, strict=True))
    return chunk, (rows, columns)


def writable_array(path: Path) -> zarr.Array[Any]:
    """Open an array that ``create_array`` has made, for writing."""
    import zarr

    return zarr.open_array(array_location(path), mode="r+", zarr_format=3)


class StoredArray:
    """An array on disk or on a server, read by indexing.

    Raises:
        CorruptStoreError: the array does not exist, or a requested chunk is damaged; the message names the array.
    """

    def __init__(self, path: Path) -> None:
        import zarr

        self._path = path
        with self._translate_read_errors():
            self._array = zarr.open_array(array_location(path), mode="r", zarr_format=3)

    def __getitem__(self, selection: Any) -> NDArray[Any]:
        with self._translate_read_errors(requested=(selection,)):
            return np.asarray(self._array[selection])

    @contextmanager
    def _translate_read_errors(self, requested: tuple[Any, ...] = ()) -> Iterator[None]:
        try:
            yield
        except (FileNotFoundError, ValueError, RuntimeError) as problem:
            for selection in requested:
                # A selection that no array of this shape has is the caller's mistake; this statement raises its error.
                np.broadcast_to(np.empty((), dtype=bool), self._array.shape)[selection]
            raise CorruptStoreError(
                f"{self._path} cannot be read ({problem}); restore it or run its stage again."
            ) from problem


@contextmanager
def translate_disk_errors(root: Path) -> Iterator[None]:
    """Replace the error of a full or read-only disk by this project's error for it.

    Raises:
        DiskFullError, ReadOnlyStoreError: once the cause is removed, the job goes on from what it had published.
    """
    try:
        yield
    except OSError as problem:
        place = problem.filename or root
        if problem.errno in {errno.ENOSPC, errno.EDQUOT}:
            what = f"The disk was full at {place}; free some space, the job goes on from what it had published."
            raise DiskFullError(
                what,
                {"free_disk_bytes": shutil.disk_usage(next(one for one in (root, *root.parents) if one.exists())).free},
            ) from problem
        if problem.errno == errno.EROFS:
            raise ReadOnlyStoreError(
                f"The store is read-only at {place}; make it writable, the job goes on from what it had published."
            ) from problem
        raise
