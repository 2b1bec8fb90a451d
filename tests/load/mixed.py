"""200 requests/s, mixed, against one bare route that reads one row; the peers take turns."""

from __future__ import annotations

import asyncio
import json
import random
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import aiohttp
import numpy as np
import psutil

from services.api.auth.tokens import Scope
from tests.load.library import Library, fill
from tests.load.open_loop import Answer, offer, poisson, run, session
from tests.load.processes import Served, serving, serving_bare
from tests.load.request_mix import SUBMIT_PERIOD_S, Ask, RequestMix, periodic
from tests.support.guarded_server import make_token

OURS, GUARDED, BARE = "dentine", "dentine with tokens", "bare"
RATE_PER_S = 200.0
QUANTILES = (0.5, 0.9, 0.99, 0.999)
RESAMPLES = 2000

Row = dict[str, Any]


def measure(work: Path, rounds: int, round_s: float, jobs: int, fitted: int, seed: int) -> Iterator[Row]:
    """Rows of every round and peer, then a summary."""
    library = fill(work / "open", work / "capture", jobs, fitted)
    fill_guarded = fill(work / "guarded", work / "capture", jobs, fitted)
    with ExitStack() as stack:
        token = make_token(work / "guarded", "load", Scope.SUBMIT, Scope.METRICS)
        peers = {
            OURS: (stack.enter_context(serving(work / "open")), library),
            BARE: (stack.enter_context(serving_bare(work / "bare", work / "open" / "dentine.sqlite")), library),
            GUARDED: (stack.enter_context(serving(work / "guarded", token)), fill_guarded),
        }
        for name, (served, books) in peers.items():
            run(_round(name, served, books, min(round_s, 5.0), random.Random(seed), "warm"))
        answers: dict[str, list[list[Answer]]] = {name: [] for name in peers}
        cpu_s = dict.fromkeys(peers, 0.0)
        for number in range(rounds):
            for name, (served, books) in _turns(peers, number):
                before = _Clocks.now(served)
                found = run(_round(name, served, books, round_s, random.Random(f"{seed} {number}"), f"round-{number}"))
                after = _Clocks.now(served)
                answers[name].append(found)
                cpu_s[name] += after.server_s - before.server_s
                yield (
                    {"benchmark": "load-mixed", "peer": name, "round": number}
                    | before.until(after, len(found))
                    | _figures(found)
                )
                run(_drain(served))
    yield from _summary(answers, {name: cpu_s[name] / sum(map(len, rounds)) for name, rounds in answers.items()})
    yield from _kinds(answers)


@dataclass(frozen=True)
class _Clocks:
    """Time that went by, and processor time: the server's, and everybody's but the server's and this program's."""

    wall_s: float
    server_s: float
    others_s: float

    @classmethod
    def now(cls, served: Served) -> Self:
        own, every, server_s = psutil.Process().cpu_times(), psutil.cpu_times(), served.cpu_s()
        busy_s = sum(every) - every.idle - every.iowait - every.guest - every.guest_nice
        return cls(time.perf_counter(), server_s, busy_s - server_s - own.user - own.system)

    def until(self, later: _Clocks, requests: int) -> Row:
        """Of the server by request, and how many cores others kept busy: where those are about as many as there are,
        latencies say little.
        """
        wall_s, server_s = later.wall_s - self.wall_s, later.server_s - self.server_s
        return {
            "cpu_s_per_request": round(server_s / requests, 6),
            "others_cores": round((later.others_s - self.others_s) / wall_s, 2),
        }


def _turns(peers: Mapping[str, Any], number: int) -> list[tuple[str, Any]]:
    # The order changes from round to round, so that nobody always follows the same one.
    turns = list(peers.items())
    return turns[number % len(turns) :] + turns[: number % len(turns)]


async def _round(
    name: str, served: Served, library: Library, seconds: float, rng: random.Random, prefix: str
) -> list[Answer]:
    times = list(poisson(RATE_PER_S, seconds, rng))
    if name == BARE:
        return await offer(
            served, [(due_s, Ask("read", "GET", f"/jobs/{rng.choice(library.jobs)}")) for due_s in times]
        )
    mix = RequestMix(library, rng, prefix)
    plan = [(due_s, mix.draw()) for due_s in times]
    plan += [
        *periodic(seconds),
        *((due_s, mix.submit()) for due_s in np.arange(SUBMIT_PERIOD_S / 2, seconds, SUBMIT_PERIOD_S).tolist()),
    ]
    is_odd = False

    def cancel_every_second(answer: Answer) -> tuple[float, Ask] | None:
        nonlocal is_odd
        if answer.kind != "submit" or answer.status != 201:
            return None
        is_odd = not is_odd
        path = f"/v1/jobs/{json.loads(answer.body)['id']}/cancel"
        return (1.0, Ask("cancel new", "POST", path, statuses=(202, 409))) if is_odd else None

    return await offer(served, sorted(plan, key=lambda one: one[0]), cancel_every_second)


async def _drain(served: Served) -> None:
    """Wait until no job runs, so that the next peer has the machine for itself."""
    async with session(served) as http:
        while await _is_busy(http):
            await asyncio.sleep(0.1)


async def _is_busy(http: aiohttp.ClientSession) -> bool:
    async with http.get("/v1/jobs?state=QUEUED&state=RUNNING&state=CANCELLING") as response:
        return response.status == 200 and bool((await response.json())["jobs"])


def _figures(answers: Sequence[Answer]) -> Row:
    latencies = [answer.latency_s for answer in answers]
    named = {f"p{100 * q:g}_s": round(float(np.quantile(latencies, q)), 6) for q in QUANTILES}
    wrong = sorted({f"{answer.kind}: {answer.status}" for answer in answers if not answer.is_right})
    return (
        {"requests": len(answers), "wrong": sum(not answer.is_right for answer in answers), "wrong_kinds": wrong}
        | named
        | {"max_s": round(max(latencies), 6)}
    )


def _p99(rounds: Sequence[Sequence[Answer]]) -> float:
    return float(np.quantile([answer.latency_s for one in rounds for answer in one], 0.99))


def _summary(answers: Mapping[str, list[list[Answer]]], cpu_s_per_request: Mapping[str, float]) -> Iterator[Row]:
    """p99 over all rounds, its ratio to the bare route's, and that ratio's spread: over rounds, and by resampling them
    together; and the processor's time.
    """
    rng = np.random.default_rng(1)
    bare = answers[BARE]
    draws = rng.integers(0, len(bare), (RESAMPLES, len(bare)))
    by_round = {
        name: [np.array([answer.latency_s for answer in one]) for one in rounds] for name, rounds in answers.items()
    }
    resampled = {
        name: np.array([np.quantile(np.concatenate([rounds[k] for k in draw]), 0.99) for draw in draws])
        for name, rounds in by_round.items()
    }
    for name, rounds in answers.items():
        single = [_p99([ours]) / _p99([theirs]) for ours, theirs in zip(rounds, bare, strict=True)]
        low, high = np.quantile(resampled[name] / resampled[BARE], (0.025, 0.975))
        yield {
            "benchmark": "load-mixed-summary",
            "peer": name,
            **_figures([answer for one in rounds for answer in one]),
            "bare_p99_s": round(_p99(bare), 6),
            "p99_ratio": round(_p99(rounds) / _p99(bare), 3),
            "p99_ratio_95": [round(float(low), 3), round(float(high), 3)],
            "p99_ratio_of_rounds": [round(one, 3) for one in single],
            "p99_ratio_median": round(float(np.median(single)), 3),
            "cpu_s_per_request": round(cpu_s_per_request[name], 6),
            "bare_cpu_s_per_request": round(cpu_s_per_request[BARE], 6),
            "cpu_ratio": round(cpu_s_per_request[name] / cpu_s_per_request[BARE], 3),
        }


def _kinds(answers: Mapping[str, list[list[Answer]]]) -> Iterator[Row]:
    for name, rounds in answers.items():
        by_kind: dict[str, list[Answer]] = {}
        for answer in (answer for one in rounds for answer in one):
            by_kind.setdefault(answer.kind, []).append(answer)
        for kind, found in sorted(by_kind.items()):
            yield {"benchmark": "load-mixed-kind", "peer": name, "kind": kind} | _figures(found)
