"""What is wrong with a record that somebody wrote, in one sentence with its remedy."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError

from services.core.errors import CaptureInputError
from services.core.files.fault_words import words_of
from services.core.files.json_text import AmbiguousJsonError, parse_json

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

R = TypeVar("R", bound=BaseModel)


def remedied(error: ErrorDetails) -> str:
    """What is wrong with a value, with a remedy after a semicolon."""
    words = words_of(error)
    return words if "; " in words else f"{words}; correct it"


def parse_record(content: bytes, kind: type[R], origin: str) -> R:
    """Read a record from JSON.

    Args:
        origin: the file's name, with which a message begins.

    Raises:
        CaptureInputError: it is no JSON, has equal keys, or is no record of this kind; the message names the first
            wrong field.
    """
    try:
        parse_json(content)
    except AmbiguousJsonError as problem:
        raise CaptureInputError(f"{origin}: {problem}.") from problem
    except (ValueError, RecursionError):
        pass  # said by the parser below, with the place
    try:
        return kind.model_validate_json(content)
    except ValidationError as problem:
        raise CaptureInputError(f"{origin}: {fault_of(first_error(problem), kind)}.") from problem


def first_error(problem: ValidationError) -> ErrorDetails:
    """The error to tell first: an unknown key, if there is one, because a key that is missing may be that one
    misspelt.
    """
    errors = problem.errors()
    return next((error for error in errors if error["type"] == "extra_forbidden"), errors[0])


def fault_text(error: ErrorDetails, kind: type[BaseModel], key: str, place: str = "", value: str = "") -> str:
    """The sentence, without its full stop.

    Args:
        error: the first of Pydantic's errors.
        kind: record in which it lies, whose keys are known.
        key: name of the missing or unknown key.
        place: begins the sentence.
        value: name of a wrong value, with a colon; empty for a record as a whole.
    """
    if error["type"] == "extra_forbidden":
        return f"{place}unknown key '{key}'; known keys are {', '.join(sorted(kind.model_fields))}"
    if error["type"] == "missing" and not key.isdecimal():
        return f"{place}'{key}' is missing; add it"
    message = remedied(error)
    return f"{place}{value}{message[:1].lower()}{message[1:]}"


def fault_of(error: ErrorDetails, kind: type[BaseModel]) -> str:
    """The sentence, without its full stop, on a file that is one record of this kind."""
    key = ".".join(str(part) for part in error["loc"])
    return fault_text(error, _record_at(kind, error["loc"]), key, value=f"{key}: " if key else "")


def _record_at(kind: type[BaseModel], location: Sequence[int | str]) -> type[BaseModel]:
    """The record in which the last part of a location lies."""
    for step in location[:-1]:
        if step in kind.model_fields:
            kind = next(_records_of(kind.model_fields[str(step)].annotation), kind)
    return kind


def _records_of(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _records_of(argument)
