"""Valid and invalid requests, generated from the description of the API, to a server that runs jobs.

python -m tests.contracts.generated_requests --cases 10000 --seed 1 --json cases.json

The cases come from the description that the server itself gives. Some of them test the limits of what it allows; the
others are random, half of them valid and half of them invalid by the description. They are sent with a token of the
scope admin, with one that may only read, with a wrong token, or without a token. An answer is good if its status,
content type, headers and body are described, if a request that the description forbids is refused, if a refusal is a
problem document with a known code, and if it is no failure of the server. The server has a simulated dome. In the end
the server must be ready, run a further job, and have kept the data of before.
"""

from __future__ import annotations

import argparse
import json
import random
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from http import HTTPStatus
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import httpx
import requests
import schemathesis
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from hypothesis.errors import Unsatisfiable
from schemathesis import Case, GenerationMode, Response
from schemathesis.core.failures import FailureGroup
from schemathesis.core.result import Ok
from schemathesis.specs.openapi import checks

from services.api.auth.tokens import Scope
from services.api.http.problems import MEDIA_TYPE, Problem
from services.client.errors import error_of
from services.client.tus import CHUNK_TYPE
from tests.contracts.existing_ids import ExistingIds
from tests.contracts.kept_data import finish_job, leave_witnesses
from tests.support.guarded_server import make_token
from tests.support.live_server import toy_server
from tests.support.mouth import write_mouth
from tests.support.postgres import new_database, postgres_server

CHECKS = [
    checks.status_code_conformance,
    checks.content_type_conformance,
    checks.response_headers_conformance,
    checks.response_schema_conformance,
]
CONFIG = {"checks": {"negative_data_rejection": {"expected-statuses": ["4xx", "507"]}}}
CALLERS = ("admin",) * 16 + ("read", "read", "wrong", "nobody")
BORDER_SHARE = 0.2
"""Largest share of cases at the limits of what the description allows."""
MAX_AT_ONCE = 25
"""Largest number of cases of one operation and mode that are drawn together."""
ANSWER_S, STREAM_S = 60.0, 3.0
"""Longest time of an answer, and time for which a stream of events is read."""
STRAY_HEADERS: Mapping[str, tuple[str, ...]] = {
    "Range": ("bytes=0-0", "bytes=9-1", "bytes=-1", "bytes=0-,0-", "bytes=99999999999999999999-", "lines=1"),
    "If-None-Match": ("*", '"', "W/"),
    "If-Range": ('"x"', "yesterday"),
    "Cookie": ("dentine-session=dentine_000000000000_1.x", "dentine-session=", "="),
    "Origin": ("null", "http://elsewhere.example", "http://["),
    "X-Request-ID": ("a", "-", "a" * 65),
    "Host": ("elsewhere.example", "[", "a@b"),
    "Accept": ("text/html", "*/*;q=x"),
    "Content-Encoding": ("gzip",),
}
_PHRASES = {status.phrase.lower().replace(" ", "-") for status in HTTPStatus} | {
    "foreign-host",
    "foreign-origin",
    "not-ready",
}


@dataclass(frozen=True)
class Dressing:
    """Properties with which a case is sent, besides those that the description generates.

    Attributes:
        caller: owner of the token; see ``CALLERS``.
        choice: number that selects among existing objects and contents.
        is_placed: whether the path names an object that exists.
        is_fit: whether a valid case is changed so that the server can carry it out.
        stray: headers that the description does not know.
    """

    caller: str
    choice: int
    is_placed: bool
    is_fit: bool
    stray: Mapping[str, str]


@dataclass
class Fault:
    """One kind of bad answer to one operation."""

    operation: str
    kind: str
    sentence: str
    example: str
    times: int = 1


@dataclass
class Tally:
    """Results of the cases so far."""

    statuses: dict[str, Counter[int]] = field(default_factory=lambda: defaultdict(Counter))
    """Number of answers by status, by operation; status 0 stands for no answer."""
    faults: dict[tuple[str, str], Fault] = field(default_factory=dict)

    @property
    def cases(self) -> int:
        """Number of cases sent."""
        return sum(counter.total() for counter in self.statuses.values())

    def blame(self, operation: str, kind: str, sentence: str, example: str) -> None:
        """Record a bad answer."""
        fault = self.faults.setdefault((operation, kind), Fault(operation, kind, sentence, example, 0))
        fault.times += 1


dressings = st.builds(
    Dressing,
    caller=st.sampled_from(CALLERS),
    choice=st.integers(0, 2**16),
    is_placed=st.integers(0, 3).map(bool),
    is_fit=st.booleans(),
    stray=st.just({}) | st.sampled_from([{name: value} for name, values in STRAY_HEADERS.items() for value in values]),
)


class Sender:
    """Sends generated cases to one server and checks the answers."""

    def __init__(self, address: str, tokens: Mapping[str, str | None], living: ExistingIds) -> None:
        self._address, self._tokens, self._living = address, tokens, living
        schemathesis.serializer.alias(CHUNK_TYPE, "application/octet-stream")
        self._session = requests.Session()
        self._session.trust_env = False
        admin = {"Authorization": f"Bearer {tokens['admin']}"}
        told = self._session.get(f"{address}/v1/openapi.json", headers=admin, timeout=ANSWER_S)
        told.raise_for_status()
        described = told.json()
        for operation in (one for path in described["paths"].values() for one in path.values()):
            operation.pop("security", None)  # because the cases are sent with the tokens of ``CALLERS``
        self._schema = schemathesis.openapi.from_dict(described, config=schemathesis.Config.from_dict(CONFIG))
        self._operations: list[Any] = []
        for found in self._schema.get_all_operations():
            assert isinstance(found, Ok), found.err()
            self._operations.append(found.ok())
        self.tally = Tally()

    @property
    def tags(self) -> dict[str, str]:
        """Class of each operation: the first tag of its description."""
        return {operation.label: (operation.tags or ["other"])[0] for operation in self._operations}

    def run(self, cases: int, start: int, tell: Callable[[str], None]) -> None:
        """Send ``cases`` cases; ``start`` seeds them, and ``tell`` receives lines of progress."""
        dice = random.Random(start)
        border = [case for operation in self._operations for case in self._border(operation)]
        border = dice.sample(border, min(len(border), round(BORDER_SHARE * cases)))
        pairs = [
            (operation, mode)
            for operation in self._operations
            for mode in GenerationMode
            if mode.is_positive or _takes_input(operation)
        ]
        while (left := cases - len(border) - self.tally.cases) > 0:
            start += 1
            most = min(MAX_AT_ONCE, -(-left // len(pairs)))
            pairs = [(operation, mode) for operation, mode in pairs if self._draw(operation, mode, most, start)]
            tell(f"{self.tally.cases} cases, {len(self.tally.faults)} kinds of fault")
        for case in border:
            self._send(
                case,
                Dressing(dice.choice(CALLERS), dice.randrange(2**16), dice.random() < 0.75, dice.random() < 0.5, {}),
            )

    def _border(self, operation: Any) -> Iterator[Case[Any]]:
        modes = list(GenerationMode)
        yield from self._schema.iter_coverage_cases(
            operation, generation_modes=modes, generation_config=self._schema.config.generation
        )

    def _draw(self, operation: Any, mode: GenerationMode, most: int, start: int) -> bool:
        # Send up to ``most`` cases; returns whether the operation has cases of this mode.
        @seed(start)
        @settings(
            max_examples=most,
            database=None,
            deadline=None,
            phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )
        @given(case=operation.as_strategy(generation_mode=mode), dressing=dressings)
        def send(case: Case[Any], dressing: Dressing) -> None:
            self._send(case, dressing)

        with suppress(Unsatisfiable):
            send()
            return True
        return False

    def _send(self, case: Case[Any], dressing: Dressing) -> None:
        if dressing.is_placed:
            self._living.place(case, dressing.choice)
        is_fit = dressing.is_fit and case.meta is not None and case.meta.generation.mode.is_positive
        if is_fit:
            self._living.fit(case, dressing.choice)
        headers = dict(dressing.stray)
        if token := self._tokens[dressing.caller]:
            headers["Authorization"] = f"Bearer {token}"
        label = case.operation.label
        try:
            response = self._call(case, headers)
        except requests.RequestException as problem:
            self.tally.statuses[label][0] += 1
            self.tally.blame(label, "no answer", type(problem).__name__, f"{case!r} {problem}")
            return
        self.tally.statuses[label][response.status_code] += 1
        for kind, sentence in _faults(
            case, response, headers, CHECKS if is_fit else [*CHECKS, checks.negative_data_rejection]
        ):
            self.tally.blame(label, kind, sentence, f"{case.as_curl_command(headers)}\n{response.content[:600]!r}")
        self._living.learn(case, response)

    def _call(self, case: Case[Any], headers: dict[str, str]) -> Response:
        self._session.cookies.clear()
        where: dict[str, Any] = {"base_url": self._address, "session": self._session, "headers": headers}
        if case.path.endswith("/events"):
            with suppress(requests.ReadTimeout):  # no head came within STREAM_S, so ask again with more time
                return case.call(timeout=STREAM_S, **where)
        return case.call(timeout=ANSWER_S, **where)


def _takes_input(operation: Any) -> bool:
    # An operation without parameters or body has no invalid requests.
    return any(operation.iter_parameters()) or bool(operation.body)


def _faults(case: Case[Any], response: Response, headers: dict[str, str], of: list[Any]) -> Iterator[tuple[str, str]]:
    if response.status_code >= 500 and response.status_code != HTTPStatus.INSUFFICIENT_STORAGE:
        yield f"failure of the server ({response.status_code})", str(response.headers.get("x-request-id"))
        return
    if response.status_code not in {HTTPStatus.UNAUTHORIZED, HTTPStatus.FORBIDDEN, HTTPStatus.TOO_MANY_REQUESTS}:
        of = [*of, checks.unsupported_method]  # refused callers are not told which methods exist
    try:
        case.validate_response(response, checks=of, headers=headers)
    except FailureGroup as group:
        yield from ((failure.title, " ".join(failure.message.split())[:300]) for failure in group.exceptions)
    if response.status_code >= 400 and response.request.method != "HEAD":
        yield from ((f"no problem document ({response.status_code})", sentence) for sentence in _flaws(response))


def _flaws(response: Response) -> Iterator[str]:
    # Errors in a refusal's problem document. The code database-lost counts as one, because the database is there.
    if response.headers.get("content-type") != [MEDIA_TYPE]:
        yield f"content type {response.headers.get('content-type')}"
        return
    told = response.json()
    if missing := set(Problem.model_fields) - set(told):
        yield f"members {sorted(missing)} are missing"
        return
    if told["status"] != response.status_code or told["type"] != f"urn:dentine:problem:{told['code']}":
        yield "status or type is another"
    if error_of(told["code"], "") is None and told["code"] not in _PHRASES:
        yield f"unknown code {told['code']}"
    if unquote(told["instance"]) != unquote(urlsplit(response.request.url or "").path):
        yield "instance is not the path of the request"


@dataclass(frozen=True)
class Outcome:
    """A finished run."""

    cases: int
    seconds: float
    classes: dict[str, dict[str, int]]
    """Number of answers by class of status (such as 2xx), by class of operations."""
    operations: dict[str, dict[int, int]]
    """Number of answers by status, by operation."""
    jobs: dict[str, int]
    """Number of jobs at the end, by state."""
    faults: list[Fault]


@contextmanager
def served(folder: Path, database: str | None) -> Iterator[tuple[httpx.Client, Any, dict[str, str | None]]]:
    """Run a server that requires tokens and runs toy jobs; yields a client of the scope admin, the server's process and
    the callers' tokens.
    """
    data = folder / "data"
    data.mkdir()
    tokens: dict[str, str | None] = {
        scope: make_token(data, f"of-{scope}", scope, database=database) for scope in (Scope.ADMIN, Scope.READ)
    }
    tokens |= {"wrong": f"dentine_{'0' * 12}_{'x' * 43}", "nobody": None}
    with (folder / "server.log").open("w") as log:
        more: dict[str, Any] = {} if database is None else {"database": database}
        more |= {
            "access": "tokens",
            "job_roots": str(folder),
            "private_webhooks": True,
            "dome": {"address": "simulated", "watchdog_s": 60.0},
        }
        with toy_server(data, log, "tests.contracts.stages", **more) as (client, process):
            client.headers["Authorization"] = f"Bearer {tokens['admin']}"
            yield client, process, tokens


def survey(
    folder: Path, cases: int, start: int, database: str | None = None, tell: Callable[[str], None] = lambda _: None
) -> Outcome:
    """Serve a new data folder in ``folder``, send the cases, and check the server and its data afterwards."""
    began = time.monotonic()
    with served(folder, database) as (client, process, tokens):
        witnesses = leave_witnesses(client, folder / "data", folder / "capture")
        write_mouth(folder / "mouth", lights=2)
        living = ExistingIds(witnesses, folder / "data", folder / "mouth")
        sender = Sender(str(client.base_url).rstrip("/"), tokens, living)
        sender.run(cases, start, tell)
        living.release()
        tally, jobs = sender.tally, Counter[str]()
        for loss in witnesses.losses(client, folder / "data"):
            tally.blame("afterwards", "loss", loss, "")
        try:
            client.get("/v1/health/ready").raise_for_status()
            finish_job(client, witnesses.capture["path"])
            jobs.update(job["state"] for job in client.get("/v1/jobs?limit=500").raise_for_status().json()["jobs"])
        except (AssertionError, httpx.HTTPError) as problem:
            tally.blame("afterwards", "not ready", f"{problem}; the server ended with {process.poll()}", "")
    by_class: dict[str, Counter[str]] = defaultdict(Counter)
    for label, statuses in tally.statuses.items():
        for status, times in statuses.items():
            by_class[sender.tags[label]][f"{status // 100}xx"] += times
    operations = {label: dict(sorted(counter.items())) for label, counter in sorted(tally.statuses.items())}
    classes = {name: dict(sorted(counter.items())) for name, counter in sorted(by_class.items())}
    return Outcome(tally.cases, time.monotonic() - began, classes, operations, dict(jobs), list(tally.faults.values()))


def main() -> None:
    """Run, print a table and the faults, and write both."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--database", choices=("sqlite", "postgres"), default="sqlite")
    parser.add_argument("--json", type=Path, required=True)
    arguments = parser.parse_args()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        database = None
        if arguments.database == "postgres":
            database = new_database(stack.enter_context(postgres_server()), "cases")
        outcome = survey(folder, arguments.cases, arguments.seed, database, lambda line: print(line, flush=True))
        log = (folder / "server.log").read_text()
    arguments.json.write_text(json.dumps(asdict(outcome), indent=1) + "\n")
    if outcome.faults:
        arguments.json.with_suffix(".log").write_text(log)
    for name, answers in outcome.classes.items():
        print(
            f"{name:10} {sum(answers.values()):6}  " + "  ".join(f"{kind} {times}" for kind, times in answers.items())
        )
    for fault in outcome.faults:
        print(f"\n{fault.operation}: {fault.kind}, {fault.times} times: {fault.sentence}\n{fault.example}")
    if unanswered := [
        label for label, statuses in outcome.operations.items() if not any(200 <= status < 300 for status in statuses)
    ]:
        print(f"\nNever answered 2xx: {', '.join(unanswered)}.")
    print(
        f"\n{outcome.cases} cases in {outcome.seconds:.0f} s, jobs {outcome.jobs}, {len(outcome.faults)} kinds of"
        " fault."
    )
    raise SystemExit(bool(outcome.faults))


if __name__ == "__main__":
    main()
