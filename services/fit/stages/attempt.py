"""One attempt at a job's fit, whatever its kind: checkpoint folder, journal, workers, progress reports, previews and
published records.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

from services.core.job_kinds import SLAB_OPTIONS
from services.core.pages.pictures import PICTURES, store_pictures
from services.core.placement import WEIGHTS
from services.core.records import JobSpec
from services.core.stage import CANCEL_FLAG, StageContext, StageEvent
from services.core.store import StageWriter, write_atomic
from services.core.verdict import MAX_ERROR
from services.fit.measurements.observations import ChannelFiles, Observations
from services.fit.measurements.view_stack import ViewStack
from services.fit.passes.evaluate import ErrorSums, Evaluation
from services.fit.passes.passes import Passes, TraceRow
from services.fit.stages.channel_fit import ChannelFit
from services.fit.stages.previews import pictures_of, write_preview
from services.fit.stages.step_report import StepReport, history_key, message_prefix
from services.tasks.engine_host import ENGINE
from services.tasks.executors import Executor, executor
from services.tasks.journal import Journal
from services.tasks.seeds import Seeds
from services.transport.numerics import numerics_name

CHECKPOINT = "fit-checkpoint"
"""Folder, in the job's folder, of the journal and of the input files of the fit's tasks."""
RESULT_NEUTRAL_OPTIONS = frozenset({"workers", "capture", "rig", "priority", "store", *SLAB_OPTIONS})
"""Options that do not change a fit's result; the capture's content enters the fingerprint by the digests of
its files."""
FIRST_VERSION_OPTIONS = frozenset(
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
"""Options of version 0.1, which its checkpoints always name. A later option is named only where it differs from its
default, so it must not be added here: fits that were begun before the option existed then continue."""
ENGINE_IN_FINGERPRINTS = "services.fit.transport.engine:Engine"
"""Name of the default engine in a checkpoint's fingerprint: the one under which it was stored first, so that fits which
were begun then continue."""
DOUBTFUL_ERROR = 0.05
"""Held-out error above which a converged fit is reported as doubtful. Fits of three virtual mouths with 3.1 to 4.3 %
were at most 3.1 standard errors off, and three with 6.6 to 6.8 % between 6 and 11."""
NOISE_Z = 2.0
"""Standard errors by the renders' noise by which an error has to exceed its limit to be one of the model or the
photographs."""
STEPS_PER_PREVIEW = 3
"""Number of steps between two previews; the first follows the first step."""

PURPOSES: Mapping[str, str] = MappingProxyType(
    {
        "orders": "table search",
        "image": "images",
        "jacobian": "derivatives",
        "gradient": "derivatives",
        "products": "derivatives",
        "compare": "comparison of steps",
        "stain": "stains",
        "weights": "weights of the loss",
        "evaluate": "evaluation",
        "closing": "final uncertainty",
        "moves": "moves of scan and dome",
        "displacements": "displacements of the dentin",
        "advice": "advice on the next capture",
    }
)
"""Purpose of a task, as the report names it, by the kind of its trace row."""

Views = Mapping[str, tuple[ViewStack, ...]]
"""Observed views by channel."""


@dataclass
class Attempt:
    """One attempt at a job's fit."""

    spec: JobSpec
    context: StageContext
    writer: StageWriter
    engine: str
    trace: list[TraceRow] = field(default_factory=list)
    names: Callable[[Mapping[str, float]], dict[str, float]] = dict
    """Gives a table by parameters the names under which it is told."""

    @property
    def inputs(self) -> Path:
        """Folder of the fit's input files."""
        return self.context.root / CHECKPOINT / "inputs"

    def log(self, message: str) -> None:
        """Report one sentence to the job's event log."""
        self.context.report(StageEvent(stage="fit", kind="log", message=message))

    def journal(self, files: Iterable[ChannelFiles]) -> Journal:
        """Journal of a fit of these inputs, continued where an earlier attempt stopped."""
        folder = self.context.root / CHECKPOINT
        folder.mkdir(parents=True, exist_ok=True)
        journal = Journal(
            folder / "journal.jsonl", fingerprint(self.spec, self.engine, files), self.writer.require_lease
        )
        for note in journal.notes:
            self.log(note)
        if journal.resumed:
            self.log(f"Attempt {self.context.attempt} continues after {journal.resumed} recorded results.")
        return journal

    @contextmanager
    def workers(self) -> Iterator[Executor]:
        """Executor of the fit's tasks; the tasks' keys begin with a prefix that is unique to this attempt."""
        folder = self.context.root / CHECKPOINT
        prefix = hashlib.sha256(f"{folder / 'journal.json'}/{self.context.attempt}/{os.getpid()}".encode()).hexdigest()[
            :12
        ]
        with executor(self.context.root / CANCEL_FLAG, self.engine, prefix, WEIGHTS[self.spec.priority]) as run_on:
            yield run_on

    def passes(self, run_on: Executor, files: ChannelFiles, scope: str) -> Passes:
        """Passes of one fit; ``scope`` separates its seeds and keys from those of other fits."""
        return Passes(run_on, files.coarse.blocks, files.recipe, Seeds(self.spec.seed, scope), self.trace.extend)

    def step_reporter(
        self, observations: Observations, views: tuple[ViewStack, ...], journal: Journal, done: Callable[[int], float]
    ) -> Callable[[StepReport, Evaluation], None]:
        """Function that records and reports each step of one channel's fit, with a preview every few steps.

        Args:
            observations: the fit's observations.
            views: the channel's observed views.
            journal: the journal that records the steps.
            done: returns the fraction of the job that is done after a number of steps of this channel.
        """

        def report(step: StepReport, evaluation: Evaluation) -> None:
            data = asdict(step) | {"parameters": self.names(step.parameters)}
            prefix = message_prefix(step.channel, step.tooth)
            message = f"{prefix} {step.stage} step {step.stage_step}: loss {step.loss:.3e}, {step.verdict}."
            journal.get_or_compute(history_key(step.channel, step.step), lambda: data)
            self.context.report(StageEvent(stage="fit", kind="step", message=message, done=done(step.step), data=data))
            if step.step % STEPS_PER_PREVIEW == 1 and step.tooth is None:
                for preview in write_preview(self.context.root, step, evaluation, observations.manifest, views):
                    self.context.report(StageEvent(stage="fit", kind="preview", data=preview))

        return report

    @property
    def seconds_by_purpose(self) -> dict[str, float]:
        """Time of this attempt's tasks by purpose, the longest first."""
        seconds = dict.fromkeys(PURPOSES.values(), 0.0)
        for row in self.trace:
            seconds[PURPOSES[row.kind]] += row.end_s - row.start_s
        return {name: seconds[name] for name in sorted(seconds, key=lambda name: -seconds[name]) if seconds[name] > 0}

    def write_records(
        self, journal: Journal, observations: Observations, evaluations: Mapping[str, Evaluation], views: Views
    ) -> None:
        """Write history, trace and pictures into the stage's folder."""
        folder = self.writer.folder
        history = [value for key, value in journal.entries.items() if "/history/" in key]
        write_atomic(folder / "history.json", _json(history))
        write_atomic(folder / "trace.json", _json([asdict(row) for row in self.trace]))
        store_pictures(folder / PICTURES, pictures_of(evaluations, observations.manifest, views))


def worst_error(fit: ChannelFit[Any]) -> float:
    """Relative image error on fitted or on held-out images, whichever is larger."""
    return max(fit.fit_error, fit.held_out_error or 0.0)


def _doubtful_error(fit: ChannelFit[Any]) -> float | None:
    # Held-out error where it lies two standard errors above ``DOUBTFUL_ERROR``.
    held_out = fit.evaluation.held_out
    return held_out.error if is_above(held_out, DOUBTFUL_ERROR) else None


def standard_errors(sums: Mapping[str, ErrorSums]) -> dict[str, float]:
    """Monte Carlo standard error of the image error by channel; channels without compared pixels are absent."""
    return {channel: se for channel, own in sums.items() if (se := own.error_se) is not None}


@dataclass(frozen=True)
class Assessment:
    """How far the fits of a job's channels can be believed."""

    converged: bool
    doubtful: bool
    """Whether unseen images are farther off than a model that holds would leave them."""
    advice: list[str]
    lacking: list[str] = field(default_factory=list)
    """What is to be said before anything else: that the renders are too noisy to judge the photographs by."""


def assess_convergence(fits: Mapping[str, ChannelFit[Any]]) -> Assessment:
    """Judge the fits of these channels, with advice where they did not converge or are doubtful."""
    advice = [f"{c}: {fit.solution.advice}" for c, fit in fits.items() if fit.solution.advice]
    errors = {c: worst_error(fit) for c, fit in fits.items()}
    lacking = {c: sums for c, fit in fits.items() if (sums := _unresolved(fit)) is not None}
    unexplained = [c for c, error in errors.items() if error > MAX_ERROR and c not in lacking]
    advice += [
        f"{c}: the images are still {100 * errors[c]:.0f} % off; check mesh, lights and boundary model, or raise the"
        " samples."
        for c in unexplained
    ]
    doubts = [
        f"{c}: unseen images are {100 * error:.1f} % off beside their noise, so the model leaves out more than the"
        " standard errors contain. In virtual mouths with such errors, whose enamel scatters little, coefficients were"
        " up to 11 standard errors off."
        for c, fit in fits.items()
        if c not in unexplained and (error := _doubtful_error(fit)) is not None
    ]
    converged = not unexplained and not lacking and all(fit.solution.result.converged for fit in fits.values())
    first = [
        f"{c}: the renders are too noisy to tell how far the images are off ({100 * (sums.resolved_error or 0.0):.0f} ±"
        f" {100 * (sums.error_se or 0.0):.0f} %); raise max_samples_per_pixel before looking for another cause."
        for c, sums in lacking.items()
    ]
    return Assessment(converged, bool(doubts), advice + doubts, first)


def _unresolved(fit: ChannelFit[Any]) -> ErrorSums | None:
    # Sums of the fitted or of the held-out images whose error is above the limit by noise alone, if any.
    both = fit.evaluation.held_out, fit.evaluation.fitted
    if any(is_above(sums, MAX_ERROR) for sums in both):
        return None
    return next((sums for sums in both if (sums.resolved_error or 0.0) > MAX_ERROR), None)


def is_above(sums: ErrorSums, limit: float) -> bool:
    """Whether an image error exceeds a limit by more than the renders' noise."""
    error, se = sums.resolved_error, sums.error_se
    return error is not None and se is not None and error - NOISE_Z * se > limit


def fingerprint(spec: JobSpec, engine: str, files: Iterable[ChannelFiles]) -> str:
    """Digest of everything that determines a fit's result; a journal with another fingerprint is not continued."""
    named = (FIRST_VERSION_OPTIONS | spec.changed_options) - RESULT_NEUTRAL_OPTIONS
    renderer = ENGINE_IN_FINGERPRINTS if engine == ENGINE else engine
    parts = [numerics_name(), renderer, spec.model_dump_json(include=set(named))]
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
