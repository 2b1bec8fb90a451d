"""The URL of a place on an S3 server for a job's prepared images, as jobs and the server's settings state it."""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import AfterValidator, WithJsonSchema
from pydantic_core import PydanticCustomError

STORE_URL = r"^s3://[a-z0-9][a-z0-9.-]{1,61}[a-z0-9](/[A-Za-z0-9_=-][A-Za-z0-9._=-]{0,99}){0,8}$"


def _store_url(value: str) -> str:
    if not re.fullmatch(STORE_URL, value):
        raise PydanticCustomError(
            "store_url",
            "give s3://BUCKET/PREFIX of letters, digits, '.', '_', '=' and '-', without a slash at the end; "
            "endpoint and credentials are the environment's",
        )
    return value


StoreUrl = Annotated[str, AfterValidator(_store_url), WithJsonSchema({"type": "string", "pattern": STORE_URL})]
"""URL of a place on an S3 server. It can contain neither a host nor a key, nor a part such as '..' that leads
elsewhere."""
