"""Faults of S3 servers in one sentence, and the library that talks to them."""

from __future__ import annotations

import importlib
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any

from services.core.errors import StoreError
from services.core.installed import require_packages

LIBRARY, EXTRA = "obstore", "s3"
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
"""Kind of fault -> what is wrong and what to do, as the parts of an error message."""
_FAULT_PATTERNS: Mapping[str, re.Pattern[str]] = MappingProxyType(
    {
        "credentials": re.compile(
            r" 401 |InvalidAccessKeyId|SignatureDoesNotMatch|ExpiredToken|InvalidToken|[Cc]redential|AccessKey"
        ),
        "bucket": re.compile(r"NoSuchBucket"),
        "permission": re.compile(r" 403 |AccessDenied"),
        "region": re.compile(r"region"),
    }
)
"""Kind of fault -> words of the server or the library by which it is recognised."""
_METADATA_SERVICE = re.compile(r"//[^/ ]+/latest/(api/token|meta-data)")
"""URL of the metadata service of Amazon machines, which the library asks for credentials if the environment has
none."""


def require_library() -> None:
    """Import the library for S3 servers.

    Raises:
        PlatformError: the library is not installed.
    """
    require_packages((LIBRARY,), EXTRA)


def library(part: str = "") -> Any:
    """The library, or one of its modules.

    Args:
        part: the module, such as ``.store``.

    Raises:
        PlatformError: the library is not installed.
    """
    require_library()
    return importlib.import_module(LIBRARY + part)


@contextmanager
def translate_server_errors(url: str) -> Iterator[None]:
    """Replace an error of the server, or of a server that does not answer, by a ``StoreError`` of one sentence.

    Raises:
        StoreError: in place of any fault of the server; a retried job goes on from what it had stored.
    """
    try:
        yield
    except (library(".exceptions").BaseError, FileNotFoundError) as problem:
        # The library's message reads "<request> <URL> in <time> - <result>", followed by the same in detail.
        request, _, result = str(problem).partition("Debug source:")[0].partition(" - ")
        reason = "credentials" if _METADATA_SERVICE.search(request) else result or request
        kind = next((kind for kind, pattern in _FAULT_PATTERNS.items() if pattern.search(reason)), "silence")
        what, remedy = _FAULTS[kind]
        raise StoreError(f"The S3 server of {url} {what}; {remedy}.") from problem
