"""What every kind of fit needs of its job: the checkpoint's folder, the journal, workers, progress and previews out,
and the records it publishes.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from services.core.job_kinds import SLAB_OPTIONS
from services.core.placement import WEIGHTS
from services.core.records import JobSpec
from services.core.stage import CANCEL_FLAG, StageContext, StageEvent
from services.core.store import StageWriter, write_atomic
from services.core.verdict import MAX_ERROR
from services.fit.checks.evaluate import ErrorSums, Evaluation
from services.fit.execution.channel_fit import ChannelFit, StepReport, history_key, told_place
from services.fit.execution.executors import Executor, executor
from services.fit.execution.journal import Journal
from services.fit.execution.numerics import numerics_name
from services.fit.execution.passes import Passes, TraceRow
from services.fit.execution.seeds import Seeds
from services.fit.export.previews import write_pictures, write_preview
from services.fit.inputs.observations import ChannelFiles, Observations, ViewStack

CHECKPOINT = "fit-checkpoint"
NOT_OF_THE_ANSWER = frozenset({"workers", "capture", "rig", "priority", "store", *SLAB_OPTIONS})
"""Options that the answer of a fit does not depend on; what the capture holds counts by its contents."""
ALWAYS_NAMED = frozenset(
    [
        "kind",
        "calibration",
        "boundary",
        "ior",
        "dentin",
        "held",
        "loss",
        "solver",
        "adam_steps",
        "adam_rate",
        "prior",
        "stains",
        "lobes",
        "held_out_lights",
        "channels",
        "seed",
        "pixel_step",
        "samples_per_pixel",
        "max_samples_per_pixel",
        "max_steps",
        "search_candidates",
        "advise",
        "sensor_noise_relative",
        "sensor_noise_floor",
        "device",
    ]
)
"""Options of version 0.1, whose checkpoints name them all. A later one is named where it is not at its default, and so
is to be added nowhere here: fits that were begun before there was such an option go on."""
PREVIEW_EVERY = 3
"""A preview after the first step and after every so many."""

Views = Mapping[str, tuple[ViewStack, ...]]
"""By channel."""


@dataclass
class Attempt:
    """One attempt at a job's fit."""

    spec: JobSpec
    context: StageContext
    writer: StageWriter
    engine: str
    trace: list[TraceRow] = field(default_factory=list)

    @property
    def inputs(self) -> Path:
        """Where the fit's tasks find their files."""
        return self.context.root / CHECKPOINT / "inputs"

    def log(self, message: str) -> None:
        """One sentence for whoever watches."""
        self.context.report(StageEvent(stage="fit", kind="log", message=message))

    def journal(self, files: Iterable[ChannelFiles]) -> Journal:
        """The journal of a fit of these inputs, continued where an earlier attempt stopped."""
        folder = self.context.root / CHECKPOINT
        folder.mkdir(parents=True, exist_ok=True)
        journal = Journal(
            folder / "journal.jsonl", fingerprint(self.spec, self.engine, files), self.writer.require_lease
        )
        if journal.set_aside is not None:
            self.log(
                f"The checkpoint is damaged or of another job, data or numerics: it is kept as {journal.set_aside.name}"
                " and this fit starts anew."
            )
        if journal.resumed:
            self.log(f"Attempt {self.context.attempt} continues after {journal.resumed} recorded results.")
        return journal

    @contextmanager
    def workers(self) -> Iterator[Executor]:
        """Where tasks run, under keys of this attempt's own."""
        place = self.context.root / CHECKPOINT
        prefix = hashlib.sha256(f"{place / 'journal.json'}/{self.context.attempt}/{os.getpid()}".encode()).hexdigest()[
            :12
        ]
        with executor(self.context.root / CANCEL_FLAG, self.engine, prefix, WEIGHTS[self.spec.priority]) as run_on:
            yield run_on

    def passes(self, run_on: Executor, files: ChannelFiles, scope: str) -> Passes:
        """The passes of one fit; ``scope`` sets its seeds and keys apart from those of others."""
        return Passes(run_on, files.coarse.blocks, files.recipe, Seeds(self.spec.seed, scope), self.trace.extend)

    def teller(
        self, observations: Observations, views: tuple[ViewStack, ...], journal: Journal, done: Callable[[int], float]
    ) -> Callable[[StepReport, Evaluation], None]:
        """What reports the steps of one channel.

        Args:
            done: fraction of the job that is done after so many steps of this channel.
        """

        def tell(step: StepReport, evaluation: Evaluation) -> None:
            data = asdict(step)
            place = told_place(step.channel, step.tooth)
            message = f"{place} {step.stage} step {step.stage_step}: loss {step.loss:.3e}, {step.verdict}."
            journal.once(history_key(step.channel, step.step), lambda: data)
            self.context.report(StageEvent(stage="fit", kind="step", message=message, done=done(step.step), data=data))
            if step.step % PREVIEW_EVERY == 1 and step.tooth is None:
                for preview in write_preview(self.context.root, step, evaluation, observations.manifest, views):
                    self.context.report(StageEvent(stage="fit", kind="preview", data=preview))

        return tell

    def write_records(
        self, journal: Journal, observations: Observations, evaluations: Mapping[str, Evaluation], views: Views
    ) -> None:
        """Write history, trace and pictures into the stage's folder."""
        folder = self.writer.folder
        history = [value for key, value in journal.entries.items() if "/history/" in key]
        write_atomic(folder / "history.json", _json(history))
        write_atomic(folder / "trace.json", _json([asdict(row) for row in self.trace]))
        write_pictures(folder, evaluations, observations.manifest, views)


def worst_error(fit: ChannelFit[Any]) -> float:
    """Relative image error on fitted or on held-out images, whichever is larger."""
    return max(fit.fit_error, fit.held_out_error or 0.0)


def standard_errors(sums: Mapping[str, ErrorSums]) -> dict[str, float]:
    """By channel, what the renders leave open of an image error; absent where there was nothing to compare with."""
    return {channel: se for channel, own in sums.items() if (se := own.error_se) is not None}


def judge(fits: Mapping[str, ChannelFit[Any]]) -> tuple[bool, list[str]]:
    """Whether a fit of these channels counts as converged, and what to do about it."""
    advice = [f"{c}: {fit.solution.advice}" for c, fit in fits.items() if fit.solution.advice]
    off = {c: worst_error(fit) for c, fit in fits.items()}
    unexplained = [c for c, error in off.items() if error > MAX_ERROR]
    advice += [
        f"{c}: the images are still {100 * off[c]:.0f} % off; check mesh, lights and boundary model, or raise the"
        " samples."
        for c in unexplained
    ]
    return not unexplained and all(fit.solution.result.converged for fit in fits.values()), advice


def fingerprint(spec: JobSpec, engine: str, files: Iterable[ChannelFiles]) -> str:
    """Identifies everything a fit's answer depends on; a journal of another fit is not continued."""
    asked = (ALWAYS_NAMED | spec.changed_options) - NOT_OF_THE_ANSWER
    parts = [numerics_name(), engine, spec.model_dump_json(include=set(asked))]
    for channel in files:
        parts += [
            channel.channel,
            *(f.digest for f in (channel.recipe, channel.evaluation_recipe, *channel.blocks, *channel.search_blocks)),
            *channel.errors.names,
            *(json.dumps(row) for row in channel.errors.covariance),
            *(f"{move.recipe.digest} {move.first} {move.camera_move} {move.body}" for move in channel.moves),
        ]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _json(value: object) -> bytes:
    return (json.dumps(value, indent=1) + "\n").encode()
