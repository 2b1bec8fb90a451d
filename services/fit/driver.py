"""Runs a fit: inputs to files, channels through their schedule, progress and previews out, one report at the end."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from services.core.geometry import Camera, Tooth
from services.core.records import FitReport, JobSpec
from services.core.stage import StageContext, StageEvent
from services.core.store import StageWriter, write_atomic
from services.fit.evaluate import Evaluation
from services.fit.executors import Executor, executor
from services.fit.identifiability import NOTHING, correlation, told
from services.fit.journal import Journal
from services.fit.observations import ChannelFiles, Observations, ViewStack, read_channel, read_observations, write_channel
from services.fit.passes import Passes, TraceRow
from services.fit.pictures import shown_images, write_pictures, write_preview
from services.fit.schedule import ChannelFit, ChannelSchedule, StepReport
from services.fit.seeds import Seeds
from services.fit.solve.covariance import Uncertainty, estimates
from services.fit.transport.recipe import DentinShape

CHECKPOINT = "fit-checkpoint"
UNEXPLAINED = 0.15
"""Relative error on the fitted or on the held-out images above which a fit is not called converged, however its solver ended."""
PREVIEW_EVERY = 3
"""A preview after the first step and after every so many."""


@dataclass
class FitDriver:
    """One attempt at a fit."""

    spec: JobSpec
    context: StageContext
    writer: StageWriter
    engine: str
    trace: list[TraceRow] = field(default_factory=list)

    def run(self, started_s: float) -> FitReport:
        """Fit all channels; files land in the writer's folder, the report is returned."""
        spec, folder = self.spec, self.context.root / CHECKPOINT
        folder.mkdir(parents=True, exist_ok=True)
        observations = read_observations(self.context.root, spec)
        dentin = dentin_shape(observations.tooth, observations.manifest.cameras, spec)
        channels = spec.channels or observations.manifest.channels
        views = {channel: read_channel(observations, channel, spec) for channel in channels}
        files = {channel: write_channel(folder / "inputs", observations, channel, views[channel], dentin, spec) for channel in channels}
        journal = Journal(folder / "journal.json", fingerprint(spec, self.engine, files.values()), self.writer.require_lease)
        if journal.resumed:
            self.context.report(
                StageEvent(stage="fit", kind="log", message=f"Attempt {self.context.attempt} continues after {journal.resumed} recorded results.")
            )
        begun, _ = journal.once("begun", lambda: started_s)

        # The channel with the most signal goes first; where blend weights are fitted, the others take them from it.
        modes = len(dentin.modes_mm) if dentin is not None else 0
        order = sorted(channels, key=lambda c: -files[c].quality)
        fits: dict[str, ChannelFit] = {}
        shape, next_capture = tuple[float, ...](), ""
        prefix = hashlib.sha256(f"{journal.path}/{self.context.attempt}/{os.getpid()}".encode()).hexdigest()[:12]
        with executor(self.engine, prefix) as run_on:
            for number, channel in enumerate(order):
                self.context.report(StageEvent(stage="fit", kind="log", message=f"{channel}: renderers start, then the table is searched."))
                schedule = self._schedule(observations, files[channel], views[channel], journal, run_on, (number, len(order)))
                schedule.has_dentin, schedule.modes, schedule.shape = dentin is not None, 0 if shape else modes, shape
                fits[channel] = schedule.run()
                shape = fits[channel].tissue.shape
                if spec.advise and number == 0 and fits[channel].solution.result.converged:
                    next_capture = schedule.next_capture(fits[channel], folder / "inputs")
        report = self._publish(observations, {c: fits[c] for c in channels}, order[0], views, journal, time.time() - begun)
        where = f"In {order[0]}: " if next_capture and len(order) > 1 else ""
        return report.model_copy(update={"next_capture": where + next_capture})

    def _schedule(
        self, observations: Observations, files: ChannelFiles, views: tuple[ViewStack, ...], journal: Journal, run_on: Executor, place: tuple[int, int]
    ) -> ChannelSchedule:
        seeds = Seeds(self.spec.seed, files.channel)
        passes = Passes(run_on, files.blocks, files.recipe, seeds, self.trace.extend)

        def tell(step: StepReport, evaluation: Evaluation) -> None:
            expected = self.spec.max_steps + 10
            done = (place[0] + min(step.step / expected, 0.99)) / place[1]
            data = asdict(step)
            message = f"{step.channel} {step.stage} step {step.stage_step}: loss {step.loss:.3e}, {step.verdict}."
            self.context.report(StageEvent(stage="fit", kind="step", message=message, done=done, data=data))
            key = f"{files.channel}/history/{step.step}"
            journal.once(key, lambda: data)
            if step.step % PREVIEW_EVERY == 1:
                for preview in write_preview(self.context.root, step, evaluation, observations.manifest, views):
                    self.context.report(StageEvent(stage="fit", kind="preview", data=preview))

        return ChannelSchedule(
            files, passes, self.spec, journal, has_dentin=True, modes=0, report=tell, pause=self.context.raise_if_cancelled,
            shown=shown_images(views),
        )  # fmt: skip

    def _publish(
        self,
        observations: Observations,
        fits: dict[str, ChannelFit],
        first: str,
        views: dict[str, tuple[ViewStack, ...]],
        journal: Journal,
        seconds: float,
    ) -> FitReport:
        folder = self.writer.folder
        history = [value for key, value in journal.entries.items() if "/history/" in key]
        write_atomic(folder / "history.json", _json(history))
        write_atomic(folder / "trace.json", _json([asdict(row) for row in self.trace]))
        write_pictures(folder, {c: fit.evaluation for c, fit in fits.items()}, observations.manifest, views)

        known = {c: fit.known for c, fit in fits.items()}
        tables = {c: self._table(fit, known[c], known[first]) for c, fit in fits.items()}
        advice = [f"{c}: {fit.solution.advice}" for c, fit in fits.items() if fit.solution.advice]
        off = {c: max(fit.fit_error, fit.held_out_error or 0.0) for c, fit in fits.items()}
        unexplained = [c for c, error in off.items() if error > UNEXPLAINED]
        advice += [f"{c}: the images are still {100 * off[c]:.0f} % off; check mesh, lights and boundary model, or raise the samples." for c in unexplained]
        converged = not unexplained and all(fit.solution.result.converged for fit in fits.values())
        correlations = {c: correlation(known[c]) for c in fits}
        return FitReport(
            converged=converged,
            advice=" ".join(advice),
            parameters=tables,
            fit_error={c: fit.fit_error for c, fit in fits.items()},
            held_out_error={c: fit.held_out_error for c, fit in fits.items() if fit.held_out_error is not None},
            steps=sum(fit.steps for fit in fits.values()),
            shape=fits[first].tissue.shape,
            correlations=correlations,
            told=told(tables, correlations) if converged else NOTHING,
            seconds=seconds,
        )

    def _table(self, fit: ChannelFit, known: Uncertainty, shape_known: Uncertainty) -> dict[str, Any]:
        parts = ("enamel",) if self.spec.dentin == "none" else ("enamel", "dentin")
        fitted_shape = shape_known if any(name.startswith("shape.") for name in shape_known.domain.parameters) else None
        return estimates(fit.tissue, parts, known, fitted_shape)


def dentin_shape(tooth: Tooth, cameras: tuple[Camera, ...], spec: JobSpec) -> DentinShape | None:
    """The dentin surface the job asks for: the given one, a blend shape made from the enamel, or none.

    The blend modes' axes follow from the mesh and from where the cameras stand.
    """
    if spec.dentin == "known":
        assert tooth.dentin is not None
        return DentinShape(tooth.dentin, np.zeros((0, len(tooth.dentin.vertices_mm), 3)))
    if spec.dentin == "fit":
        from services.fit.anatomy.blend import dentin_blend_shape
        from services.fit.anatomy.frame import estimate_frame

        centres_mm = np.array([camera.rays(np.zeros(1), np.zeros(1))[0] for camera in cameras])
        return dentin_blend_shape(tooth.outer, estimate_frame(tooth.outer, centres_mm))
    return None


def fingerprint(spec: JobSpec, engine: str, files: Sequence[ChannelFiles] | Any) -> str:
    """Identifies everything a fit's answer depends on; a journal of another fit is not continued."""
    parts = [engine, spec.model_dump_json(exclude={"workers", "capture", "rig"})]
    for channel in files:
        parts += [channel.channel, *(f.digest for f in (channel.recipe, channel.evaluation_recipe, *channel.blocks, *channel.search_blocks))]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _json(value: object) -> bytes:
    return (json.dumps(value, indent=1) + "\n").encode()
