"""A job that reports the same events as a fit, one step whenever a test releases it, and so looks like a fit to the
page.
"""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import Page

from services.core.errors import DentineError
from services.core.records import JobSpec
from services.core.results import Estimate, Verdict
from services.core.stage import StageEvent
from services.core.verdict import VERDICT
from services.pipeline.event_log import EventAddress

STEPS = 6


class ScriptedJob:
    """A job that runs one step whenever a test releases the semaphore ``steps``; it fails with ``problem`` if one is
    set then.
    """

    def __init__(self) -> None:
        self.steps = threading.Semaphore(0)
        self.problem: DentineError | None = None
        self.verdict: Verdict | None = None

    def __call__(self, _spec: JobSpec, folder: Path, events: EventAddress) -> None:
        with events.open() as log:
            prepare = log.begin_stage("prepare")
            log.append(prepare, StageEvent(stage="prepare", kind="finished", done=1.0, message="24 images prepared."))
            fit = log.begin_stage("fit")
            for step in range(STEPS):
                self.steps.acquire()
                if self.problem is not None:
                    raise self.problem
                self._report(log, fit, step, folder)
            data = {} if self.verdict is None else {VERDICT: self.verdict.model_dump(mode="json")}
            message = "Converged after 6 steps." if self.verdict is None else self.verdict.headline
            log.append(fit, StageEvent(stage="fit", kind="finished", done=1.0, message=message, data=data))
            export = log.begin_stage("export")
            table = {
                "enamel.sigma": Estimate(
                    value=4.0321,
                    se=0.0512,
                    unit="1/mm",
                    determined=True,
                    se_parts={"gain": 0.04, "photographs": 0.0316, "rendering": 0.004},
                ),
                "dentin.g1": Estimate(value=0.41, se=0.9, unit="1", determined=False),
            }
            (folder / "parameters.json").write_text(
                "{" + ",".join(f'"{c}": {{{_json(table)}}}' for c in ("green", "red")) + "}"
            )
            (folder / "report.html").write_text("<!doctype html><title>report</title>")
            log.append(export, StageEvent(stage="export", kind="finished", done=1.0))

    def _report(self, log: Any, attempt: int, step: int, folder: Path) -> None:
        for channel, factor in (("green", 1.0), ("red", 2.0)):
            data = {
                "channel": channel,
                "step": step,
                "loss": factor * 0.3**step,
                "held_out_error": factor * 0.4 * 0.5**step if step % 2 else None,
                "held_out_se": 0.012 if step % 2 else None,
                "parameters": {"enamel.sigma": 4.0 + 0.01 * step},
            }
            log.append(
                attempt,
                StageEvent(
                    stage="fit", kind="step", message=f"{channel} step {step}.", done=(step + 1) / STEPS, data=data
                ),
            )
        paths = {kind: f"previews/{step}-{kind}.png" for kind in ("render", "photo", "residual")}
        (folder / "previews").mkdir(exist_ok=True)
        for kind, path in paths.items():
            _write_picture(folder / path, kind, step)
        data = {"camera": "c0", "light": "l3", "channel": "green", "step": step, "residual_of_white": 0.25, **paths}
        log.append(attempt, StageEvent(stage="fit", kind="preview", data=data))


def _json(table: dict[str, Estimate]) -> str:
    return ",".join(f'"{name}": {estimate.model_dump_json()}' for name, estimate in table.items())


def _write_picture(path: Path, kind: str, step: int) -> None:
    from PIL import Image

    y, x = np.mgrid[-1:1:60j, -1:1:48j]
    ball = np.sqrt(np.clip(1 - x**2 - y**2, 0, 1))
    grey = {"photo": ball, "render": ball ** (1 + 1 / (1 + step)), "residual": 0.5 + 0.1 * ball / (1 + step)}[kind]
    Image.fromarray((255 * grey).astype(np.uint8)).save(path)


def submit(page: Page, capture: str = "/") -> str:
    answer = page.request.post("/v1/jobs", data={"capture": capture})
    assert answer.status == 201
    return str(answer.json()["id"])


def expect_state(page: Page, job_id: str, state: str) -> None:
    while page.request.get(f"/v1/jobs/{job_id}").json()["state"] != state:
        time.sleep(0.05)
