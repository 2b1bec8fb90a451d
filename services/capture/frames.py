"""Durable storage of frames: acknowledged frames survive a crash, and the next attempt resumes after them.

::

    .capture.<attempt>/
      capture.zarr/        (camera, frame, y, x, channel) uint16, one shard per camera and frame
      journal.jsonl        line 1: fingerprint of the capture's inputs; then one line per acknowledged frame, with its
                           FrameRecord and each shard's size and SHA-256

A frame is acknowledged by its journal line, which is written and fsynced after its shards and their folders.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from pydantic import ValidationError

from services.core.errors import StoreError
from services.core.geometry import Record
from services.core.results import FrameRecord
from services.core.store import StageWriter, create_array, image_pieces, sync_to_disk, write_atomic

ARRAY = "capture.zarr"
JOURNAL = "journal.jsonl"
DIMENSIONS = ("camera", "frame", "y", "x", "channel")


class Acknowledged(Record):
    """One line of the journal: a frame's record, and name, size in bytes and SHA-256 of each of its shards."""

    frame: FrameRecord
    shards: tuple[tuple[str, int, str], ...]


class FrameStore:
    """The capture array being written, with the journal of its acknowledged frames."""

    def __init__(self, writer: StageWriter, shape: tuple[int, int, int, int, int], fingerprint: str) -> None:
        """Open the attempt's folder and adopt the acknowledged frames of the newest attempt with the same fingerprint.

        Args:
            writer: writer of the stage.
            shape: cameras, frames, height, width, channels; images of smaller cameras are padded with zeros.
            fingerprint: digest that is equal for two captures exactly when their frames may be mixed.
        """
        self._writer, self._folder = writer, writer.folder
        self._header = json.dumps(
            {"fingerprint": fingerprint, "shape": shape, "pieces": image_pieces(shape[2], shape[3])}
        )
        lines: list[Acknowledged] = []
        source = self._newest_leftover()
        if source is not None:
            lines = list(_intact(source, self._header))
        if source != self._folder:
            self._start(shape)
            for line in lines:
                _link_shards(source or self._folder, self._folder, line)
        self._array = zarr.open_array(self._folder / ARRAY, mode="r+", config={"write_empty_chunks": True})
        self.acknowledged = {line.frame.index: line.frame for line in lines}
        text = "\n".join([self._header, *(line.model_dump_json() for line in lines)]) + "\n"
        write_atomic(self._folder / JOURNAL, text.encode())

    def store(self, frame: FrameRecord, images: Sequence[NDArray[np.uint16]]) -> None:
        """Store one frame of all cameras; after the return it survives a power cut.

        Args:
            frame: record of the frame.
            images: counts (height, width, channel) of each camera.

        Raises:
            FencedError: a newer attempt owns the stage. StoreError: the disk cannot store the frame.
        """
        self._writer.require_lease()
        try:
            for camera, image in enumerate(images):
                padded = np.zeros(self._array.shape[2:], dtype=np.uint16)
                padded[: image.shape[0], : image.shape[1]] = image
                self._array[camera, frame.index] = padded
            names = [f"c/{camera}/{frame.index}/0/0/0" for camera in range(len(images))]
            shards = tuple((name, *_digest_durably(self._folder / ARRAY, name)) for name in names)
            line = Acknowledged(frame=frame, shards=shards).model_dump_json() + "\n"
            with (self._folder / JOURNAL).open("a") as journal:
                journal.write(line)
                journal.flush()
                os.fsync(journal.fileno())
        except OSError as problem:
            raise StoreError(
                f"Frame {frame.index} cannot be stored in {self._folder} ({problem.strerror}); free the disk and run"
                " the job again, it resumes there."
            ) from problem
        self.acknowledged[frame.index] = frame

    def frames(self) -> tuple[FrameRecord, ...]:
        """Acknowledged frames in the order of their indices."""
        return tuple(self.acknowledged[index] for index in sorted(self.acknowledged))

    def remove_leftovers(self) -> None:
        """Delete the folders of earlier attempts, once this one is published."""
        for folder in self._attempts():
            shutil.rmtree(folder, ignore_errors=True)

    def _attempts(self) -> list[Path]:
        prefix = f".{self._writer.stage}."
        attempts = [p for p in self._writer.root.glob(f"{prefix}*") if p.name.removeprefix(prefix).isdigit()]
        return sorted(
            (p for p in attempts if int(p.name.removeprefix(prefix)) <= self._writer.attempt),
            key=lambda p: -int(p.name.removeprefix(prefix)),
        )

    def _newest_leftover(self) -> Path | None:
        for folder in self._attempts():
            journal = folder / JOURNAL
            if (
                journal.is_file()
                and (folder / ARRAY / "zarr.json").is_file()
                and journal.read_text().partition("\n")[0] == self._header
            ):
                return folder
        return None

    def _start(self, shape: tuple[int, int, int, int, int]) -> None:
        shutil.rmtree(self._folder)
        self._folder.mkdir()
        chunk, shard = image_pieces(shape[2], shape[3])
        pieces = (1, 1, *shard, shape[4]), "uint16", DIMENSIONS, (1, 1, *chunk, shape[4])
        create_array(self._folder, ARRAY, shape, *pieces)
        _digest_durably(self._folder / ARRAY, "zarr.json")
        sync_to_disk(self._writer.root)


def _intact(folder: Path, header: str) -> Iterator[Acknowledged]:
    """Yield the journal lines whose shards still match them.

    Incomplete lines and damaged frames are left out, so that they are captured again.
    """
    text = (folder / JOURNAL).read_text()
    assert text.startswith(header)
    for row in text.split("\n")[1:-1]:
        try:
            line = Acknowledged.model_validate_json(row)
        except ValidationError:
            continue
        if all(_digest(folder / ARRAY / name) == (size, sha256) for name, size, sha256 in line.shards):
            yield line


def _digest(path: Path) -> tuple[int, str] | None:
    if not path.is_file():
        return None
    content = path.read_bytes()
    return len(content), hashlib.sha256(content).hexdigest()


def _digest_durably(array: Path, name: str) -> tuple[int, str]:
    """Fsync a file and every folder from it up to the array; return the file's size in bytes and its SHA-256."""
    path = array / name
    for entry in [path, *path.parents[: len(Path(name).parts)]]:
        sync_to_disk(entry)
    content = path.read_bytes()
    return len(content), hashlib.sha256(content).hexdigest()


def _link_shards(source: Path, target: Path, line: Acknowledged) -> None:
    """Adopt a frame's shards by hard links, or by copies where links are impossible.

    Links are safe, because an older attempt that is still running replaces files and never modifies them.
    """
    for name, _, _ in line.shards:
        path = target / ARRAY / name
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(source / ARRAY / name, path)
        except OSError:
            shutil.copyfile(source / ARRAY / name, path)
        _digest_durably(target / ARRAY, name)


def fingerprint(*parts: Any) -> str:
    """SHA-256 of the JSON of all inputs that determine a frame's pixels."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()
