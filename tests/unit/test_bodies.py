"""Limits on JSON request bodies, checked before they are parsed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from fastapi.routing import iter_route_contexts

from services.api.app import create_app
from services.api.http.bodies import MAX_MEMBERS, MAX_VALUES, BodyRoute, parse
from services.core.errors import SettingsError
from services.core.settings import ServerSettings, UploadLimits
from tests.support.live_server import serving


def manifest_of(files: int, path: str = "images/camera-1/light-{:05d}.png") -> bytes:
    """A manifest of this many files, without spaces."""
    return json.dumps(
        {"files": [{"path": path.format(number), "bytes": 1, "sha256": "0" * 64} for number in range(files)]},
        separators=(",", ":"),
    ).encode()


@pytest.mark.parametrize("item", ["0", "[]", "{}", '""', "[[[]]]", '{"a": 0}'])
def test_a_body_of_too_many_values_is_refused_before_it_is_parsed(item: str, monkeypatch: pytest.MonkeyPatch) -> None:
    body = f"[{','.join([item] * (MAX_VALUES + 1))}]".encode()
    monkeypatch.setattr("json.loads", lambda *_, **__: pytest.fail("it was parsed"))
    with pytest.raises(SettingsError, match=f"{MAX_VALUES} are allowed"):
        parse(body)


def test_an_object_of_too_many_members_is_refused_wherever_it_is() -> None:
    parse(json.dumps({"rig": {f"a{number}": 0 for number in range(MAX_MEMBERS)}}).encode())
    with pytest.raises(SettingsError, match=f"{MAX_MEMBERS + 1} members"):
        parse(json.dumps({"rig": {f"a{number}": 0 for number in range(MAX_MEMBERS + 1)}}).encode())


@pytest.mark.parametrize("path", ["images/camera-1/light-{:05d}.png", "{}.png"])
@pytest.mark.parametrize("files", [UploadLimits().most_files, 10 * UploadLimits().most_files])
def test_a_manifest_of_as_many_files_as_the_settings_allow_is_parsed(files: int, path: str) -> None:
    assert len(parse(manifest_of(files, path))["files"]) == files


def test_every_route_with_a_body_in_json_bounds_it(tmp_path: Path) -> None:
    app = create_app(ServerSettings(data=tmp_path), lambda *_: None)
    with serving(app):
        found = [
            context.original_route
            for context in iter_route_contexts(app.routes)
            if getattr(context.original_route, "body_field", None) is not None
        ]
    assert len(found) == 11
    assert [route for route in found if not isinstance(route, BodyRoute)] == []
