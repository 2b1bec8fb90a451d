"""One request id connects an HTTP answer to the worker that runs the job, in log lines that programs can parse and that
contain no secrets.
"""

from __future__ import annotations

import io
import json
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from services.api.app import create_app
from services.api.auth.scopes import needs
from services.core.settings import ServerSettings
from services.pipeline.logs import configure_logs, log_context
from services.pipeline.machine_class import machine_class
from tests.support.guarded_server import run_nothing
from tests.support.live_server import serving, toy_server


@pytest.fixture
def lines() -> Iterator[Any]:
    """Log as ``serve`` does, but into memory; yields a function that returns the lines so far."""
    root, services = logging.getLogger(), logging.getLogger("services")
    earlier = (root.handlers, root.level, services.level)
    stream = io.StringIO()
    configure_logs(stream)
    try:
        yield lambda: [json.loads(line) for line in stream.getvalue().splitlines()]
    finally:
        root.handlers, level, other = earlier
        root.setLevel(level)
        services.setLevel(other)


def broken() -> None:
    raise ZeroDivisionError("on purpose")


def test_one_id_leads_from_the_answer_to_the_worker(tmp_path: Path) -> None:
    log = tmp_path / "stderr"
    with log.open("w") as stream, toy_server(tmp_path / "data", stream) as (client, process):
        answer = client.post("/v1/jobs", json={"capture": "/", "workers": 1}, headers={"X-Request-ID": "visit-7.a"})
        job = answer.json()
        assert answer.headers["x-request-id"] == job["request_id"] == "visit-7.a"
        events = client.get(f"/v1/jobs/{job['id']}/events").text
        process.terminate()
        assert process.wait(60) == 0
    lines = [json.loads(line) for line in log.read_text().splitlines() if line.startswith("{")]
    of_job = [line for line in lines if line.get("job") == job["id"] and line.get("request_id") == "visit-7.a"]
    assert {"Job submitted.", "Job ran."} <= {line["message"] for line in of_job}
    of_worker = [(line["stage"], line["attempt"], line["message"]) for line in of_job if "stage" in line]
    assert of_worker == [
        (stage, 1, f"Stage {what}.") for stage in ("prepare", "fit", "export") for what in ("started", "finished")
    ]
    submitted = [line for line in lines if line["message"] == "Request answered." and line["request_id"] == "visit-7.a"]
    assert [(line["method"], line["route"], line["status"], line["client"]) for line in submitted] == [
        ("POST", "/v1/jobs", 201, "127.0.0.1")
    ]
    assert submitted[0]["duration_s"] > 0
    started = [json.loads(line.removeprefix("data: ")) for line in events.splitlines() if '"kind":"started"' in line]
    assert [event["data"] for event in started] == [
        {"job": job["id"], "request_id": "visit-7.a", "machine": machine_class()}
    ] * 3


def test_an_id_that_is_not_well_formed_is_replaced(tmp_path: Path) -> None:
    with serving(create_app(ServerSettings(data=tmp_path), run_nothing)) as client:
        for asked in ("", "a b", "x" * 65, "-a", 'a"b', "<b>"):
            made = [
                client.get("/v1/health/live", headers={"X-Request-ID": asked}).headers["x-request-id"] for _ in range(2)
            ]
            assert asked not in made
            assert made[0] != made[1]
            assert all(len(one) == 16 for one in made), asked


def test_a_line_holds_the_route_and_never_path_or_query(tmp_path: Path, lines: Any) -> None:
    with serving(create_app(ServerSettings(data=tmp_path), run_nothing)) as client:
        for path in ("/v1/jobs/hush-1?token=hush-2", "/v1/nothing/hush-3", "/v1/jobs?capture=hush-4"):
            client.get(path, headers={"Authorization": "Bearer hush-5", "Cookie": "session=hush-6"})
        client.get("/v1/jobs", headers={"Host": "hush-7.example"})
    told = [line for line in lines() if line["message"] == "Request answered."]
    assert [(line["route"], line["status"]) for line in told] == [
        ("/v1/jobs/{job_id}", 404),
        ("unrouted", 404),
        ("/v1/jobs", 200),
        ("unrouted", 400),
    ]
    assert "hush" not in json.dumps(lines())


def test_a_request_that_breaks_the_server_is_logged_with_its_id(tmp_path: Path, lines: Any) -> None:
    app = create_app(ServerSettings(data=tmp_path), run_nothing)
    app.add_api_route("/v1/broken", broken, dependencies=[needs("read")])
    app.router.routes.insert(0, app.router.routes.pop())  # ahead of the dashboard's route, which matches every path
    with serving(app) as client:
        answer = client.get("/v1/broken", headers={"X-Request-ID": "r-500"})
    assert (answer.status_code, answer.json()["code"], answer.headers["x-request-id"]) == (
        500,
        "internal-error",
        "r-500",
    )
    assert "r-500" in answer.json()["detail"]
    of_request = [line for line in lines() if line.get("request_id") == "r-500"]
    assert [line["status"] for line in of_request if line["message"] == "Request answered."] == [500]


def test_a_method_that_nobody_knows_is_not_repeated(tmp_path: Path, lines: Any) -> None:
    with serving(create_app(ServerSettings(data=tmp_path), run_nothing)) as client:
        assert client.request("X" * 1000, "/v1/jobs").status_code == 405
    (answered,) = (line for line in lines() if line["message"] == "Request answered.")
    assert (answered["method"], answered["status"]) == ("other", 405)


def test_what_is_logged_inside_a_block_carries_its_values(lines: Any) -> None:
    with log_context(job="j1", request_id=None):
        try:
            broken()
        except ZeroDivisionError:
            logging.getLogger("services.api.any").exception("Broke %s.", "here", extra={"stage": "fit"})
    logging.getLogger("services.api.any").info("After.")
    logging.getLogger("elsewhere").info("Not heard.")
    inside, after = lines()
    assert (inside["message"], inside["job"], inside["stage"], inside["level"], inside["logger"]) == (
        "Broke here.",
        "j1",
        "fit",
        "error",
        "services.api.any",
    )
    assert "ZeroDivisionError: on purpose" in inside["exception"]
    assert "request_id" not in inside
    assert (after["message"], "job" in after) == ("After.", False)


def test_a_terminal_gets_plain_lines() -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    root, services = logging.getLogger(), logging.getLogger("services")
    earlier = (root.handlers, root.level, services.level)
    stream = Terminal()
    try:
        configure_logs(stream)
        logging.getLogger("services.api.any").warning("The lamp is out.")
    finally:
        root.handlers, level, other = earlier
        root.setLevel(level)
        services.setLevel(other)
    assert "The lamp is out." in stream.getvalue()
    assert not stream.getvalue().startswith("{")
