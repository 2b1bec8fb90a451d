"""The server decides who may light a dome by a job, which dome, and up to which dose, whatever the job requests."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import pytest

from services.api.app import create_app
from services.api.auth.tokens import Scope
from services.api.jobs.repository import Repository
from services.api.server import _darken_on_signal
from services.core.records import JobSpec
from services.core.settings import DomeSettings, ServerSettings
from tests.support.guarded_server import Guarded, guarded, make_token
from tests.support.live_server import serving

OWN, FURTHER = "dome.invalid:5020", "second.invalid:5020"
SETTINGS = DomeSettings(
    address=OWN,
    job_addresses=f" {FURTHER} ,",
    watchdog_s=1.0,
    light_exposure_limit_s=2.0,
    total_exposure_limit_s=20.0,
    max_level=0.8,
    max_exposure_s=5.0,
)


class Ran:
    """Stand-in for the stages that records the options of a job."""

    def __init__(self) -> None:
        self.specs: list[JobSpec] = []

    def __call__(self, spec: JobSpec, *_: object) -> None:
        self.specs.append(spec)


@pytest.fixture(scope="module")
def ran() -> Ran:
    return Ran()


@pytest.fixture(scope="module")
def server(ran: Ran, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Guarded]:
    with guarded(tmp_path_factory.mktemp("data"), ran, dome=SETTINGS) as server:
        yield server


@pytest.fixture(scope="module")
def chair(server: Guarded) -> Callable[..., httpx.Response]:
    """Function that sends requests with a token that may submit jobs and operate the dome."""
    token = make_token(server.data, "chair", Scope.SUBMIT, Scope.OPERATE_DOME)
    return lambda method, path, **options: server.ask(
        method, path, headers={"Authorization": f"Bearer {token}"}, **options
    )


def job(**rig: Any) -> dict[str, Any]:
    return {"json": {"rig": {"mouth": "/", "dome": OWN, **rig}}}


def problem_of(answer: httpx.Response) -> tuple[int, str, str]:
    assert answer.headers["content-type"] == "application/problem+json", answer.text
    return answer.status_code, answer.json()["code"], answer.json()["detail"]


@pytest.mark.attack("light", "a job that lights a dome, without the scope")
def test_a_job_with_a_dome_needs_the_scope_to_operate_it(server: Guarded, chair: Callable[..., httpx.Response]) -> None:
    status, code, detail = problem_of(server.ask("POST", "/v1/jobs", Scope.SUBMIT, **job()))
    assert (status, code) == (403, "scope-missing")
    assert "'operate-dome'" in detail
    assert chair("POST", "/v1/jobs", **job()).status_code == 201
    assert server.ask("POST", "/v1/jobs", Scope.SUBMIT, **job(dome="simulated")).status_code == 201
    assert server.ask("POST", "/v1/jobs", Scope.SUBMIT, json={"capture": "/"}).status_code == 201


@pytest.mark.attack("light", "a retry that lights a dome, without the scope")
def test_a_retry_that_lights_a_dome_needs_the_scope_too(server: Guarded, chair: Callable[..., httpx.Response]) -> None:
    made = {dome: chair("POST", "/v1/jobs", **job(dome=dome)).json()["id"] for dome in (OWN, "simulated")}
    for one in made.values():
        server.ask("GET", f"/v1/jobs/{one}/events", Scope.READ)
    assert problem_of(server.ask("POST", f"/v1/jobs/{made[OWN]}/retry", Scope.SUBMIT))[:2] == (403, "scope-missing")
    # The job succeeded, so a retry is refused for its state; the point is that the scope was not required.
    assert problem_of(chair("POST", f"/v1/jobs/{made[OWN]}/retry"))[:2] == (409, "job-state")
    assert problem_of(server.ask("POST", f"/v1/jobs/{made['simulated']}/retry", Scope.SUBMIT))[:2] == (409, "job-state")


@pytest.mark.attack("light", "a job that makes the server connect to any address")
def test_a_dome_that_the_server_does_not_list_is_not_connected_to(
    server: Guarded, chair: Callable[..., httpx.Response]
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as elsewhere:
        address = f"127.0.0.1:{elsewhere.getsockname()[1]}"
        status, code, detail = problem_of(chair("POST", "/v1/jobs", **job(dome=address)))
        assert (status, code) == (422, "bad-settings")
        assert address in detail
        assert "DENTINE__SERVER__DOME__JOB_ADDRESSES" in detail
        elsewhere.settimeout(0)
        with pytest.raises(BlockingIOError):
            elsewhere.accept()
    assert chair("POST", "/v1/jobs", **job(dome=FURTHER)).status_code == 201


@pytest.mark.parametrize(
    ("options", "code", "named"),
    [
        ({"level": 0.81}, "bad-settings", "rig.level"),
        ({"exposure_s": 4.0, "settle_s": 1.1, "level": 0.01}, "bad-settings", "rig.exposure_s"),
        ({"exposure_s": 1e300, "level": 0.0}, "bad-settings", "rig.exposure_s"),
        ({"exposure_s": 4.9, "level": 0.5, "light_exposure_limit_s": 1e9}, "rig-exposure-limit", "level-seconds"),
        ({"exposure_s": 1.0, "level": 0.5, "light_exposure_limit_s": 0.4}, "rig-exposure-limit", "level-seconds"),
    ],
)
@pytest.mark.attack("light", "limits of a job's own above the server's")
def test_light_beyond_the_servers_limits_is_refused(
    chair: Callable[..., httpx.Response], options: dict[str, float], code: str, named: str
) -> None:
    answer = problem_of(chair("POST", "/v1/jobs", **job(**options)))
    assert answer[:2] == (422, code)
    assert named in answer[2]


def test_a_job_runs_with_the_lower_of_its_own_limits_and_the_servers(
    server: Guarded, chair: Callable[..., httpx.Response], ran: Ran
) -> None:
    lavish = {"watchdog_s": 60.0, "light_exposure_limit_s": 1e9, "total_exposure_limit_s": 1e9}
    careful = {"watchdog_s": 0.5, "light_exposure_limit_s": 1.0, "total_exposure_limit_s": 3.0}
    for asked, held in ((lavish, (1.0, 2.0, 20.0)), (careful, tuple(careful.values()))):
        made = chair("POST", "/v1/jobs", **job(**asked)).json()["id"]
        server.ask("GET", f"/v1/jobs/{made}/events", Scope.READ)
        rig = ran.specs[-1].rig
        assert rig is not None
        assert (rig.watchdog_s, rig.light_exposure_limit_s, rig.total_exposure_limit_s) == held


def test_a_preflight_and_a_light_by_hand_keep_to_the_level(chair: Callable[..., httpx.Response]) -> None:
    for method, path, body in (
        ("PUT", "light", {"light": 0, "level": 0.9}),
        ("POST", "preflight", {"mouth": "/", "level": 0.9}),
    ):
        status, code, detail = problem_of(chair(method, f"/v1/dome/{path}", json=body))
        assert (status, code) == (422, "bad-settings"), path
        assert "level" in detail
        assert "MAX_LEVEL" in detail


@pytest.mark.parametrize("now", [{"max_level": 0.5}, {"address": FURTHER}])
def test_a_job_that_was_accepted_under_other_settings_lights_nothing(tmp_path: Path, now: dict[str, Any]) -> None:
    ran, settings = Ran(), ServerSettings(data=tmp_path, dome=DomeSettings(**({"address": OWN} | now)))
    earlier = Repository(settings.database_url)
    made = earlier.create(JobSpec.model_validate(job(level=1.0)["json"]), None).job.id
    earlier.close()
    with serving(create_app(settings, ran)) as client:
        client.get(f"/v1/jobs/{made}/events")
        told = client.get(f"/v1/jobs/{made}").json()
    assert (told["state"], told["failure"]["code"], ran.specs) == ("FAILED", "bad-settings", [])


def test_a_signal_darkens_before_open_requests_are_waited_for() -> None:
    darkened, left = threading.Event(), []
    server = _darken_on_signal(SimpleNamespace(handle_exit=lambda sig, _frame: left.append(sig)), darkened.set)  # type: ignore[arg-type]
    server.handle_exit(15, None)
    assert darkened.wait(60)
    assert left == [15]
