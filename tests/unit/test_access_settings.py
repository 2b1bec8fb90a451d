"""A server without tokens listens on the loopback interface only."""

from __future__ import annotations

from pathlib import Path

import pytest

from services.api.app import create_app
from services.api.auth.access import refuse_open_network
from services.api.server import serve
from services.core.errors import SettingsError
from services.core.settings import ServerSettings, read_settings


@pytest.mark.parametrize("host", ["127.0.0.1", "127.9.9.9", "::1", "localhost"])
def test_open_access_is_for_loopback(host: str) -> None:
    refuse_open_network(ServerSettings(host=host))


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.4", "dentine.example", "localhost.example"])
def test_an_open_server_on_the_network_does_not_start(
    host: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = ServerSettings(host=host, port=0, data=tmp_path / "data")
    for start in (create_app, serve):
        with pytest.raises(
            SettingsError,
            match=(
                f"Host {host} is reachable from other machines and access is open; set DENTINE__SERVER__ACCESS=tokens"
            ),
        ):
            start(settings)
    assert not (tmp_path / "data").exists()
    assert capsys.readouterr().out == ""
    refuse_open_network(settings.model_copy(update={"access": "tokens"}))


def test_a_client_token_does_not_show() -> None:
    settings = read_settings(
        {"DENTINE__CLIENT__TOKEN": "dentine_0123456789ab_hidden-hidden", "DENTINE__SERVER__ACCESS": "tokens"}
    )
    assert settings.server.access == "tokens"
    assert settings.client.token is not None
    assert settings.client.token.get_secret_value().endswith("hidden-hidden")
    assert "hidden" not in repr(settings) + str(settings) + settings.model_dump_json()
