"""Folders in which a preparation is made, and the results of an earlier attempt from which it can be resumed.

::

    JOB/
      .prepared.<attempt>/      the store being written; where a job names a URL, a file in it says where its arrays are
      .prepared.work/
        plan.json               digest of all inputs of the store
        <camera>/               footprint, relief, black image and its level as .npy, view.json, measures.json,
                                flow.json, motion-<frame>.json, image-<light>.json

A record is written after the files that it describes are on the disk, so a kill at any moment loses only the results
that were being made. The records are ``RecordFiles``, because every worker writes some.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from services.core.files.object_store import RemoteFolder, StoredObject, discard, new_remote_folder, remote_folder
from services.core.geometry import Camera, Record
from services.core.store import StageWriter, sha256_of, writable_array, write_record
from services.preprocess.tasks.records import FlowDone, FrameMotion, ImageDone, StoredFile, ViewDone
from services.preprocess.views.projection import Footprint
from services.preprocess.views.scratch import write_array
from services.preprocess.views.source import Motions, View
from services.tasks.record_files import RecordFiles

STAGE = "prepared"
ARRAYS = "prepared.zarr"
IMAGE_ARRAYS = ("radiance", "variance", "valid", "motion", "shadow")
"""Names of the arrays in which each image has a shard of its own."""
WORK = ".prepared.work"
FOOTPRINT = ("mesh", "depth_mm", "normal", "covered")
KINDS: dict[str, type[Record]] = {"view": ViewDone, "motion": FrameMotion, "flow": FlowDone, "image": ImageDone}
"""First word of a record's name -> its kind."""


class AttemptFiles:
    """Files of one attempt; the object is sent to the workers.

    Args:
        writer: writer of the stage, which holds the attempt's lease.
    """

    def __init__(self, writer: StageWriter) -> None:
        self.writer = writer
        self.records = RecordFiles(writer.root / WORK, writer.require_lease)

    @property
    def folder(self) -> Path:
        """Folder of the store being written."""
        return self.writer.folder

    @property
    def work(self) -> Path:
        """Folder of the work files, which are not published."""
        return self.records.folder

    @property
    def arrays(self) -> Path:
        """Folder of the arrays, or the file that holds their URL."""
        return self.folder / ARRAYS

    def begin(self, digest: str, url: str | None = None) -> bool:
        """Take over the files of an earlier attempt with the same inputs, or remove them all and start anew.

        Args:
            digest: digest of all inputs of the store.
            url: URL below which the arrays are stored; None to store them in the folder.

        Returns:
            Whether an earlier attempt was taken over.

        Raises:
            StoreError: the server of the arrays refuses or does not answer.
            PlatformError: the package that accesses this kind of URL is not installed.
        """
        earlier = sorted(self._attempts(), key=lambda path: int(path.name.rpartition(".")[2]))
        resumable = [path for path in earlier if (path / ARRAYS).exists()]
        resumed = resumable[-1] if self.records.are_of(digest) and resumable else None
        if resumed is None:
            self.records.remove()
        for path in earlier:
            if path != resumed:
                discard(path)
        if resumed is None:
            self.folder.mkdir(exist_ok=True)
            self.work.mkdir()
            if url is not None:
                write_record(self.arrays, new_remote_folder(self.arrays, url))
        elif resumed != self.folder:
            resumed.rename(self.folder)
        if resumed is not None:
            self._forget_images_with_missing_objects()
        return resumed is not None

    def mark_resumable(self, digest: str) -> None:
        """Record that the empty store exists, from which moment a later attempt can resume it."""
        self.records.mark(digest)

    def end(self) -> None:
        """Remove the work files."""
        self.records.remove()

    def array(self, name: str) -> zarr.Array[Any]:
        """Open an array of the store being written."""
        return writable_array(self.arrays / name)

    def scratch(self, camera: int) -> Path:
        """Folder of the files that a camera's blocks share."""
        return self.work / str(camera)

    def put_view(self, view: View) -> None:
        """Write a camera's window and footprint."""
        folder = self.scratch(view.number)
        for name in FOOTPRINT:
            write_array(folder / f"{name}.npy", getattr(view.footprint, name))
        window = view.window
        self.records.put(f"{view.number}/view", ViewDone(window=(window.top, window.bottom, window.left, window.right)))

    def view(self, camera: int, whole: Camera) -> View | None:
        """A camera's view with memory-mapped arrays; None if it has not been written yet."""
        folder = self.scratch(camera)
        done = self.records.get(f"{camera}/view", ViewDone)
        if done is None:
            return None
        arrays = {name: np.asarray(np.load(folder / f"{name}.npy", mmap_mode="r")) for name in FOOTPRINT}
        window = done.of()
        return View(camera, whole, window, window.cropped(whole), Footprint(**arrays), folder)

    def put_motion(self, camera: int, frame: int, motion: FrameMotion) -> None:
        """Write the motion of one frame."""
        self.records.put(f"{camera}/motion-{frame}", motion)

    def motions(self, camera: int, frames: tuple[int, ...]) -> Motions:
        """Motions of those of the given frames for which they have been written."""
        found = {frame: self.records.get(f"{camera}/motion-{frame}", FrameMotion) for frame in frames}
        return {frame: one.matched() for frame, one in found.items() if one is not None}

    def put_flow(self, camera: int, done: FlowDone) -> None:
        """Record that a camera's optical flow was computed and its pictures are written."""
        self.records.put(f"{camera}/flow", done)

    def flow(self, camera: int) -> FlowDone | None:
        """Record of a camera's optical flow; None if it has not been computed yet."""
        return self.records.get(f"{camera}/flow", FlowDone)

    def put_image(self, camera: int, light: int, done: ImageDone) -> None:
        """Record that an image is stored."""
        self.records.put(f"{camera}/image-{light}", done)

    def image(self, camera: int, light: int) -> ImageDone | None:
        """Record of an image; None if one of its files is missing or has another size.

        Objects on a server are not checked here, because the server has acknowledged them.
        """
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
        """Last record of an image, whether or not its files still match it; None if there is none."""
        return self.records.get(f"{camera}/image-{light}", ImageDone)

    def is_shaded(self, camera: int, light: int) -> bool:
        """Whether an image is stored and its shadows have been flagged."""
        done = self.image(camera, light)
        return done is not None and done.shaded

    def files_of(self, camera: int, light: int, picture: Path) -> dict[str, StoredFile]:
        """Sizes and checksums of an image's present files, by path in the stage's folder."""
        shards = sorted(self.arrays.glob(f"*/c/{camera}/{light}/**/*")) if self.arrays.is_dir() else []
        found = {}
        for path in [*shards, picture]:
            if path.is_file() and not path.name.endswith(".partial"):
                name, sha256 = path.relative_to(self.folder).as_posix(), sha256_of(path)
                found[name] = StoredFile(bytes=path.stat().st_size, sha256=sha256)
        return found

    def objects_of(self, camera: int, light: int) -> dict[str, StoredObject]:
        """Objects of an image as the server lists them; empty if the arrays lie on this disk."""
        remote = remote_folder(self.arrays)
        if remote is None:
            return {}
        listings = [remote.listed(f"{name}/c/{camera}/{light}") for name in IMAGE_ARRAYS]
        return {name: one for listing in listings for name, one in listing.items()}

    def seal(self, images: Iterable[ImageDone]) -> None:
        """Write the list of the server's objects into the file that stands for the arrays, once all images are stored.

        Raises:
            CorruptStoreError: an object on the server is missing or differs from the one written; the message names it.
        """
        remote = remote_folder(self.arrays)
        if remote is None:
            return
        written = {name: one for done in images for name, one in done.objects.items()}
        listed = RemoteFolder(url=remote.url, objects=written).require_intact("retry the job, which makes it anew")
        self.writer.require_lease()
        write_record(self.arrays, RemoteFolder(url=remote.url, objects=listed))

    def _forget_images_with_missing_objects(self) -> None:
        """Remove the records of images with a missing or changed object on the server, so that they are made again."""
        remote = remote_folder(self.arrays)
        listed = {} if remote is None else remote.listed()
        for path in self.work.glob("*/image-*.json"):
            done = self.records.get(f"{path.parent.name}/{path.stem}", ImageDone)
            if done is not None and any(listed.get(name) != one for name, one in done.objects.items()):
                path.unlink()

    def _attempts(self) -> Iterator[Path]:
        prefix = f".{STAGE}."
        for path in self.writer.root.glob(f"{prefix}*"):
            if path.is_dir() and path.name.removeprefix(prefix).isdigit():
                yield path
