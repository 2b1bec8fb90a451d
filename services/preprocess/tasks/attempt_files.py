"""The folder in which a preparation is made, and what of an earlier attempt at it can be gone on with.

::

    JOB/
      .prepared.<attempt>/      the store being written; where a job names a URL, a file in it says where its arrays are
      .prepared.work/
        plan.json               digest of all that the store depends on
        <camera>/               footprint, relief, black image and its level as .npy, view.json, measures.json,
                                flow.json, motion-<frame>.json, image-<light>.json

A record is written last, once what it speaks of is on the disk, so a kill at any moment costs what was being made and
nothing else.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import zarr

from services.core.files.object_store import RemoteFolder, StoredObject, discard, new_remote_folder, remote_folder
from services.core.geometry import Camera, Record
from services.core.store import StageWriter, writable_array, write_atomic, write_record
from services.preprocess.projection import Footprint
from services.preprocess.scratch import write_array
from services.preprocess.source import Motions, View
from services.preprocess.tasks.records import FlowDone, FrameMotion, ImageDone, StoredFile, ViewDone

R = TypeVar("R", bound=Record)
STAGE = "prepared"
ARRAYS = "prepared.zarr"
OF_AN_IMAGE = ("radiance", "variance", "valid", "motion", "shadow")
"""The arrays in which each image has a shard of its own."""
WORK = ".prepared.work"
PLAN = "plan.json"
FOOTPRINT = ("mesh", "depth_mm", "normal", "covered")


class _Plan(Record):
    digest: str


class AttemptFiles:
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

    @property
    def arrays(self) -> Path:
        """Where the arrays lie, or the file that says at which URL they are."""
        return self.folder / ARRAYS

    def begin(self, digest: str, url: str | None = None) -> bool:
        """Take over what an attempt at the same store has left, or clear all away; returns whether there was something.

        Args:
            digest: of all that the store depends on.
            url: below which the arrays are to be kept; None to keep them in the folder.

        Raises:
            StoreError: the server of the arrays refuses or does not answer.
            PlatformError: what speaks to it is not installed.
        """
        earlier = sorted(self._attempts(), key=lambda path: int(path.name.rpartition(".")[2]))
        left = [path for path in earlier if (path / ARRAYS).exists()]
        plan = _read(self.work / PLAN, _Plan)
        kept = left[-1] if plan is not None and plan.digest == digest and left else None
        if kept is None:
            # First what says that there is something to go on with
            (self.work / PLAN).unlink(missing_ok=True)
            shutil.rmtree(self.work, ignore_errors=True)
        for path in earlier:
            if path != kept:
                discard(path)
        if kept is None:
            self.folder.mkdir(exist_ok=True)
            self.work.mkdir()
            if url is not None:
                write_record(self.arrays, new_remote_folder(self.arrays, url))
        elif kept != self.folder:
            kept.rename(self.folder)
        if kept is not None:
            self._forget_what_is_gone()
        return kept is not None

    def announce(self, digest: str) -> None:
        """The empty store is there, to be gone on with from now on."""
        write_record(self.work / PLAN, _Plan(digest=digest))

    def end(self) -> None:
        """Remove what is not published."""
        shutil.rmtree(self.work, ignore_errors=True)

    def array(self, name: str) -> zarr.Array[Any]:
        """An array of the store being written."""
        return writable_array(self.arrays / name)

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
        """What was made of an image; None where it is not stored whole. What a server has acknowledged is."""
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
        shards = sorted(self.arrays.glob(f"*/c/{camera}/{light}/**/*")) if self.arrays.is_dir() else []
        found = {}
        for path in [*shards, picture]:
            if path.is_file() and not path.name.endswith(".partial"):
                with path.open("rb") as stream:
                    sha256 = hashlib.file_digest(stream, "sha256").hexdigest()
                found[path.relative_to(self.folder).as_posix()] = StoredFile(bytes=path.stat().st_size, sha256=sha256)
        return found

    def objects_of(self, camera: int, light: int) -> dict[str, StoredObject]:
        """The objects of an image as the server lists them now; none where the arrays lie on this disk."""
        remote = remote_folder(self.arrays)
        if remote is None:
            return {}
        listings = [remote.listed(f"{name}/c/{camera}/{light}") for name in OF_AN_IMAGE]
        return {name: one for listing in listings for name, one in listing.items()}

    def seal(self, images: Iterable[ImageDone]) -> None:
        """Write into the file that stands for the arrays what the server holds, once all images are there.

        Raises:
            CorruptStoreError: names an object that is not there as it was written.
        """
        remote = remote_folder(self.arrays)
        if remote is None:
            return
        written = {name: one for done in images for name, one in done.objects.items()}
        there = RemoteFolder(url=remote.url, objects=written).require_intact("retry the job, which makes it anew")
        self.writer.require_lease()
        write_record(self.arrays, RemoteFolder(url=remote.url, objects=there))

    def _forget_what_is_gone(self) -> None:
        """Remove the records of images of which a server no longer has every object, so that they are made again."""
        remote = remote_folder(self.arrays)
        there = {} if remote is None else remote.listed()
        for path in self.work.glob("*/image-*.json"):
            done = _read(path, ImageDone)
            if done is not None and any(there.get(name) != one for name, one in done.objects.items()):
                path.unlink()

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
