"""Headers of the tus protocol 1.0.0, https://tus.io/protocols/resumable-upload."""

from __future__ import annotations

import base64
import binascii
import re
from collections.abc import Mapping
from dataclasses import dataclass
from email.utils import formatdate
from types import MappingProxyType

from services.client.errors import UploadError

VERSION = "1.0.0"
EXTENSIONS = "creation,termination,expiration,checksum"
CHUNK_TYPE = "application/offset+octet-stream"
DIGEST_BYTES: Mapping[str, int] = MappingProxyType({"sha256": 32, "sha1": 20})
_KEY = re.compile(r"[!-+\--~]+")


@dataclass(frozen=True)
class Checksum:
    """The checksum that a request states for its own bytes."""

    algorithm: str
    digest: bytes


def parse_metadata(header: str) -> dict[str, str]:
    """Decode Upload-Metadata.

    Raises:
        UploadError: it is malformed.
    """
    found: dict[str, str] = {}
    for pair in header.split(","):
        key, _, value = pair.strip().partition(" ")
        if not _KEY.fullmatch(key) or key in found:
            raise UploadError(
                f"Upload-Metadata has the key {key!r} twice or malformed; send each key once, with its value in Base64."
            )
        try:
            found[key] = base64.b64decode(value, validate=True).decode()
        except (binascii.Error, ValueError) as problem:
            raise UploadError(
                f"Upload-Metadata: the value of {key!r} is not UTF-8 in Base64; encode it so."
            ) from problem
        if not found[key].isprintable():
            raise UploadError(f"Upload-Metadata: the value of {key!r} has a control character; leave it out.")
    return found


def format_metadata(values: Mapping[str, str]) -> str:
    """Encode Upload-Metadata."""
    return ",".join(f"{key} {base64.b64encode(value.encode()).decode()}" for key, value in values.items())


def parse_checksum(header: str) -> Checksum:
    """Decode Upload-Checksum.

    Raises:
        UploadError: the algorithm is not known here, or the digest is malformed.
    """
    algorithm, _, encoded = header.partition(" ")
    if algorithm not in DIGEST_BYTES:
        raise UploadError(f"Upload-Checksum names {algorithm!r}; use {' or '.join(DIGEST_BYTES)}.")
    try:
        digest = base64.b64decode(encoded, validate=True)
    except (binascii.Error, ValueError) as problem:
        raise UploadError("Upload-Checksum is not Base64; encode the digest so.") from problem
    if len(digest) != DIGEST_BYTES[algorithm]:
        raise UploadError(
            f"Upload-Checksum has {len(digest)} bytes and a {algorithm} has {DIGEST_BYTES[algorithm]}; send the whole"
            " digest."
        )
    return Checksum(algorithm, digest)


def format_checksum(checksum: Checksum) -> str:
    """Encode Upload-Checksum."""
    return f"{checksum.algorithm} {base64.b64encode(checksum.digest).decode()}"


def format_expiry(time_s: float) -> str:
    """The value of Upload-Expires for a Unix time."""
    return formatdate(time_s, usegmt=True)
