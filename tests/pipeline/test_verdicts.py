"""A job whose fit did not converge counts as succeeded, and the API, lists and the exit status of every waiting command
say that it did not converge.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from typer.testing import CliRunner

from services.api.app import create_app
from services.cli.app import build_app
from services.core.records import JobSpec
from services.core.results import AssetManifest, FitReport, Verdict
from services.core.settings import ServerSettings
from services.core.stage import StageEvent
from services.core.verdict import NOT_CONVERGED_STATUS, VERDICT, verdict_of
from services.pipeline.database import open_database
from services.pipeline.event_log import EventAddress
from tests.support.live_server import serving


def verdict(*, converged: bool, advice: str = "") -> Verdict:
    errors = {"green": 0.04 if converged else 0.336}
    report = FitReport(
        converged=converged, doubtful=bool(advice), advice=advice if converged else "Check the mesh.", parameters={},
        fit_error=errors, held_out_error=errors, held_out_error_se={"green": 0.012}, steps=9, seconds=1.0,
    )  # fmt: skip
    return verdict_of(report)


GOOD, BAD = verdict(converged=True), verdict(converged=False)
DOUBTFUL = verdict(converged=True, advice="Unseen images are far off.")


def run(spec: JobSpec, _folder: Path, events: EventAddress) -> None:
    """Stand-in for the stages: seed 1 converges, 2 does not, 3 is of a version without verdicts, 4 of a version with
    another form of verdict.
    """
    good, bad = ({VERDICT: one.model_dump(mode="json")} for one in (GOOD, BAD))
    data: dict[str, Any] = {1: good, 2: bad, 3: {}, 4: {VERDICT: {"is_good": True}}}[spec.seed]
    with events.open() as log:
        log.append(log.begin_stage("fit"), StageEvent(stage="fit", kind="finished", data=data))


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    with serving(create_app(ServerSettings(data=tmp_path_factory.mktemp("data")), run)) as client:
        yield client


def submitted(server: httpx.Client, seed: int) -> str:
    job = str(server.post("/v1/jobs", json={"capture": "/", "seed": seed}).raise_for_status().json()["id"])
    server.get(f"/v1/jobs/{job}/events")
    return job


def dentine(*arguments: str) -> tuple[int, str, str]:
    answer = CliRunner().invoke(build_app(), arguments)
    return answer.exit_code, answer.stdout, answer.stderr


def test_the_api_tells_of_each_job_that_succeeded_how_well_its_fit_went(server: httpx.Client) -> None:
    jobs = {seed: submitted(server, seed) for seed in (1, 2, 3, 4)}
    for _ in range(2):  # first read from the events, then from the cache
        listed = {job["id"]: job for job in server.get("/v1/jobs?limit=4").json()["jobs"]}
        for seed, expected in ((1, GOOD), (2, BAD), (3, None), (4, None)):
            told = None if expected is None else json.loads(expected.model_dump_json())
            assert listed[jobs[seed]]["state"] == "SUCCEEDED"
            assert listed[jobs[seed]][VERDICT] == server.get(f"/v1/jobs/{jobs[seed]}").json()[VERDICT] == told
    assert server.patch(f"/v1/jobs/{jobs[2]}", json={"name": "Anna"}).json()[VERDICT]["converged"] is False


def test_only_the_newest_fit_of_a_job_that_has_succeeded_counts(server: httpx.Client, tmp_path: Path) -> None:
    fits = iter((BAD, GOOD))

    def run_again(_spec: JobSpec, _folder: Path, events: EventAddress) -> None:
        with events.open() as log:
            log.append(
                log.begin_stage("fit"),
                StageEvent(stage="fit", kind="finished", data={VERDICT: next(fits).model_dump(mode="json")}),
            )

    settings = ServerSettings(data=tmp_path)
    with serving(create_app(settings, run_again)) as client:
        job = submitted(client, 1)
        assert client.get(f"/v1/jobs/{job}").json()[VERDICT]["converged"] is False
        engine = open_database(settings.database_url)
        with engine.begin() as connection:  # as after a change of its masks
            connection.exec_driver_sql("UPDATE job SET state = 'FAILED'")
        engine.dispose()
        assert client.get(f"/v1/jobs/{job}").json()[VERDICT] is None
        client.post(f"/v1/jobs/{job}/retry").raise_for_status()
        client.get(f"/v1/jobs/{job}/events")
        assert client.get(f"/v1/jobs/{job}").json()[VERDICT]["converged"] is True


def test_the_exit_status_and_the_list_tell_it(server: httpx.Client) -> None:
    good, bad, unjudged = (submitted(server, seed) for seed in (1, 2, 3))
    at = ("--server", str(server.base_url))
    assert dentine("watch", good, *at)[:2] == (0, "SUCCEEDED\n")
    assert dentine("watch", unjudged, *at)[:2] == (0, "SUCCEEDED\n")
    status, told, said = dentine("watch", bad, *at)
    assert (status, told) == (NOT_CONVERGED_STATUS, "NOT CONVERGED\n")
    assert BAD.headline in said
    assert said.endswith("Check the mesh.\n")
    status, told, _ = dentine("watch", bad, "--json", *at)
    assert (status, json.loads(told)[VERDICT]["converged"]) == (NOT_CONVERGED_STATUS, False)
    states = dict(line.split("  ")[:2] for line in dentine("jobs", *at)[1].splitlines())
    assert {name: states[name].strip() for name in (good, bad)} == {good: "SUCCEEDED", bad: "NOT CONVERGED"}


def test_submit_tells_it_with_its_exit_status(server: httpx.Client, tmp_path: Path) -> None:
    (job := tmp_path / "JOB.toml").write_text('capture = "/"\nseed = 2\n')
    status, told, _ = dentine("submit", str(job), "--watch", "--server", str(server.base_url))
    assert (status, told.splitlines()[-1]) == (NOT_CONVERGED_STATUS, "NOT CONVERGED")


@pytest.mark.parametrize(("judged", "status"), [(GOOD, 0), (DOUBTFUL, 0), (BAD, NOT_CONVERGED_STATUS), (None, 0)])
@pytest.mark.parametrize("as_json", [False, True])
def test_a_run_without_a_server_tells_it_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, judged: Verdict | None, status: int, as_json: bool
) -> None:
    asset = AssetManifest(files=(), held_out_error=0.2, converged=judged is not BAD, verdict=judged)
    monkeypatch.setattr("services.pipeline.stages.run_job", lambda *_: asset)
    (job := tmp_path / "JOB.toml").write_text(f'capture = "{tmp_path / "capture"}"\n')
    found, told, said = dentine("run", str(job), "--out", str(tmp_path / "out"), *(("--json",) if as_json else ()))
    assert found == status, said
    if as_json:
        assert json.loads(told)[VERDICT] == (None if judged is None else judged.model_dump(mode="json"))
    else:
        shown = {
            None: "held-out error: 20.00 %",
            GOOD.headline: "held-out error: 4.0 ± 1.2 %",
            DOUBTFUL.headline: "held-out error: 4.0 ± 1.2 %",
            BAD.headline: "held-out error: 33.6 ± 1.2 %",
        }
        assert told.splitlines()[0] == shown[None if judged is None else judged.headline]
    if judged is not None:
        assert judged.headline in said
        assert said.endswith(f"{judged.advice}\n")
