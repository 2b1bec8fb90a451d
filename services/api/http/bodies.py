"""Bodies in JSON, refused at their first faults.

To list hundreds of thousands of them takes seconds in which the loop serves nobody.
"""

from __future__ import annotations

from typing import Annotated, Any, TypeVar

from pydantic import ValidationError, ValidatorFunctionWrapHandler, WrapValidator
from pydantic_core import PydanticCustomError

MAX_FAULTS = 100
"""More are counted, and not listed: whoever sends so many has sent something else than was asked for. No record has so
many members either."""
T = TypeVar("T")


def _few_faults(value: Any, validate: ValidatorFunctionWrapHandler) -> Any:
    if isinstance(value, dict) and len(value) > MAX_FAULTS:
        raise PydanticCustomError("many_faults", "The body has {count} members", {"count": len(value)})
    try:
        return validate(value)
    except ValidationError as problem:
        if (count := problem.error_count()) <= MAX_FAULTS:
            raise
        raise PydanticCustomError("many_faults", "The body has {count} faults", {"count": count}) from None


Sent = Annotated[T, WrapValidator(_few_faults)]
"""A body of a record's kind. Sequences in it stop at their first fault by themselves (``fail_fast``)."""
