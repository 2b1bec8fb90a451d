"""The words for wrong values in records: the project's own, whatever the library that validates would say."""

from __future__ import annotations

import json
from typing import Any

import pytest
from pydantic import BaseModel, ValidationError

from services.core.errors import CaptureInputError
from services.core.files.fault_words import library_kinds, words_of
from services.core.files.validation import parse_record
from services.core.geometry import Camera
from services.core.raw.folder import parse_raw_folder

LIBRARY = ("input should", "valid ", "unable to", "field required", "extra inputs", "validation", "type=")
CONTEXT: dict[str, Any] = {
    "expected": "'a' or 'b'",
    **dict.fromkeys(("gt", "ge", "lt", "le", "multiple_of", "min_length", "max_length", "actual_length"), 2),
    "pattern": "^[0-9]+$",
    "error": "EOF while parsing an object at line 2 column 5",
    "expected_tags": "'a', 'b'",
}


@pytest.mark.parametrize("kind", sorted(library_kinds() - {"value_error", "assertion_error"}))
def test_no_wording_of_the_library_is_passed_on(kind: str) -> None:
    words = words_of({"type": kind, "loc": ("x",), "msg": "Input should be a valid thing", "input": 1, "ctx": CONTEXT})
    assert not any(one in words.lower() for one in LIBRARY if kind != "json_invalid")
    assert words.startswith(("must ", "is ", "has ", "may "))


def test_own_messages_are_kept() -> None:
    class Told(BaseModel):
        x: int

    with pytest.raises(ValidationError) as caught:
        Told.model_validate({"x": "many"})
    assert words_of(caught.value.errors()[0]) == "must be a whole number"
    camera = {"name": "a/b", "size": [4, 4], "K": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "camera_from_world": []}
    with pytest.raises(CaptureInputError, match="name: a name has 1 to 64 bytes"):
        parse_record(json.dumps(camera).encode(), Camera, "camera.json")


def test_json_that_breaks_off_is_placed() -> None:
    with pytest.raises(CaptureInputError, match=r"camera.json: is not valid JSON at line 1, column \d+; correct"):
        parse_record(b'{"name": "a", ', Camera, "camera.json")


RAW = b"""
units = "mm"
[[camera]]
name = 1
size = [4, 4]
bits = 8
channels = ["grey"]
[[light]]
name = 7
[[frame]]
camera = 1
file = "a.png"
kind = "light"
light = 7
exposure_s = 0.1
session = 3
place = 1
"""


def test_a_number_is_a_name_too() -> None:
    folder = parse_raw_folder(RAW, "raw.toml")
    frame = folder.frame[0]
    assert (folder.camera[0].name, frame.camera, frame.light, frame.session, frame.place) == ("1", "1", "7", "3", "1")


def test_truth_is_no_name() -> None:
    with pytest.raises(CaptureInputError, match="place: must be a text; write it in quotes"):
        parse_raw_folder(RAW.replace(b"place = 1", b"place = true"), "raw.toml")
