"""A job without stages that leaves the same traces as a fit: log lines, steps, previews and files."""

from __future__ import annotations

from pathlib import Path

from services.core.records import JobSpec
from services.core.stage import StageEvent
from services.pipeline.event_log import EventAddress, EventLog

PICTURE = bytes(range(64))
STEPS = 20


def tell(_spec: JobSpec, folder: Path, events: EventAddress) -> None:
    """Write the events of two attempts of a fit; the second attempt repeats the first one's last step."""
    (folder / "previews").mkdir(parents=True)
    with events.open() as log:
        prepare = log.begin_stage("prepare")
        log.append(prepare, StageEvent(stage="prepare", kind="log", message="Camera c1 is dark."))
        log.append(prepare, StageEvent(stage="prepare", kind="finished", done=1.0))
        for first, last in ((1, STEPS // 2), (STEPS // 2, STEPS)):
            attempt = log.begin_stage("fit")
            log.append(
                attempt, StageEvent(stage="fit", kind="log", message=f"Attempt {attempt} goes on at step {first}.")
            )
            for step in range(first, last + 1):
                _step(log, attempt, step, folder)


def _step(log: EventLog, attempt: int, step: int, folder: Path) -> None:
    data: dict[str, object] = {
        "channel": "green",
        "step": step,
        "loss": 0.5**step * attempt,
        "held_out_error": 0.6**step,
        "parameters": {"enamel.sigma": 4.0},
    }
    log.append(attempt, StageEvent(stage="fit", kind="step", message=f"Step {step}.", data=data))
    if step % 10 == 1:
        preview: dict[str, object] = {
            "camera": "c0",
            "light": "l1",
            "held_out": step > 10,
            "channel": "green",
            "step": step,
        }
        for kind in ("render", "photo", "residual"):
            path = f"previews/green-{step:03d}-c0-l1-{kind}.png"
            (folder / path).write_bytes(kind.encode() + PICTURE)
            preview[kind] = path
        log.append(attempt, StageEvent(stage="fit", kind="preview", data=preview))
