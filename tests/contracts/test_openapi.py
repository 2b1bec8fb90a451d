"""The description of the API beside the code is that of the code, and says what a client needs."""

from __future__ import annotations

import json

from services.api.openapi import STORED, describe
from services.api.problems import MEDIA_TYPE


def test_the_stored_description_is_current() -> None:
    assert json.loads(STORED.read_text()) == json.loads(json.dumps(describe())), "routes have changed: run python -m services.api.openapi"


def test_refusals_are_problem_documents() -> None:
    for path, operations in json.loads(STORED.read_text())["paths"].items():
        for method, operation in operations.items():
            for status, response in operation["responses"].items():
                assert status < "400" or set(response["content"]) == {MEDIA_TYPE}, f"{method} {path} {status}"


def test_every_operation_says_what_it_does_and_how_it_fails() -> None:
    for path, operations in json.loads(STORED.read_text())["paths"].items():
        for method, operation in operations.items():
            assert operation.get("description"), f"{method} {path} has no description"
            if path != "/v1/health/live":
                assert "403" in operation["responses"], f"{method} {path} tells of no refusal"
