"""Answers as JSON, written in the thread of the handler that has made them."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec

from fastapi import Response
from pydantic import TypeAdapter

JSON = "application/json"
P = ParamSpec("P")


def in_json(handler: Callable[P, Any]) -> Callable[P, Response]:
    """Let a handler answer 200 with its result as JSON; the description still says what it returns.

    FastAPI would check the result a second time, in another hop to a thread, and write it on the loop that serves
    everybody. For results that are records, which were checked when they were made.
    """
    adapter: TypeAdapter[Any] = TypeAdapter(inspect.signature(handler).return_annotation)

    @wraps(handler)
    def answer(*arguments: P.args, **options: P.kwargs) -> Response:
        return Response(adapter.dump_json(handler(*arguments, **options)), media_type=JSON)

    return answer
