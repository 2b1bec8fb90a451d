"""The folder in which a preparation is made, and what of an earlier attempt at it can be gone on with.

::

    JOB/
      .prepared.<attempt>/      the store being written
      .prepared.work/
        plan.json               digest of all that the store depends on
        <camera>/               footprint and black image as .npy, view.json, measures.json, motion-<frame>.json,
        flow.json, image-<light>.json

A record is written last, once what it speaks of is on the disk, so a kill at any moment costs what was being made and
nothing else.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import zarr

from services.core.geometry import Camera, Record
from services.core.store import StageWriter, write_atomic, write_record
from services.preprocess.projection import Footprint
from services.preprocess.scratch import write_array
from services.preprocess.source import Motions, View
from services.preprocess.tasks.records import FlowDone, FrameMotion, ImageDone, StoredFile, ViewDone

R = TypeVar("R", bound=Record)
STAGE = "prepared"
WORK = ".prepared.work"
PLAN = "plan.json"
FOOTPRINT = ("mesh", "depth_mm", "normal", "covered")


class _Plan(Record):
    digest: str


class Workshop:
    """One attempt's hold on the folders; it travels to the workers.

    Args:
        writer: of the stage.
    """

    def __init__(self, writer: StageWriter) -> None:
        self.writer = writer

    @property
    def folder(self) -> Path:
        """Of the store being written."""
        return self.writer.folder

    @property
    def work(self) -> Path:
        """Of what is not published."""
        return self.writer.root / WORK

    def begin(self, digest: str) -> bool:
        """Take over what an attempt at the same store has left, or clear all away; returns whether there was something.

        Args:
            digest: of all that the store depends on.
        """
        earlier = sorted(self._attempts(), key=lambda path: int(path.name.rpartition(".")[2]))
        left = [path for path in earlier if (path / "prepared.zarr").is_dir()]
        plan = _read(self.work / PLAN, _Plan)
        kept = left[-1] if plan is not None and plan.digest == digest and left else None
        if kept is None:
            # First what says that there is something to go on with
            (self.work / PLAN).unlink(missing_ok=True)
            shutil.rmtree(self.work, ignore_errors=True)
        for path in earlier:
            if path != kept:
                shutil.rmtree(path, ignore_errors=True)
        if kept is None:
            self.folder.mkdir(exist_ok=True)
            self.work.mkdir()
        elif kept != self.folder:
            kept.rename(self.folder)
        return kept is not None

    def announce(self, digest: str) -> None:
        """The empty store is there, to be gone on with from now on."""
        write_record(self.work / PLAN, _Plan(digest=digest))

    def end(self) -> None:
        """Remove what is not published."""
        shutil.rmtree(self.work, ignore_errors=True)

    def array(self, name: str) -> zarr.Array[Any]:
        """An array of the store being written."""
        return zarr.open_array(self.folder / "prepared.zarr" / name, mode="r+")

    def scratch(self, camera: int) -> Path:
        """Folder of what a camera's blocks share."""
        return self.work / str(camera)

    def put_view(self, view: View) -> None:
        """Keep a camera's window and footprint."""
        folder = self.scratch(view.number)
        for name in FOOTPRINT:
            write_array(folder / f"{name}.npy", getattr(view.footprint, name))
        window = view.window
        self._put(folder / "view.json", ViewDone(window=(window.top, window.bottom, window.left, window.right)))

    def view(self, camera: int, whole: Camera) -> View | None:
        """A camera's view, its arrays mapped from the disk; None where it has not been found yet."""
        folder = self.scratch(camera)
        done = _read(folder / "view.json", ViewDone)
        if done is None:
            return None
        arrays = {name: np.asarray(np.load(folder / f"{name}.npy", mmap_mode="r")) for name in FOOTPRINT}
        window = done.of()
        return View(camera, whole, window, window.cropped(whole), Footprint(**arrays), folder)

    def put_motion(self, camera: int, frame: int, motion: FrameMotion) -> None:
        """Keep a frame's motion."""
        self._put(self.scratch(camera) / f"motion-{frame}.json", motion)

    def motions(self, camera: int, frames: tuple[int, ...]) -> Motions:
        """What is known of some frames' motion."""
        found = {frame: _read(self.scratch(camera) / f"motion-{frame}.json", FrameMotion) for frame in frames}
        return {frame: np.asarray(one.coefficients) for frame, one in found.items() if one is not None}

    def put_flow(self, camera: int, done: FlowDone) -> None:
        """Say that a camera's flow was looked at and its pictures are written."""
        self._put(self.scratch(camera) / "flow.json", done)

    def flow(self, camera: int) -> FlowDone | None:
        """What flow sees of a camera's motion; None where it was not looked at yet."""
        return _read(self.scratch(camera) / "flow.json", FlowDone)

    def put_image(self, camera: int, light: int, done: ImageDone) -> None:
        """Say that an image is stored."""
        self._put(self.scratch(camera) / f"image-{light}.json", done)

    def image(self, camera: int, light: int) -> ImageDone | None:
        """What was made of an image; None where it is not stored whole."""
        done = self.record(camera, light)
        if done is None:
            return None
        sizes = {name: one.bytes for name, one in done.files.items()}
        is_whole = all(
            (self.folder / name).is_file() and (self.folder / name).stat().st_size == size
            for name, size in sizes.items()
        )
        return done if is_whole else None

    def record(self, camera: int, light: int) -> ImageDone | None:
        """What was last said of an image, whether or not its files are still those."""
        return _read(self.scratch(camera) / f"image-{light}.json", ImageDone)

    def is_shaded(self, camera: int, light: int) -> bool:
        """Whether an image is stored and shadows were looked for in it."""
        done = self.image(camera, light)
        return done is not None and done.shaded

    def files_of(self, camera: int, light: int, picture: Path) -> dict[str, StoredFile]:
        """The files of an image as they are now."""
        shards = sorted((self.folder / "prepared.zarr").glob(f"*/c/{camera}/{light}/**/*"))
        found = {}
        for path in [*shards, picture]:
            if path.is_file() and not path.name.endswith(".partial"):
                with path.open("rb") as stream:
                    sha256 = hashlib.file_digest(stream, "sha256").hexdigest()
                found[path.relative_to(self.folder).as_posix()] = StoredFile(bytes=path.stat().st_size, sha256=sha256)
        return found

    def _put(self, path: Path, record: Record) -> None:
        # An attempt that was overtaken says nothing any more
        self.writer.require_lease()
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, record.model_dump_json().encode())

    def _attempts(self) -> Iterator[Path]:
        prefix = f".{STAGE}."
        for path in self.writer.root.glob(f"{prefix}*"):
            if path.is_dir() and path.name.removeprefix(prefix).isdigit():
                yield path


def _read(path: Path, kind: type[R]) -> R | None:
    return kind.model_validate_json(path.read_bytes()) if path.is_file() else None
