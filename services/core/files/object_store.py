"""Arrays that lie on an S3 server instead of in a folder.

In place of the folder of the arrays there is a file that states their URL and the objects that were published there::

    {"url": "s3://teeth/lab/5f0c…/prepared.zarr", "objects": {"radiance/c/0/3/0/0/0": {"bytes": 81234, "etag": "9a…"}}}

Endpoint, region and credentials come from the environment of the process, as for every S3 program, and are never part
of a job. An object exists whole or not at all, and zarr reads a missing one as zeros, so the file lists all of them,
and the server's listing is compared with this list. Every store has a unique name below the URL that a job gives, so
two attempts with different stores never write the same object.
"""

from __future__ import annotations

import secrets
import shutil
from datetime import timedelta
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field, ValidationError

from services.core.errors import CorruptStoreError
from services.core.files.server_faults import library, require_library, translate_server_errors
from services.core.geometry import Record

if TYPE_CHECKING:
    from zarr.storage import StorePath

    from services.core.files.zarr_store import ErrorTranslatingStore

RETRIES = 5
"""Number of retries of a request that was not answered. They take some 3 s in all; a stage that fails nevertheless can
be continued later."""
CONNECT_S, ANSWER_S = "5s", "300s"
"""Longest time to connect, and longest time for an answer; the largest answers are an image's shards, 100 MB."""


class StoredObject(Record):
    """Size and ETag of an object as it was written."""

    bytes: int
    etag: str


class RemoteFolder(Record):
    """The place of arrays that lie on a server."""

    url: str
    objects: dict[str, StoredObject] = Field(default={}, description="by path below the URL; empty until all are there")

    def array(self, name: str) -> StorePath:
        """Zarr's path of one of the arrays."""
        from zarr.storage import StorePath

        return StorePath(_opened(self.url), name)

    def listed(self, prefix: str = "") -> dict[str, StoredObject]:
        """List the objects on the server by path below the URL, with one request for each thousand objects.

        Args:
            prefix: whole parts of a path, such as ``radiance/c/0/3``; empty for all.

        Raises:
            StoreError: the server refuses or does not answer.
        """
        with translate_server_errors(self.url):
            batches = list(library().list(_opened(self.url).store, prefix=prefix or None))
        return {
            one["path"]: StoredObject(bytes=one["size"], etag=one["e_tag"] or "") for batch in batches for one in batch
        }

    def require_intact(self, remedy: str) -> dict[str, StoredObject]:
        """Compare the objects on the server with those that this record lists; return all objects on the server.

        Raises:
            CorruptStoreError: an object is not as it was written; the message names the first one. StoreError: as
                ``listed``.
        """
        present = self.listed()
        for name, expected in self.objects.items():
            if present.get(name) != expected:
                what = "is missing" if name not in present else "is not the object that was written there"
                raise CorruptStoreError(f"{self.url}/{name} {what}; {remedy}.")
        return present

    def remove(self) -> None:
        """Remove all objects below the URL; a second call does no harm.

        Raises:
            StoreError: as ``listed``.
        """
        names = list(self.listed())
        with translate_server_errors(self.url):
            library().delete(_opened(self.url).store, names)


def remote_folder(path: Path) -> RemoteFolder | None:
    """Read the file that stands in place of a folder of arrays; None where there is a folder, or nothing.

    Raises:
        CorruptStoreError: the file cannot be read.
    """
    if not path.is_file():
        return None
    try:
        return RemoteFolder.model_validate_json(path.read_bytes())
    except ValidationError as problem:
        raise CorruptStoreError(
            f"{path}, which says where its arrays lie, cannot be read; restore it, or remove it and by hand what "
            "the job keeps at its option 'store'."
        ) from problem


def new_remote_folder(path: Path, below: str) -> RemoteFolder:
    """Choose a new place on a server for the arrays that would lie at a path.

    The caller writes the record into the file at that path before it uses the place.

    Args:
        path: path of the folder that the arrays would have on disk.
        below: URL below which the place gets a random name.

    Raises:
        PlatformError: the library is not installed.
    """
    require_library()
    return RemoteFolder(url=f"{below}/{secrets.token_hex(16)}/{path.name}")


def array_location(path: Path) -> Path | StorePath:
    """Location of an array: its path, or the place on a server if a file stands in place of the array's folder.

    Raises:
        CorruptStoreError: as ``remote_folder``. PlatformError: the library is not installed.
    """
    remote = remote_folder(path.parent)
    return path if remote is None else remote.array(path.name)


def discard(folder: Path) -> None:
    """Remove a folder and the arrays on servers that its files name.

    The arrays on servers are removed first, so that an interrupted removal can be repeated.

    Raises:
        StoreError: a server refuses or does not answer; the folder stays.
    """
    discard_remote(folder)
    shutil.rmtree(folder, ignore_errors=True)


def discard_remote(folder: Path, pattern: str = "*.zarr") -> None:
    """Remove the arrays on servers that the files of a folder name.

    Raises:
        StoreError: a server refuses or does not answer.
    """
    for path in sorted(folder.glob(pattern)):
        remote = remote_folder(path)
        if remote is not None:
            remote.remove()


@lru_cache(maxsize=8)
def _opened(url: str) -> ErrorTranslatingStore:
    """A client with its connections. Making one takes a tenth of a second, so each process keeps the last few."""
    from services.core.files.zarr_store import ErrorTranslatingStore

    bucket, _, prefix = url.removeprefix("s3://").partition("/")
    with translate_server_errors(url):
        client = library(".store").S3Store(
            bucket,
            prefix=prefix,
            retry_config={"max_retries": RETRIES, "retry_timeout": timedelta(seconds=60)},
            # The scheme of the endpoint's URL in the environment decides about TLS; Amazon's own endpoints always use
            # it.
            client_options={"connect_timeout": CONNECT_S, "timeout": ANSWER_S, "allow_http": True},
        )
    return ErrorTranslatingStore(client)
