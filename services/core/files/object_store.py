"""Arrays that lie on an S3 server instead of in a folder.

Where the folder of the arrays would lie there is a file, which says where they are and what was published there::

    {"url": "s3://teeth/lab/5f0c…/prepared.zarr", "objects": {"radiance/c/0/3/0/0/0": {"bytes": 81234, "etag": "9a…"}}}

Endpoint, region and credentials are those of the process's environment, as every program for S3 reads them, and never
in a job. An object is there whole or not at all, and a missing one reads as zeros, so the file lists all of them; what
the server lists is held against that. Every store has a name of its own below the URL that a job gives, so no two
attempts at different stores ever write the same object.
"""

from __future__ import annotations

import importlib
import re
import secrets
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import timedelta
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from pydantic import Field, ValidationError
from zarr.storage import ObjectStore, StorePath

from services.core.errors import CorruptStoreError, StoreError
from services.core.geometry import Record
from services.core.installed import require_packages

if TYPE_CHECKING:
    from zarr.abc.store import ByteRequest
    from zarr.core.buffer import Buffer, BufferPrototype

LIBRARY, EXTRA = "obstore", "s3"
RETRIES = 5
"""Of a request that was not answered: they take some 3 s in all, and a stage that fails nevertheless goes on later."""
CONNECT_S, ANSWER_S = "5s", "300s"
"""How long a connection and an answer may take; the largest are an image's pieces, 100 MB."""
_FAULTS: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        "bucket": ("has no bucket of that name", "create it, or correct the option 'store'"),
        "permission": ("does not permit this", "let these credentials list, read, write and delete there"),
        "credentials": (
            "takes no request without valid credentials",
            "set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY where the job runs",
        ),
        "region": ("says that its bucket is in another region", "set AWS_REGION where the job runs"),
        "silence": ("does not answer", "check AWS_ENDPOINT_URL and the network, then retry the job"),
    }
)
"""What is wrong and what to do."""
_SIGNS: Mapping[str, re.Pattern[str]] = MappingProxyType(
    {
        "credentials": re.compile(
            r" 401 |InvalidAccessKeyId|SignatureDoesNotMatch|ExpiredToken|InvalidToken|[Cc]redential|AccessKey"
        ),
        "bucket": re.compile(r"NoSuchBucket"),
        "permission": re.compile(r" 403 |AccessDenied"),
        "region": re.compile(r"region"),
    }
)
"""By which words of the server or the library a fault is known."""
_OF_THE_MACHINE = re.compile(r"//[^/ ]+/latest/(api/token|meta-data)")
"""Where the library asks for credentials if the environment has none: an Amazon machine is told its own there."""


class StoredObject(Record):
    """An object as it was written."""

    bytes: int
    etag: str


class RemoteFolder(Record):
    """Where arrays lie that are not on this disk."""

    url: str
    objects: dict[str, StoredObject] = Field(default={}, description="by path below the URL; empty until all are there")

    def array(self, name: str) -> StorePath:
        """Where one of its arrays lies."""
        return StorePath(_opened(self.url), name)

    def listed(self, prefix: str = "") -> dict[str, StoredObject]:
        """What is there now, by path below the URL: one request for each thousand objects.

        Args:
            prefix: whole parts of a path, such as ``radiance/c/0/3``; empty for all.

        Raises:
            StoreError: the server refuses or does not answer.
        """
        with _telling(self.url):
            batches = list(_library().list(_opened(self.url).store, prefix=prefix or None))
        return {
            one["path"]: StoredObject(bytes=one["size"], etag=one["e_tag"] or "") for batch in batches for one in batch
        }

    def require_intact(self, remedy: str) -> dict[str, StoredObject]:
        """Compare what is there with what the record lists; returns all that is there.

        Raises:
            CorruptStoreError: names the first object that is not as written. StoreError: as ``listed``.
        """
        there = self.listed()
        for name, expected in self.objects.items():
            if there.get(name) != expected:
                what = "is missing" if name not in there else "is not the object that was written there"
                raise CorruptStoreError(f"{self.url}/{name} {what}; {remedy}.")
        return there

    def remove(self) -> None:
        """Remove all that is there; again is the same as once.

        Raises:
            StoreError: as ``listed``.
        """
        names = list(self.listed())
        with _telling(self.url):
            _library().delete(_opened(self.url).store, names)


def require_library() -> None:
    """Import what speaks to S3 servers.

    Raises:
        PlatformError: it is not installed.
    """
    require_packages((LIBRARY,), EXTRA)


def remote_folder(path: Path) -> RemoteFolder | None:
    """What stands in place of a folder of arrays; None where it is a folder, or nothing.

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
    """A place for what would lie at a path, under a name that nobody has; to be written down before it is used.

    Raises:
        PlatformError: the library is not installed.
    """
    require_library()
    return RemoteFolder(url=f"{below}/{secrets.token_hex(16)}/{path.name}")


def place_of(path: Path) -> Path | StorePath:
    """Where an array lies: at its path, or where the file says that stands in place of its folder.

    Raises:
        CorruptStoreError: as ``remote_folder``. PlatformError: the library is not installed.
    """
    remote = remote_folder(path.parent)
    return path if remote is None else remote.array(path.name)


def discard(folder: Path) -> None:
    """Remove a folder and the arrays on servers that it names.

    Those go first, so that a removal that was cut short can be gone on with.

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


class _TellingStore(ObjectStore[Any]):
    """Zarr's store on an object store, whose faults are this project's errors."""

    async def get(
        self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None
    ) -> Buffer | None:  # fmt: skip
        """See zarr."""
        with _telling(_url_of(self.store)):
            return await super().get(key, prototype, byte_range)

    async def set(self, key: str, value: Buffer) -> None:
        """See zarr."""
        with _telling(_url_of(self.store)):
            await super().set(key, value)

    async def set_if_not_exists(self, key: str, value: Buffer) -> None:
        """See zarr."""
        with _telling(_url_of(self.store)):
            await super().set_if_not_exists(key, value)

    async def delete(self, key: str) -> None:
        """See zarr."""
        with _telling(_url_of(self.store)):
            await super().delete(key)


def _library(part: str = "") -> Any:
    require_library()
    return importlib.import_module(LIBRARY + part)


@lru_cache(maxsize=8)
def _opened(url: str) -> _TellingStore:
    """A client, with its connections; it takes a tenth of a second to make, so each process keeps the last few."""
    bucket, _, prefix = url.removeprefix("s3://").partition("/")
    with _telling(url):
        client = _library(".store").S3Store(
            bucket,
            prefix=prefix,
            retry_config={"max_retries": RETRIES, "retry_timeout": timedelta(seconds=60)},
            # The endpoint's URL in the environment says whether it is asked with TLS; Amazon's own always is
            client_options={"connect_timeout": CONNECT_S, "timeout": ANSWER_S, "allow_http": True},
        )
    return _TellingStore(client)


def _url_of(client: Any) -> str:
    return f"s3://{client.config['bucket']}/{client.prefix}"


@contextmanager
def _telling(url: str) -> Iterator[None]:
    """Turn what a server or its absence raises into a sentence.

    Raises:
        StoreError: in place of any fault of the server; the job goes on from what it had stored once it is retried.
    """
    try:
        yield
    except (_library(".exceptions").BaseError, FileNotFoundError) as problem:
        # The library's words: "<what it did> <URL> in <time> - <what came of it>", then the same at length
        did, _, came = str(problem).partition("Debug source:")[0].partition(" - ")
        said = "credentials" if _OF_THE_MACHINE.search(did) else came or did
        kind = next((kind for kind, sign in _SIGNS.items() if sign.search(said)), "silence")
        what, remedy = _FAULTS[kind]
        raise StoreError(f"The S3 server of {url} {what}; {remedy}.") from problem
