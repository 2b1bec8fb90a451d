"""Effect of 2,000 fuzzed inputs on the server: its answers, its memory, and the latency of other readers.

python -m tests.benchmarks.fuzzed_load --json fuzzed.json [--inputs 2000] [--pairs 12] [--seed 1]

Nine in ten inputs are requests generated from the API's description, valid and invalid, by callers with every right and
with none (see ``generated_requests``). The others are captures with a damaged description or image, which are
announced, sent and committed; some descriptions are the costliest that the server accepts. First all inputs are sent
one by one and checked: no undocumented failure of the server, no traceback in its log, and its memory. Then the
requests are sent again while another client reads, in pairs of a quiet and a loaded period in alternating order.
Latency counts from the time at which a request was due. Requests that started a job are not sent again, because
``tests.benchmarks.load`` measures the load of jobs.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import random
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import psutil
import requests
from requests.structures import CaseInsensitiveDict

from services.api.auth.tokens import Scope
from services.api.captures.descriptions import MAX_DESCRIPTION_BYTES
from tests.contracts.existing_ids import ExistingIds
from tests.contracts.generated_requests import Sender, served
from tests.contracts.kept_data import KeptData, leave_witnesses
from tests.load.open_loop import Answer, offer, poisson, run
from tests.load.processes import Served
from tests.load.request_mix import Ask
from tests.support.mouth import write_mouth
from tests.support.uploading import announce, contents_of, send

MAX_MEMORY_BYTES = 400e6
MAX_RATIO = 1.5
CAPTURE_SHARE = 0.1
"""Share of the inputs that are captures."""
COSTLY_SHARE = 0.05
"""Share of the captures with a description that takes as much memory to parse as any of the allowed size."""
READS_PER_S = 50.0
STRETCH_S = 4.0
"""Duration of one half of a pair."""
SAMPLE_S = 0.02
SENDERS = 8
"""Number of threads that send the load, in a process of their own."""
RESAMPLES = 500

Row = dict[str, Any]
Recorded = tuple[str, str, dict[str, str | bytes], bytes | str | None]
"""Method, address, headers and body of a request."""


@dataclass
class Memory:
    """Highest resident memory of a server so far, bytes."""

    server: int = 0
    """Of the server's own process."""
    with_readers: int = 0
    """Of the server together with the processes in which it reads uploaded files."""


@contextmanager
def watched(process: psutil.Process) -> Iterator[Memory]:
    """Record the highest resident memory while the block runs."""
    memory, is_over = Memory(), threading.Event()

    def watch() -> None:
        while not is_over.wait(SAMPLE_S):
            with suppress(psutil.Error):
                own = process.memory_info().rss
                readers = [
                    one for one in process.children() if "services.api.captures.reading_process" in one.cmdline()
                ]
                memory.server = max(memory.server, own)
                memory.with_readers = max(memory.with_readers, own + sum(one.memory_info().rss for one in readers))

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield memory
    finally:
        is_over.set()
        thread.join()


def main() -> None:
    """Measure, print and write; the exit status is 0 if all limits were kept."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--inputs", type=int, default=2000)
    parser.add_argument("--pairs", type=int, default=12)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        row = measure(Path(folder), options.inputs, options.pairs, options.seed)
    print(json.dumps(row, indent=1))
    options.json.write_text(json.dumps([row], indent=1) + "\n")
    raise SystemExit(not all(row["holds"].values()))


def measure(folder: Path, inputs: int, pairs: int, seed: int) -> Row:
    """Serve a new data folder in ``folder`` and send the inputs."""
    dice, captures = random.Random(seed), round(CAPTURE_SHARE * inputs)
    with served(folder, None) as (client, process, tokens):
        witnesses = leave_witnesses(client, folder / "data", folder / "capture")
        write_mouth(folder / "mouth", lights=2)
        address, server = str(client.base_url).rstrip("/"), psutil.Process(process.pid)
        sender = Sender(address, tokens, ExistingIds(witnesses, folder / "data", folder / "mouth"))
        recorded: list[Recorded] = []
        sender._session.hooks["response"].append(lambda answer, **_: _record(answer, recorded))
        began = time.monotonic()
        with watched(server) as memory:
            sender.run(inputs - captures, seed, lambda line: print(line, flush=True))
            sender._living.release()
            statuses = [_send_capture(client, folder / "capture", dice, number) for number in range(captures)]
        fuzzed_s = time.monotonic() - began
        _settle(client)
        reads = _reads(witnesses)
        target = Served(address, server, folder / "data", {"Authorization": f"Bearer {tokens[Scope.ADMIN]}"})
        stretches = _pairs(target, reads, recorded, pairs, dice)
        failures = [fault.__dict__ for fault in sender.tally.faults.values()] + [
            {"capture": status} for status in statuses if status not in {200, 409, 422, 413}
        ]
    log = (folder / "server.log").read_text()
    quiet, loaded = ([answer for stretch in kind for answer in stretch] for kind in zip(*stretches, strict=True))
    ratio, interval = _ratio(stretches, dice)
    wrong = sum(not answer.is_right for answer in (*quiet, *loaded))
    return {
        "benchmark": "fuzzed-load",
        "inputs": sender.tally.cases + captures,
        "captures": {str(status): statuses.count(status) for status in sorted(set(statuses))},
        "fuzzed_s": round(fuzzed_s, 1),
        "failures": failures,
        "tracebacks": log.count("Traceback"),
        "server_peak_mb": round(memory.server / 1e6, 1),
        "server_and_readers_peak_mb": round(memory.with_readers / 1e6, 1),
        "reads": len(quiet) + len(loaded),
        "reads_wrong": wrong,
        "p99_quiet_s": round(_p99(quiet), 5),
        "p99_loaded_s": round(_p99(loaded), 5),
        "p99_ratio": round(ratio, 3),
        "p99_ratio_95": [round(limit, 3) for limit in interval],
        "holds": {
            "no failure of the server": not failures and wrong == 0,
            "no traceback": "Traceback" not in log,
            "memory": memory.with_readers <= MAX_MEMORY_BYTES,
            "p99": ratio <= MAX_RATIO,
        },
    }


def _record(answer: requests.Response, recorded: list[Recorded]) -> None:
    asked = answer.request
    makes_job = asked.method == "POST" and "/v1/jobs" in (asked.url or "") and answer.ok
    if not makes_job and "/events" not in (asked.url or "") and isinstance(asked.body, bytes | str | None):
        recorded.append((asked.method or "GET", asked.url or "", dict(asked.headers), asked.body))


def _send_capture(client: httpx.Client, source: Path, dice: random.Random, number: int) -> int:
    """Announce, send and commit a damaged capture; returns the status of the commit, or of an earlier refusal."""
    contents = contents_of(source) | {"extra.toml": f"number = {number}\n".encode()}
    name = dice.choice(["capture.json", "c0_l0.npy"])
    if dice.random() < COSTLY_SHARE:
        name, inner = "capture.json", dice.choice([b"[],", b"{},", b"1,", b'"",'])
        filling = inner * ((MAX_DESCRIPTION_BYTES - 2000) // len(inner))
        contents[name] = contents[name].rstrip()[:-1] + b', "more": [' + filling + b"0]}"
    else:
        contents[name] = _damaged(contents[name], dice)
    try:
        capture = announce(client, contents)
    except AssertionError:
        return 422
    for file in capture["files"]:
        if not file["is_known"]:
            answer = send(client, capture["id"], file["path"], contents[file["path"]])
            if answer.status_code != httpx.codes.NO_CONTENT:
                return answer.status_code
    status = client.post(f"/v1/captures/{capture['id']}/commit").status_code
    client.delete(f"/v1/captures/{capture['id']}")
    return status


def _damaged(content: bytes, dice: random.Random) -> bytes:
    """Replace, delete or repeat some bytes of a file's content."""
    start = dice.randrange(len(content))
    end = min(len(content), start + dice.choice([0, 1, 2, 8, 64]))
    between = dice.choice(
        [
            b"",
            bytes(dice.randrange(256) for _ in range(dice.randrange(1, 9))),
            b"9" * dice.randrange(1, 400),
            content[start:end] * 2,
        ]
    )
    return content[:start] + between + content[end:] or b"{"


def _settle(client: httpx.Client) -> None:
    while client.get("/v1/jobs?state=QUEUED&state=RUNNING&state=CANCELLING").json()["jobs"]:
        time.sleep(0.2)


def _reads(witnesses: KeptData) -> list[Ask]:
    job = f"/v1/jobs/{witnesses.job['id']}"
    paths = (
        "/v1/jobs",
        job,
        f"{job}/logs",
        f"{job}/history",
        f"{job}/artifacts",
        "/v1/captures",
        f"/v1/captures/{witnesses.capture['id']}",
        "/v1/presets",
    )
    return [Ask(path, "GET", path) for path in paths]


def _pairs(
    target: Served, reads: Sequence[Ask], recorded: Sequence[Recorded], pairs: int, dice: random.Random
) -> list[tuple[list[Answer], list[Answer]]]:
    """Measure pairs of a quiet and a loaded period; returns the answers (quiet, loaded) of each pair. Over all loaded
    periods, every recorded request is sent once.
    """
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    load = context.Process(target=_send_load, args=(there, list(recorded)))
    load.start()
    here.recv()
    share, found = -(-len(recorded) // pairs), []
    try:
        for number in range(pairs):
            stretches: dict[bool, list[Answer]] = {}
            for is_loaded in (number % 2 == 0, number % 2 == 1):
                plan = [(due_s, dice.choice(reads)) for due_s in poisson(READS_PER_S, STRETCH_S, dice)]
                if is_loaded:
                    here.send((number * share, share))
                stretches[is_loaded] = run(offer(target, plan))
                if is_loaded:
                    here.recv()
            found.append((stretches[False], stretches[True]))
    finally:
        here.send(None)
        load.join()
    return found


def _send_load(orders: Connection, recorded: list[Recorded]) -> None:
    """For each order (first, count), send these requests evenly over one period; an order of None ends the process."""
    local = threading.local()

    def send_one(one: Recorded) -> None:
        session = local.__dict__.setdefault("session", requests.Session())
        request = requests.PreparedRequest()
        request.method, request.url, request.headers, request.body = one[0], one[1], CaseInsensitiveDict(one[2]), one[3]
        with suppress(requests.RequestException):
            session.send(request, timeout=60)

    with ThreadPoolExecutor(SENDERS) as senders:
        orders.send("ready")
        for first, count in iter(orders.recv, None):
            began = time.monotonic()
            for number, one in enumerate(recorded[first : first + count]):
                time.sleep(max(0.0, began + number * STRETCH_S / count - time.monotonic()))
                senders.submit(send_one, one)
            time.sleep(max(0.0, began + STRETCH_S - time.monotonic()))
            orders.send("done")


def _p99(answers: Sequence[Answer]) -> float:
    return float(np.quantile([answer.latency_s for answer in answers], 0.99))


def _ratio(
    stretches: Sequence[tuple[list[Answer], list[Answer]]], dice: random.Random
) -> tuple[float, tuple[float, float]]:
    """Ratio of the loaded p99 latency to the quiet one, and its 95 % interval by bootstrap over pairs."""

    def ratio(chosen: Sequence[tuple[list[Answer], list[Answer]]]) -> float:
        quiet, loaded = ([answer for stretch in kind for answer in stretch] for kind in zip(*chosen, strict=True))
        return _p99(loaded) / _p99(quiet)

    resampled = [ratio(dice.choices(stretches, k=len(stretches))) for _ in range(RESAMPLES)]
    low, high = np.quantile(resampled, [0.025, 0.975])
    return ratio(stretches), (float(low), float(high))


if __name__ == "__main__":
    main()
