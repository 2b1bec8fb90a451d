"""The stored description of the API matches the code, and describes every operation and every refusal."""

from __future__ import annotations

import http.client
import json

import pytest

from services.api.http.problems import MEDIA_TYPE, Problem
from services.api.openapi import STORED, describe


def test_the_stored_description_is_current() -> None:
    assert json.loads(STORED.read_text()) == json.loads(json.dumps(describe())), (
        "routes have changed: run python -m services.api.openapi"
    )


NAMED_ANEW = {413: "Content Too Large", 414: "URI Too Long", 416: "Range Not Satisfiable", 422: "Unprocessable Content"}
"""Titles of statuses that Python 3.13 renamed, after RFC 9110."""


def test_the_description_is_the_same_on_every_python(monkeypatch: pytest.MonkeyPatch) -> None:
    for status, name in NAMED_ANEW.items():
        monkeypatch.setitem(http.client.responses, status, name)
    assert not set(NAMED_ANEW.values()) & {
        response["description"]
        for path in describe()["paths"].values()
        for operation in path.values()
        for response in operation["responses"].values()
    }


@pytest.mark.parametrize(
    ("status", "title"), [(413, "Request Entity Too Large"), (422, "Unprocessable Entity"), (404, "Not Found")]
)
def test_a_problem_has_the_same_title_on_every_python(status: int, title: str) -> None:
    assert Problem.of(status, "some-code", "A sentence.", "/").title == title


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
