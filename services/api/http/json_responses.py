"""JSON answers that are serialised in the thread of their handler."""

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
    """Wrap a handler so that it answers 200 with its result as JSON; the OpenAPI description still shows the result's
    type.

    FastAPI would validate the result a second time, with another switch to a thread, and serialise it on the event loop
    that serves everybody. This is for results that are records, which were validated when they were made.
    """
    adapter: TypeAdapter[Any] = TypeAdapter(inspect.signature(handler).return_annotation)

    @wraps(handler)
    def answer(*arguments: P.args, **options: P.kwargs) -> Response:
        return Response(adapter.dump_json(handler(*arguments, **options)), media_type=JSON)

    return answer
