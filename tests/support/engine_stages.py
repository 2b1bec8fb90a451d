"""A fit that makes one engine call on the worker's rendering process, or none, as a file in the capture says. It then
publishes the same record as the fit of ``toy_stages``.
"""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

from services.core.files.content_files import StoredFile
from services.core.records import JobSpec
from services.core.results import AssetManifest, CaptureManifest
from services.core.stage import CANCEL_FLAG, StageContext
from services.core.store import read_record
from services.tasks.engine_host import EngineHost
from services.tasks.executors import executor
from services.transport.engine import Engine
from services.transport.optics.parameters import Medium, Tissue
from services.transport.scene.recipe import SceneRecipe
from services.transport.scene.recipe_files import write_recipe
from tests.support import toy_stages
from tests.support.small_tooth import camera_at, recipe, whole_view

capture, prepare, export = toy_stages.capture, toy_stages.prepare, toy_stages.export
BROKEN = "tests.support.broken_engine:BrokenEngine"
REAL = "tests.support.engine_stages:LongEngine"
TISSUE = Tissue(Medium(1.5, 0.95, 0.8, 0.6, -0.3), Medium(4.0, 0.85, 1.0, 0.5), (0.5, 0.4))
MIB = 2**20


class LongEngine(Engine):
    """The real engine with a call that renders an image for hours."""

    def __init__(self, scene: SceneRecipe, threads: int | None = None) -> None:
        super().__init__(scene, threads)

    def render(self, started: str) -> None:
        """Compile the kernel with 16 paths per pixel, write the process id to ``started``, then trace 2²⁶ per pixel."""
        view = whole_view(camera_at((0.2, 1, 0.1), size=64))
        self.images(TISSUE, view, seed=1, samples=16)
        Path(started).write_text(str(os.getpid()))
        self.images(TISSUE, view, seed=1, samples=2**26)


def fit(spec: JobSpec, context: StageContext) -> AssetManifest:
    """Make the engine call that the capture's file ``call`` names."""
    assert spec.capture is not None
    call = (spec.capture / "call").read_text()
    if call == "none":
        return toy_stages.fit(spec, context)
    if call == "read":
        read_record(spec.capture / "capture.json", CaptureManifest)
    if call == "lose":
        os.kill(os.getpid(), signal.SIGKILL)
    (spec.capture / "worker.pid").write_text(str(os.getpid()))
    method, *arguments = {
        "grow": ("grow", 8 * MIB),
        "crash": ("die", int(signal.SIGSEGV)),
        "render": ("render", str(spec.capture / "started")),
    }.get(call, ("answer", 1))
    prefix = (  # Every fit has its own prefix, because Dask answers a key that it still knows with the old result.
        f"{context.root.name}-{context.attempt}"
    )
    with executor(context.root / CANCEL_FLAG, REAL if call == "render" else BROKEN, prefix) as run_on:
        run_on.gather([run_on.submit(call, ask, write_recipe(context.root, recipe()), method, *arguments)])
    return toy_stages.fit(spec, context)


def ask(host: EngineHost, scene: StoredFile, method: str, *arguments: Any) -> None:
    """Call a method of the engine, as a task of a fit does."""
    host.call(method, scene, *arguments)
