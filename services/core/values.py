"""Kinds of values that options and descriptions have, as they are checked and as a JSON schema says them."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, Strict, WithJsonSchema
from pydantic_core import PydanticCustomError


def _no_stand_in(value: Any) -> Any:
    if isinstance(value, bool | str):
        raise PydanticCustomError("int_type", "give a number, neither a text nor true or false")
    return value


Number = Annotated[float, Strict()]
"""A number that is given as a number: a text, true or false is refused, so that no light burns at full level because
somebody wrote "level": true."""
Whole = Annotated[int, BeforeValidator(_no_stand_in)]
"""A whole number under the same rule; 2.0 counts as whole."""


def _auto_or_whole(value: Any) -> Any:
    if value == AUTO:
        return value
    if isinstance(value, bool) or not isinstance(value, int | float) or not 1 <= value <= 64 or int(value) != value:
        raise PydanticCustomError("pixel_step_type", 'give "auto" or a whole number from 1 to 64')
    return int(value)


AUTO: Literal["auto"] = "auto"
PixelStep = Annotated[
    int | Literal["auto"],
    BeforeValidator(_auto_or_whole),
    WithJsonSchema({"anyOf": [{"type": "string", "const": AUTO}, {"type": "integer", "minimum": 1, "maximum": 64}]}),
]
"""Edge of the fitted squares in pixels, or ``auto``."""
MAX_SQUARE_MM = 0.5
"""Largest edge of a square at the teeth by ``auto``, mm. Squares of 0.26 and of 0.45 mm left the photographs' part of
the standard errors as it was; larger ones were not tried."""
Unit = Annotated[Number, Field(ge=0, le=1)]
Positive = Annotated[Number, Field(gt=0)]
