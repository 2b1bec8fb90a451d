"""Processor time of a request by kind, without a network: the application is called in this process.

python -m tests.benchmarks.request_cost --json cost.json [--requests 2000] [--tokens] [--only KIND]

The ratios to a bare route also hold on a busy machine, because requests to both take turns.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
import random
import tempfile
import time
from collections.abc import Callable
from itertools import count, islice
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from services.api.app import create_app
from services.api.auth.tokens import Scope
from services.core.settings import ServerSettings
from services.pipeline.logs import configure_logs
from tests.load.bare_server import build
from tests.load.library import fill
from tests.load.request_mix import Ask, RequestMix
from tests.support.guarded_server import make_token

Row = dict[str, Any]
App = Callable[..., Any]
Asked = tuple[App, list[Ask], dict[str, str]]
ADDRESS = ("127.0.0.1", 8000)
WARM = 200


def main() -> None:
    """Read the options, measure, print and write one row per kind."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the rows here")
    parser.add_argument("--requests", type=int, default=2000, help="of the mix")
    parser.add_argument("--tokens", action="store_true", help="ask every caller for a token")
    parser.add_argument("--only", help="ask for this kind alone")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as work:
        rows = asyncio.run(_measure(Path(work), options))
    for row in rows:
        print(json.dumps(row))
    if options.json is not None:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")


async def _measure(work: Path, options: argparse.Namespace) -> list[Row]:
    library = fill(work, work / "capture", jobs=1000, fitted=10)
    headers = {"Authorization": f"Bearer {make_token(work, 'cost', Scope.SUBMIT)}"} if options.tokens else {}
    settings = ServerSettings(data=work, access="tokens" if options.tokens else "open", job_roots="/")
    mix = RequestMix(library, random.Random(options.seed), "cost")
    drawn = (mix.draw() for _ in count())
    asks = list(islice((ask for ask in drawn if options.only in {None, ask.kind}), options.requests))
    bare = build(str(settings.database_url).removeprefix("sqlite:///"))
    reads = [
        Ask("read", "GET", f"/jobs/{random.Random(number).choice(library.jobs)}") for number in range(options.requests)
    ]
    app = create_app(settings, lambda *_: None)
    stream = (work / "log.jsonl").open("w")
    configure_logs(stream)
    logging.getLogger("services.api.jobs.runner").setLevel(logging.CRITICAL)
    async with app.router.lifespan_context(app):
        took_s = await _cost((bare, reads, {}), (app, asks, headers))
    stream.close()
    by_kind = {
        kind: [(ours, theirs) for this, theirs, ours in took_s if this == kind]
        for kind in sorted({kind for kind, _, _ in took_s})
    }
    every = [(ours, theirs) for _, theirs, ours in took_s]
    return [
        _row("bare", "read", [(s, s) for _, s, _ in took_s]),
        *(_row("dentine", kind, found) for kind, found in by_kind.items()),
        _row("dentine", "mix", every),
    ]


def _row(peer: str, kind: str, took_s: list[tuple[float, float]]) -> Row:
    """Mean processor time, and its ratio to that of the bare route's requests sent in turn with them."""
    own_s, bare_s = (sum(one) for one in zip(*took_s, strict=True))
    figures = {"cpu_ms": round(1e3 * own_s / len(took_s), 3), "ratio": round(own_s / bare_s, 2)}
    return {"benchmark": "request-cost", "peer": peer, "kind": kind, "requests": len(took_s)} | figures


async def _cost(bare: Asked, ours: Asked) -> list[tuple[str, float, float]]:
    """For each request: its kind, the processor seconds of a request to the bare route, and its own. The two take
    turns, so that both run on the machine in the same state.
    """
    took_s = []
    pairs = list(zip(bare[1], ours[1], strict=True))
    for number, (read, ask) in enumerate([*pairs[:WARM], *pairs]):
        times_s = [time.process_time()]
        for app, one, headers in ((bare[0], read, bare[2]), (ours[0], ask, ours[2])):
            status = await _send(app, one, headers)
            times_s.append(time.process_time())
            assert status in one.statuses, (one, status)
        if number >= WARM:
            took_s.append((ask.kind, times_s[1] - times_s[0], times_s[2] - times_s[1]))
    return took_s


async def _send(app: App, ask: Ask, headers: dict[str, str]) -> int:
    url, body = urlsplit(ask.path), b"" if ask.body is None else json.dumps(ask.body).encode()
    sent = (
        {"Host": "127.0.0.1:8000", "Accept": "*/*", "Accept-Encoding": "gzip, deflate", "User-Agent": "cost"}
        | headers
        | ask.headers
    )
    if body:
        sent |= {"Content-Type": "application/json", "Content-Length": str(len(body))}
    scope = {
        "type": "http",
        "asgi": {"version": "3.0", "spec_version": "2.3"},
        "http_version": "1.1",
        "scheme": "http",
        "server": ADDRESS,
        "client": (ADDRESS[0], 5),
        "root_path": "",
        "method": ask.method,
        "path": url.path,
        "raw_path": url.path.encode(),
        "query_string": url.query.encode(),
        "headers": [(name.lower().encode(), value.encode()) for name, value in sent.items()],
        "state": {},
    }
    status, is_sent = 0, False

    async def receive() -> Row:
        nonlocal is_sent
        if is_sent:
            await asyncio.sleep(3600)
        is_sent = True
        return {"type": "http.request", "body": body, "more_body": False}

    async def send(message: Row) -> None:
        nonlocal status
        status = message.get("status", status)

    await app(scope, receive, send)
    return status


if __name__ == "__main__":
    main()
