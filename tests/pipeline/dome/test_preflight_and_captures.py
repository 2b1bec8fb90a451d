"""Preflights, and captures that have exclusive use of the dome."""

from __future__ import annotations

import threading
from pathlib import Path

import httpx

from services.capture.console import LOCK_TIMEOUT_S
from services.capture.dome.controller import DomeObserver
from services.capture.dome.registers import FaultKind
from services.capture.dome.simulator import order_fault
from tests.support.dome_by_hand import Address, Jobs, lit, problem_of, rig, wait_until


def test_a_preflight_tells_what_it_finds(
    client: httpx.Client, observer: DomeObserver, shared_dome: Address, tmp_path: Path
) -> None:
    assert client.post("/v1/dome/preflight", json=rig(tmp_path)).json() == {"findings": []}
    assert lit(observer) == ()
    order_fault(*shared_dome, FaultKind.DEAD_LIGHT, 4)
    answer = client.post("/v1/dome/preflight", json=rig(tmp_path))
    assert problem_of(answer) == (502, "rig-readback")
    assert "Light 4" in answer.json()["detail"]
    for wrong, named in (
        ({"mouth": "mouth"}, "relative"),
        ({"mouth": "/no/such"}, "does not exist"),
        ({"dome": "other:5020"}, "and no other"),
    ):
        answer = client.post("/v1/dome/preflight", json=rig(tmp_path) | wrong)
        assert problem_of(answer) == (422, "bad-settings")
        assert named in answer.json()["detail"]


def test_all_off_ends_a_preflight(client: httpx.Client, observer: DomeObserver, tmp_path: Path) -> None:
    answers: list[httpx.Response] = []
    # The black and the lit frame each take twice as long as the light by hand below waits for the dome, so that the
    # preflight is certainly still running.
    wanted = rig(tmp_path, exposure_s=2 * LOCK_TIMEOUT_S, level=0.1)
    asking = threading.Thread(target=lambda: answers.append(client.post("/v1/dome/preflight", json=wanted)))
    asking.start()
    wait_until(lambda: lit(observer) != ())
    assert problem_of(client.put("/v1/dome/light", json={"light": 0})) == (409, "dome-busy")
    assert client.post("/v1/dome/off").json()["status"]["lit"] == []
    asking.join()
    assert problem_of(answers[0]) == (409, "rig-stopped")
    assert lit(observer) == ()


def test_a_capture_has_the_dome_for_itself(
    client: httpx.Client, observer: DomeObserver, jobs: Jobs, tmp_path: Path
) -> None:
    begun, go = threading.Event(), threading.Event()

    def hold(*_: object) -> None:
        begun.set()
        go.wait(60)

    jobs.run = hold
    client.put("/v1/dome/light", json={"light": 2, "on_s": 30}).raise_for_status()
    job = client.post("/v1/jobs", json={"rig": rig(tmp_path)}).json()["id"]
    try:
        assert begun.wait(60)
        assert lit(observer) == (), "the light by hand outlived the beginning of the capture"
        for path, method, body in (("light", "PUT", {"light": 2}), ("preflight", "POST", rig(tmp_path))):
            answer = client.request(method, f"/v1/dome/{path}", json=body)
            assert problem_of(answer) == (409, "dome-busy")
            assert job in answer.json()["detail"]
        assert client.get("/v1/dome").json()["capturing"] == [job]
        assert client.delete("/v1/dome/light").status_code == 200
        queued = client.post("/v1/jobs", json={"rig": rig(tmp_path)}).json()["id"]
        other = client.post("/v1/jobs", json={"capture": str(tmp_path)}).json()["id"]
        assert client.post("/v1/dome/off").json()["stopped"] == [queued, job]
        states = [client.get(f"/v1/jobs/{one}").json()["state"] for one in (job, queued, other)]
        assert states[:2] == ["CANCELLING", "CANCELLED"], "the next capture in the queue would light the dome again"
        assert states[2] in {"QUEUED", "RUNNING"}, "a job that does not capture is left alone"
    finally:
        go.set()
        client.get(f"/v1/jobs/{other}/events")
