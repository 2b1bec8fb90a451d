"""Where on an S3 server a job may keep what it prepares, as it is written in a job and in the server's settings."""

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
"""A place on an S3 server; neither a host nor a key can be written in it, nor a part that leads elsewhere."""
