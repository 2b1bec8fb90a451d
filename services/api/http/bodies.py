"""JSON request bodies: bounded before they are parsed, parsed outside the event loop where they are long, and refused
at their first faults.

Parsing hundreds of thousands of values, or listing as many faults, takes seconds in which the event loop serves nobody.
A thread alone does not help, because a parser holds the interpreter lock for as long as it runs: its input must be
small.
"""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Annotated, Any, TypeVar

from fastapi.exceptions import RequestValidationError
from fastapi.routing import APIRoute
from pydantic import ValidationError, ValidatorFunctionWrapHandler, WrapValidator
from pydantic_core import PydanticCustomError
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response

from services.api.http.thread_pools import ThreadPool
from services.core.errors import SettingsError
from services.core.files.json_text import AmbiguousJsonError, parse_json

MAX_FAULTS = 100
"""Largest number of faults that are listed, and of members of the object at the top of a body. More faults are only
counted: such a body is not what the route asks for. No record has so many members either."""
MAX_MEMBERS = 1000
"""Largest number of members of any object in a body. The longest objects are a light's intensities, one a channel."""
MAX_VALUES = 40_000
"""Largest number of values in one body. A manifest of five thousand files, the most by default, has twenty thousand."""
BYTES_PER_VALUE = 20
"""Bytes per value from which a body may hold more than ``MAX_VALUES`` values. A longer manifest, which the settings may
allow, has 25 at least: four values a file, of which the SHA-256 alone takes 66 bytes."""
SHORT_BYTES = 2**14
"""Largest body, in bytes, that is parsed on the event loop, which takes a millisecond. A longer one waits its turn in a
thread."""
T = TypeVar("T")


def _limit_faults(value: Any, validate: ValidatorFunctionWrapHandler) -> Any:
    if isinstance(value, dict) and len(value) > MAX_FAULTS:
        raise PydanticCustomError("many_faults", "The body has {count} members", {"count": len(value)})
    try:
        return validate(value)
    except ValidationError as problem:
        if (count := problem.error_count()) <= MAX_FAULTS:
            raise
        raise PydanticCustomError("many_faults", "The body has {count} faults", {"count": count}) from None


ValidatedBody = Annotated[T, WrapValidator(_limit_faults)]
"""Annotation of a request body that is validated as a record. Sequences in it stop at their first fault by themselves
(``fail_fast``)."""


def parse(body: bytes) -> Any:
    """Parse JSON in UTF-8.

    Raises:
        SettingsError: the body has more values, or an object in it more members, than any route asks for; or an object
            has equal keys, or a value is NaN.
        ValueError, RecursionError: the body is not JSON, or nested too deeply.
    """
    # Count an upper bound of the values: every value but the first of its list or object follows a comma.
    values, most = sum(map(body.count, (b",", b"[", b"{"))), max(MAX_VALUES, len(body) // BYTES_PER_VALUE)
    if values > most:
        raise SettingsError(
            f"The body has up to {values} values and {most} are allowed in its {len(body)} bytes; send what the route"
            " asks for."
        )
    try:
        return parse_json(body, _limit_members)
    except AmbiguousJsonError as problem:
        raise SettingsError(f"The body is ambiguous: {problem}.") from problem


def _limit_members(members: list[tuple[str, Any]]) -> None:
    if len(members) > MAX_MEMBERS:
        raise SettingsError(
            f"An object of the body has {len(members)} members and {MAX_MEMBERS} are allowed; send what the route asks"
            " for."
        )


class BodyRoute(APIRoute):
    """A route whose body is parsed and validated in ``app.state.parser_pool`` where it is long."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """Return the handler of the route, which receives the body as a validated record."""
        handler, field = super().get_route_handler(), self.body_field
        if field is None:
            return handler

        def read(body: bytes) -> Any:
            record, faults = field.validate(parse(body), {}, loc=("body",))
            if faults:
                raise RequestValidationError(faults)
            return record

        class ReadRequest(Request):
            async def json(self) -> Any:
                # FastAPI validates the result once more, but accepts a record as it is.
                parser_pool: ThreadPool = self.app.state.parser_pool
                body = await self.body()
                return read(body) if len(body) <= SHORT_BYTES else await parser_pool.run(read, body)

        async def answer(request: Request) -> Response:
            try:
                return await handler(ReadRequest(request.scope, request.receive))
            except HTTPException as problem:  # FastAPI turns every error of a body's parser into this
                if isinstance(problem.__cause__, SettingsError | RequestValidationError):
                    raise problem.__cause__ from None
                raise

        return answer
