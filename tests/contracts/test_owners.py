"""Access rights: every route × every scope × the owner of the object that the path names.

A request for another group's object gets the same answer as one for an object that does not exist.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest

from services.api.auth.scopes import LIVENESS, SETUP, scoped_routes
from services.api.auth.tokens import Scope
from services.api.dome.dome import Dome
from services.api.jobs.jobs import Jobs
from services.core.dome import DomeAnswer, DomeStatus
from services.core.errors import CaptureInputError
from services.core.records import JobSpec
from services.core.settings import RateSettings
from tests.support.guarded_server import Guarded, guarded, make_token
from tests.support.uploading import TUS, announce, contents_of, manifest_of, send, upload_capture, write_capture

UNKNOWN = {"job_id": "0123456789ab", "capture": "fedcba9876543210"}
"""Ids in the server's format of objects that do not exist."""
GROUPS: Mapping[str, str | None] = {"own": "orthodontics", "other": "surgery", "alone": None}
LAST = ("DELETE /v1/uploads/{capture}/{number}", "DELETE /v1/captures/{capture}", "DELETE /v1/jobs/{job_id}")
"""Routes that delete the objects that the other routes name; they are tried last."""


@dataclass(frozen=True)
class House:
    """A server with the objects of one group, and tokens of callers of several groups."""

    server: Guarded
    tokens: Mapping[tuple[str, Scope], str]
    ids: Mapping[str, str]
    receipt: str

    def ask(self, method: str, path: str, whose: str, scope: Scope, **options: Any) -> httpx.Response:
        """Send a request with the token of a group and scope."""
        headers = {"Authorization": f"Bearer {self.tokens[whose, scope]}"} | options.pop("headers", {})
        return self.server.ask(method, path, headers=headers, **options)


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    data, folder = tmp_path_factory.mktemp("data"), write_capture(tmp_path_factory.mktemp("capture"))
    tokens = {
        (whose, scope): make_token(data, f"{whose}-{scope}", scope, group=group)
        for whose, group in GROUPS.items()
        for scope in Scope
    }
    with guarded(data, run_to_report, rates=RateSettings(refusals_per_minute=10_000)) as server:
        with httpx.Client(
            base_url=server.client.base_url,
            headers={"Authorization": f"Bearer {tokens['own', Scope.SUBMIT]}"},
            timeout=60,
        ) as own:
            capture = upload_capture(own, contents_of(folder))
            jobs = [
                own.post("/v1/jobs", json={"capture": f"captures/{capture}", "seed": seed}).json()["id"]
                for seed in (1, 2)
            ]
            for job in jobs:
                own.get(f"/v1/jobs/{job}/events")
            receipt = own.delete(f"/v1/jobs/{jobs[1]}").json()["job"]
        yield House(server, tokens, {"job_id": jobs[0], "capture": capture}, receipt)


def run_to_report(_spec: object, folder: Path, _events: object) -> None:
    (folder / "report.html").write_text("<!doctype html>")


def operations(house: House) -> list[tuple[str, str, Scope]]:
    """Method, template and scope of every route that names a job or a capture; deleting routes come last."""
    routes = [route for route in scoped_routes(house.server.app.routes) if route.template not in {LIVENESS, SETUP}]
    found = [(method, route.template, route.needs.scope) for route in routes if route.needs for method in route.methods]
    named = [one for one in found if re.search(r"{(job_id|capture)}", one[1])]
    return sorted(named, key=lambda one: LAST.index(f"{one[0]} {one[1]}") if f"{one[0]} {one[1]}" in LAST else -1)


def path_of(template: str, ids: Mapping[str, str], receipt: str) -> str:
    ids = {**ids, "job_id": receipt} if template.startswith("/v1/deletions") else ids
    others = {
        "number": "0",
        "path": "report.html",
        "preview_id": "1",
        "picture": "render",
        "camera": "c0",
        "light": "l0",
        "name": "rig",
    }
    return template.format(**others | dict(ids))


def told(answer: httpx.Response, ids: Mapping[str, str], receipt: str) -> tuple[int, str, dict[str, str]]:
    """Status, text and headers of an answer, without the parts that depend on the id in the request."""
    text = answer.text
    for name in {*ids.values(), receipt}:
        text = text.replace(name, "ID")
    headers = {
        name: value for name, value in answer.headers.items() if name not in {"x-request-id", "date", "content-length"}
    }
    return answer.status_code, text, headers


@pytest.mark.attack("routes × scopes", "every route × every scope × whose job, receipt or capture")
def test_every_route_with_every_scope_for_every_owner(house: House) -> None:
    table = operations(house)
    assert len(table) > 20
    absent = UNKNOWN, UNKNOWN["job_id"]
    for method, template, needed in table:
        there, nowhere = path_of(template, house.ids, house.receipt), path_of(template, *absent)
        for scope in sorted(set(Scope) - {Scope.ADMIN}):
            for whose in ("other", "alone"):
                label = f"{method} {template} as {scope} of {whose}"
                found, unknown = (house.ask(method, path, whose, scope) for path in (there, nowhere))
                if needed not in scope.included:
                    assert found.status_code == unknown.status_code == 403, label
                else:
                    assert told(found, house.ids, house.receipt) == told(unknown, *absent), label
                    assert found.status_code == 404, label
        for whose, scope in (("own", Scope.SUBMIT), ("own", Scope.READ), ("other", Scope.ADMIN)):
            if needed in scope.included and not (scope is Scope.ADMIN and f"{method} {template}" in LAST):
                answer = house.ask(method, there, whose, scope)
                assert answer.status_code != 403, f"{method} {template} as {scope} of {whose}: {answer.text}"
                is_lost = re.search(r'"code":"(job|capture)-unknown"', answer.text) and not re.search(
                    "has no (artifact|upload|render)", answer.text
                )
                assert not is_lost, f"{method} {template} as {scope} of {whose}: {answer.text}"


@pytest.fixture
def fresh(tmp_path: Path) -> Iterator[House]:
    """A server for one test alone, for tests that add or delete objects."""
    data = tmp_path / "data"
    tokens = {
        (whose, scope): make_token(data, f"{whose}-{scope}", scope, group=group)
        for whose, group in GROUPS.items()
        for scope in Scope
    }
    with guarded(data, run_to_report) as server:
        yield House(server, tokens, {}, "")


@pytest.mark.attack("routes × scopes", "lists, event streams, and jobs on what others own")
def test_lists_show_what_is_ones_own(fresh: House, tmp_path: Path) -> None:
    contents = contents_of(write_capture(tmp_path / "capture"))
    made: dict[str, tuple[str, str, str]] = {}
    for whose in GROUPS:
        with httpx.Client(
            base_url=fresh.server.client.base_url,
            headers={"Authorization": f"Bearer {fresh.tokens[whose, Scope.SUBMIT]}"},
            timeout=60,
        ) as client:
            capture = upload_capture(client, contents)
            job = client.post("/v1/jobs", json={"capture": f"captures/{capture}"}, headers={"Idempotency-Key": "one"})
            assert job.status_code == 201, job.text
            units = client.get(f"/v1/captures/{capture}/calibration").json()
            units["lights"][0]["position_mm"][2] -= len(made)
            assert client.put("/v1/calibrations/rig", json=units).status_code == 201
            made[whose] = capture, job.json()["id"], client.get("/v1/calibrations/rig").json()["id"]
    assert len({capture for capture, _, _ in made.values()}) == 3  # the same files give a capture for each group

    def seen(whose: str, scope: Scope) -> tuple[set[str], ...]:
        answers = [
            fresh.ask("GET", path, whose, scope).json() for path in ("/v1/captures", "/v1/jobs", "/v1/calibrations")
        ]
        return tuple({one["id"] for one in found} for found in (answers[0]["captures"], answers[1]["jobs"], answers[2]))

    for whose in ("own", "other"):
        for scope in (Scope.SUBMIT, Scope.READ):
            assert seen(whose, scope) == tuple({one} for one in made[whose])
    assert seen("alone", Scope.SUBMIT) == tuple({one} for one in made["alone"])
    assert seen("alone", Scope.READ) == (set(), set(), set())  # another token, in no group
    assert seen("other", Scope.ADMIN) == tuple(set(column) for column in zip(*made.values(), strict=True))

    for option, theirs in (
        ("capture", f"captures/{made['own'][0]}"),
        ("rig", {"mouth": f"captures/{made['own'][0]}", "dome": "simulated"}),
    ):
        refused = fresh.ask("POST", "/v1/jobs", "other", Scope.SUBMIT, json={option: theirs})
        assert (refused.status_code, "There is no capture" in refused.json()["detail"]) == (422, True), refused.text
    foreign = {"capture": f"captures/{made['other'][0]}", "calibration": f"calibrations/{made['own'][2]}"}
    refused = fresh.ask("POST", "/v1/jobs", "other", Scope.SUBMIT, json=foreign)
    assert (refused.status_code, "there is no calibrations/" in refused.json()["detail"]) == (422, True), refused.text
    metadata = {
        "Upload-Length": "1",
        "Upload-Metadata": f"capture {_base64(made['own'][0])},path {_base64('capture.json')}",
    } | TUS
    assert fresh.ask("POST", "/v1/uploads", "other", Scope.SUBMIT, headers=metadata).json()["code"] == "capture-unknown"
    assert fresh.ask("GET", "/v1/workers", "other", Scope.READ).status_code == 200
    streams = [
        fresh.ask("GET", f"/v1/events?job={job}", "other", Scope.READ).text
        for job in (made["own"][1], UNKNOWN["job_id"])
    ]
    assert streams[0].replace(made["own"][1], "ID") == streams[1].replace(UNKNOWN["job_id"], "ID")
    assert streams[0].count("event:") == 1
    assert '"SUCCEEDED"' in fresh.ask("GET", f"/v1/events?job={made['other'][1]}", "other", Scope.READ).text


def _base64(text: str) -> str:
    import base64

    return base64.b64encode(text.encode()).decode()


@pytest.mark.attack("uploads", "another's content by its SHA-256 alone")
def test_who_knows_a_hash_alone_neither_gets_the_content_nor_learns_that_it_is_here(
    fresh: House, tmp_path: Path
) -> None:
    contents = contents_of(write_capture(tmp_path / "capture"))
    own, other = (
        httpx.Client(
            base_url=fresh.server.client.base_url,
            headers={"Authorization": f"Bearer {fresh.tokens[whose, Scope.SUBMIT]}"},
            timeout=60,
        )
        for whose in ("own", "other")
    )
    with own, other:
        upload_capture(own, contents)
        asked = announce(other, contents)
        assert {file["is_known"] for file in asked["files"]} == {False}
        assert asked["missing_bytes"] == sum(map(len, contents.values()))
        refused = other.post(f"/v1/captures/{asked['id']}/commit").json()
        assert {fault["kind"] for fault in refused["files"]} == {"missing"}
        name, content = next(iter(contents.items()))
        wrong = send(other, asked["id"], name, bytes(len(content)))
        assert wrong.json()["code"] == "upload-corrupt", wrong.text
        for path, whole in contents.items():
            assert send(other, asked["id"], path, whole).status_code == 204
        assert other.post(f"/v1/captures/{asked['id']}/commit").status_code == 200
        assert other.delete(f"/v1/captures/{asked['id']}").status_code == 204
        again = own.post("/v1/captures", json=manifest_of(contents)).json()
        assert (again["state"], again["missing_bytes"]) == ("committed", 0)  # the other deletion left this content


@pytest.mark.attack("traversal", "a job on a folder outside the roots, by '..', by a link, or in the data folder")
def test_folders_of_the_server_are_for_those_who_may_name_them(tmp_path: Path) -> None:
    root, beside, data = tmp_path / "captures-root", tmp_path / "beside", tmp_path / "data"
    for folder in (root, beside):
        write_capture(folder / "mouth")
    (root / "way-out").symlink_to(beside)

    def run(spec: JobSpec, folder: Path, _events: object) -> None:
        raise CaptureInputError(f"{spec.capture}/capture.json: units: wrong, see {folder}/report.html.")

    with guarded(data, run, job_roots=f"{root}, {tmp_path / 'data' / 'jobs'}") as server:
        taken = server.ask("POST", "/v1/jobs", Scope.SUBMIT, json={"capture": str(root / "mouth")})
        assert taken.status_code == 201, taken.text
        names = (
            beside / "mouth",
            beside / "absent",
            root / ".." / "beside" / "mouth",
            root / "way-out" / "mouth",
            data / "jobs",
            "/etc/passwd\0",
        )
        refusals = {
            re.sub(r"'[\w.]+'", "", server.ask("POST", "/v1/jobs", scope, json=asked).json()["detail"])
            for scope in (Scope.SUBMIT, Scope.ADMIN)
            for path in names
            for asked in (
                {"capture": str(path)},
                {"rig": {"mouth": str(path), "dome": "simulated"}},
                {"capture": str(root), "calibration": str(path)},
            )
        }
        assert len(refusals) == 1, refusals
        assert "takes no folder of its own there" in refusals.pop()

        job = taken.json()["id"]
        for scope, shown in (
            (Scope.READ, "mouth"),
            (Scope.SUBMIT, str(root / "mouth")),
            (Scope.ADMIN, str(root / "mouth")),
        ):
            listed = server.ask("GET", "/v1/jobs", scope).json()["jobs"][0]["spec"]["capture"]
            assert (listed, server.ask("GET", f"/v1/jobs/{job}", scope).json()["spec"]["capture"]) == (shown, shown)
            found = {
                text: len(server.ask("GET", "/v1/jobs", scope, params={"capture": text}).json()["jobs"])
                for text in ("MOUTH", "captures-root")
            }
            assert found == {"MOUTH": 1, "captures-root": int(scope is not Scope.READ)}
        events = server.ask("GET", f"/v1/jobs/{job}/events", Scope.READ).text
        failure = server.ask("GET", f"/v1/jobs/{job}", Scope.READ).json()["failure"]["message"]
        assert failure == f"mouth/capture.json: units: wrong, see jobs/{job}/report.html."
        assert str(tmp_path) not in events


@pytest.mark.attack("traversal", "a job on any folder of a server that names no root")
def test_without_roots_a_server_with_tokens_takes_no_folder(tmp_path: Path) -> None:
    write_capture(tmp_path / "mouth")
    with guarded(tmp_path / "data", job_roots="") as server:
        refused = server.ask("POST", "/v1/jobs", Scope.ADMIN, json={"capture": str(tmp_path / "mouth")})
        assert (refused.status_code, "JOB_ROOTS" in refused.json()["detail"]) == (422, True)


@pytest.mark.attack("tokens", "a copied cookie after signing out")
def test_a_session_that_was_signed_out_opens_nothing(tmp_path: Path) -> None:
    with guarded(tmp_path) as server:
        cookie, other = (
            {"Cookie": server.ask("POST", "/v1/session", Scope.READ).headers["set-cookie"].split(";")[0]}
            for _ in range(2)
        )
        assert server.client.get("/v1/jobs", headers=cookie).status_code == 200
        here = cookie | {"Origin": str(server.client.base_url).rstrip("/")}
        assert server.client.delete("/v1/session", headers=here).status_code == 204
        refused = server.client.get("/v1/jobs", headers=cookie)  # as a thief of the cookie would ask
        assert (refused.status_code, refused.json()["code"]) == (401, "unauthenticated")
        assert server.client.get("/v1/jobs", headers=other).status_code == 200  # another session of the same token
        assert server.ask("GET", "/v1/jobs", Scope.READ).status_code == 200


@pytest.mark.attack("cross-site", "a report inside another page")
def test_a_report_is_shown_inside_no_other_page(house: House) -> None:
    answer = house.ask("GET", f"/v1/jobs/{house.ids['job_id']}/artifacts/report.html", "other", Scope.ADMIN)
    assert answer.status_code in {200, 404}  # an earlier test may have deleted the job
    assert "frame-ancestors 'none'" in answer.headers["content-security-policy"]


@pytest.mark.attack("routes × scopes", "the ids of others' jobs in the dome's answers")
def test_the_dome_names_jobs_to_those_alone_who_may_see_them(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    # Submit a new job, because earlier tests may have deleted the others.
    asked = {"capture": f"captures/{house.ids['capture']}", "seed": 3}
    job = house.ask("POST", "/v1/jobs", "own", Scope.SUBMIT, json=asked).json()["id"]
    status = dict.fromkeys(("interlock_closed", "emergency_stop", "supply_on", "stopped"), False)
    told = {"firmware": "1", "light_count": 1, "faults": (), "lit": (), "temperature_degc": (), "current_ma": ()}
    answer = DomeAnswer(number=1, status=DomeStatus.model_validate(told | status))
    monkeypatch.setattr(Dome, "_process_ask", lambda *_, **__: answer)
    for name in ("capturing", "cancel_captures"):
        monkeypatch.setattr(Jobs, name, lambda self: [self.repository.get(job)])
    for whose, scope, shown in (
        ("own", Scope.OPERATE_DOME, [job]),
        ("other", Scope.ADMIN, [job]),
        ("other", Scope.OPERATE_DOME, []),
        ("alone", Scope.OPERATE_DOME, []),
    ):
        state = house.ask("GET", "/v1/dome", whose, scope).json()
        off = house.ask("POST", "/v1/dome/off", whose, scope).json()
        busy = house.ask("PUT", "/v1/dome/light", whose, scope, json={"light": 0}).json()["detail"]
        assert (state["capturing"], state["others_capturing"]) == (shown, 1 - len(shown))
        assert (off["stopped"], off["others_stopped"]) == (shown, 1 - len(shown))
        assert ("captures with a dome" in busy, job in busy) == (True, bool(shown))
