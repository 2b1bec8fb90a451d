"""The server's limit of flashes, the acknowledgement that a faster plan needs, and what the audit log says of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import httpx
import pytest
from pydantic import SecretStr

from services.api.auth.tokens import Scope
from services.api.jobs.size import method_of
from services.client.client import Client
from services.core.errors import RigError, SettingsError
from services.core.light.flash_record import record_use
from services.core.light.safety import FlashAcknowledgement
from services.core.records import JobSpec
from services.core.settings import DomeSettings, read_settings
from tests.support.guarded_server import Guarded, guarded, make_token

OWN = "dome.invalid:5020"
NOW = datetime.now(UTC)


class Failing:
    """Stand-in for the stages: a job whose capture begins to flash, and fails."""

    def __init__(self) -> None:
        self.specs: list[JobSpec] = []

    def __call__(self, spec: JobSpec, folder: Path, *_: object) -> None:
        self.specs.append(spec)
        assert spec.rig is not None
        if spec.rig.flashes is not None:
            record_use(folder, spec.rig.flashes)
        raise RigError("The dome failed; check it.")


@pytest.fixture(scope="module")
def ran() -> Failing:
    return Failing()


@pytest.fixture(scope="module")
def server(ran: Failing, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Guarded]:
    with guarded(tmp_path_factory.mktemp("data"), ran, dome=DomeSettings(address=OWN, max_flashes_per_s=6)) as server:
        yield server


@pytest.fixture(scope="module")
def token(server: Guarded) -> str:
    return make_token(server.data, "chair", Scope.SUBMIT, Scope.OPERATE_DOME, Scope.READ)


@pytest.fixture(scope="module")
def chair(server: Guarded, token: str) -> Callable[..., httpx.Response]:
    """Function that sends requests with a token that may submit jobs and operate the dome."""
    return lambda method, path, **options: server.ask(
        method, path, headers={"Authorization": f"Bearer {token}"}, **options
    )


def stated(**options: Any) -> dict[str, Any]:
    at = options.pop("at", NOW)
    return {"per_s": 6, "eye_cover": True, "epilepsy_asked": True, "by": "B. Roe", "at": at.isoformat()} | options


def job(**rig: Any) -> dict[str, Any]:
    return {"json": {"rig": {"mouth": "/", "dome": OWN, **rig}}}


@pytest.mark.parametrize(
    ("flashes", "named"),
    [
        (stated(per_s=6.1), "6.1 flashes a second are more than this server's 6 (DENTINE__SERVER__DOME__MAX_FLASHES"),
        (stated(at=NOW - timedelta(hours=25)), "more than 24 hours ago; ask the subject again"),
        (stated(at=NOW + timedelta(hours=1)), "in the future"),
        (stated(eye_cover=False), "leave 'flashes' out for three a second"),
        (stated(epilepsy_asked="true"), "leave 'flashes' out for three a second"),
        (stated(by=""), "rig.flashes.by"),
        ({"per_s": 6}, "rig.flashes.eye_cover"),
    ],
)
@pytest.mark.attack("light", "flashes beyond the server's limit, or without a whole acknowledgement")
def test_a_faster_plan_without_a_valid_acknowledgement_is_refused(
    chair: Callable[..., httpx.Response], flashes: dict[str, Any], named: str
) -> None:
    for path, body in (
        ("/v1/jobs", job(flashes=flashes)),
        ("/v1/dome/preflight", {"json": {"mouth": "/", "flashes": flashes}}),
    ):
        answer = chair("POST", path, **body)
        assert (answer.status_code, answer.json()["code"]) == (422, "bad-settings"), path
        assert named.removeprefix("rig." if "preflight" in path else "") in answer.json()["detail"], path


def test_a_retry_needs_an_acknowledgement_of_its_own_and_the_audit_log_has_both(
    server: Guarded, chair: Callable[..., httpx.Response], ran: Failing, token: str
) -> None:
    def end(one: str) -> None:
        server.ask("GET", f"/v1/jobs/{one}/events", Scope.READ)

    made = chair("POST", "/v1/jobs", **job(flashes=stated(at=NOW - timedelta(hours=1)))).json()["id"]
    end(made)
    bodies: tuple[dict[str, Any], ...] = ({}, {"json": {}}, {"json": {"flashes": stated(at=NOW - timedelta(hours=2))}})
    for body in bodies:
        answer = chair("POST", f"/v1/jobs/{made}/retry", **body)
        assert (answer.status_code, answer.json()["code"]) == (422, "bad-settings")
        assert "An earlier attempt has flashed under the acknowledgement of" in answer.json()["detail"]
    too_fast = chair("POST", f"/v1/jobs/{made}/retry", json={"flashes": stated(per_s=7)})
    assert "more than this server's 6" in too_fast.json()["detail"]
    runs = len(ran.specs)
    newer = FlashAcknowledgement.model_validate(stated(per_s=5))
    with Client(str(server.client.base_url), SecretStr(token)) as client:
        assert client.retry(made, newer)["spec"]["rig"]["flashes"]["per_s"] == 5
    end(made)
    assert [spec.rig.flashes for spec in ran.specs[runs:] if spec.rig] == [newer]
    entries = server.ask("GET", "/v1/audit", Scope.ADMIN).json()["entries"]
    told = [entry["ids"]["flashes"] for entry in entries if "flashes" in entry["ids"] and entry["outcome"] < 300]
    assert told == [
        f"5 flashes a second, eyes covered and epilepsy asked by B. Roe at {NOW.isoformat()}",
        f"6 flashes a second, eyes covered and epilepsy asked by B. Roe at {(NOW - timedelta(hours=1)).isoformat()}",
    ]


def test_a_forecast_compares_captures_of_one_rate() -> None:
    slow, fast, simulated = (
        method_of(JobSpec.model_validate(job(**rig)["json"]))
        for rig in ({}, {"flashes": stated()}, {"dome": "simulated", "flashes": stated()})
    )
    assert '"3 flashes a second"' in slow
    assert '"6 flashes a second"' in fast
    assert '"captures": true' in simulated, "jobs with a simulated dome are compared with those of earlier versions"


def test_a_servers_limits_above_the_defaults_need_an_assessment(ran: Failing, tmp_path: Path) -> None:
    prefix, who = "DENTINE__SERVER__DOME__", "A. Low, 2026-03-01, iec62471.pdf"
    for name, value in (("LIGHT_EXPOSURE_LIMIT_S", "11"), ("TOTAL_EXPOSURE_LIMIT_S", "101")):
        with pytest.raises(SettingsError, match=f"{name.lower()} {value} is above the default .* 'who, when, file'"):
            read_settings({prefix + name: value})
        with pytest.raises(SettingsError, match="name the person, the date and the document"):
            read_settings({prefix + name: value, prefix + "ASSESSMENT": "yes"})
        dome = read_settings({prefix + name: value, prefix + "ASSESSMENT": who, prefix + "ADDRESS": OWN}).server.dome
    with guarded(tmp_path, ran, dome=dome) as server:
        token = make_token(server.data, "chair", Scope.SUBMIT, Scope.OPERATE_DOME)
        answer = server.ask(
            "POST", "/v1/jobs", headers={"Authorization": f"Bearer {token}"}, **job(total_exposure_limit_s=200.0)
        )
        server.ask("GET", f"/v1/jobs/{answer.json()['id']}/events", Scope.READ)
    rig = ran.specs[-1].rig
    assert rig is not None
    assert (rig.total_exposure_limit_s, rig.assessment) == (101.0, who), "the worker checks the limit again"
