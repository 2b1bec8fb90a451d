"""Time from a cancel in the middle of a kernel until the worker is free, and a check that the worker is the same
process afterwards.

python -m tests.benchmarks.cancel_in_kernel --times 10

A job of a live server renders with the real engine an image that would take hours. It is cancelled over REST while the
kernel runs, and the next job runs on the same worker. The time is measured from the request to the state CANCELLED,
which a job reaches when the rendering process is dead and its worker is free.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import psutil

from tests.support.engine_server import engine_server

POLL_S = 0.1
ENDED = {"SUCCEEDED", "FAILED", "CANCELLED"}


@dataclass(frozen=True)
class Cancelled:
    """One cancel."""

    seconds: float
    worker: int
    """Id of the worker process, whose task waited for the rendering process."""


def cancel_once(client: httpx.Client, capture: Path) -> Cancelled:
    """Cancel a job while its kernel runs.

    Raises:
        RuntimeError: the job ended in another state, or the rendering process still runs.
    """
    job = submit(client, capture, "render")
    started = capture / "started"
    while not started.exists() or not started.read_text():
        if (told := client.get(f"/v1/jobs/{job}").json())["state"] in ENDED:
            raise RuntimeError(f"Job {job} ended before its kernel ran: {told['failure']}")
        time.sleep(POLL_S)
    renderer = psutil.Process(int(started.read_text()))
    _await_work(renderer)
    began = time.monotonic()
    client.post(f"/v1/jobs/{job}/cancel").raise_for_status()
    state = await_end(client, job)["state"]
    seconds = time.monotonic() - began
    if state != "CANCELLED" or renderer.is_running():
        raise RuntimeError(
            f"Job {job} ended {state}, and its rendering process {'lives' if renderer.is_running() else 'is gone'}."
        )
    return Cancelled(seconds, int((capture / "worker.pid").read_text()))


def worker_of_next(client: httpx.Client, capture: Path) -> int:
    """Run another job; returns the id of the process in which its fit ran."""
    told = await_end(client, submit(client, capture, "answer"))
    if told["state"] != "SUCCEEDED":
        raise RuntimeError(f"The next job ended {told['state']}: {told['failure']}")
    return int((capture / "worker.pid").read_text())


def submit(client: httpx.Client, capture: Path, call: str) -> str:
    """Submit a job whose fit makes one call; returns its id."""
    capture.mkdir(parents=True, exist_ok=True)
    (capture / "call").write_text(call)
    return str(client.post("/v1/jobs", json={"workers": 1, "capture": str(capture)}).raise_for_status().json()["id"])


def await_end(client: httpx.Client, job: str) -> dict[str, Any]:
    """Wait for a job's end; returns the API's record of it."""
    client.get(f"/v1/jobs/{job}/events")  # the stream ends with the job
    return dict(client.get(f"/v1/jobs/{job}").json())


def _await_work(process: psutil.Process) -> None:
    # Processor time of a quarter of a second after the compilation shows that the kernel runs.
    before = sum(process.cpu_times()[:2])
    while sum(process.cpu_times()[:2]) < before + 0.25:
        time.sleep(POLL_S)


def main() -> None:
    """Cancel ``--times`` jobs and print the shortest and the longest time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=10)
    times = parser.parse_args().times
    with tempfile.TemporaryDirectory() as folder, engine_server(Path(folder) / "data") as (client, _):
        first = worker_of_next(client, Path(folder) / "first")
        seconds, workers = [], {first}
        for number in range(times):
            cancelled = cancel_once(client, Path(folder) / f"cancelled-{number}")
            after = worker_of_next(client, Path(folder) / f"after-{number}")
            seconds.append(cancelled.seconds)
            workers |= {cancelled.worker, after}
            print(
                f"cancel {number + 1}: {cancelled.seconds:.2f} s, worker {cancelled.worker}, next job on {after}",
                flush=True,
            )
    print(f"{times} cancels in mid-kernel: {min(seconds):.2f} to {max(seconds):.2f} s; {len(workers)} worker process.")


if __name__ == "__main__":
    main()
