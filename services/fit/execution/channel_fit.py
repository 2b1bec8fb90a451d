"""What the stages of every fit share: the solver's loop through the journal, a report after each step, the errors and
curvature at the end.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Generic

import numpy as np
from numpy.typing import NDArray

from services.core.records import JobSpec
from services.fit.checks.evaluate import Evaluation, Shown, evaluate
from services.fit.execution.closing import Held, measure_closing
from services.fit.execution.journal import Journal
from services.fit.execution.passes import Passes, StackProblem
from services.fit.inputs.observations import ChannelFiles, Level
from services.fit.optics.domain import Domain, similar_tissue
from services.fit.optics.parameters import Mouth, Optics, Tissue
from services.fit.solve import adam, gauss_newton
from services.fit.solve.closing import ClosingSums
from services.fit.solve.covariance import ClosingModel, Uncertainty, closing_model, uncertainty, whitening
from services.fit.solve.gauss_newton import LAST_STEP_Z, Judged, Options, Result, Solution, State
from services.fit.solve.normal_equations import NormalEquations

Array = NDArray[np.float64]

SIMILAR_TOLERANCE = 0.02
"""What the option ``image_tolerance`` is for exact media: a stage in similar ones has converged when its next step is
within Monte Carlo noise, and that noise in its parameters changes the images by no more, relative."""
SLOPE_ERROR = 0.5
"""Relative error of what Jacobians of similar media promise for one tooth's exact images, however short the step;
several are wrong independently."""
CLOSING_SHARE = 2
"""The closing measurement has so many times fewer paths: it joins what all exact steps know."""
CLOSING_TRIALS = 2
"""Lengths tried of the step after the closing measurement."""
CLOSING_MIN_SHARE = 0.1
"""No step is tried that is shorter than so much of the one before."""
AGAIN = "again"
"""The stage of a fit that goes on where its first end has put the answer far from it."""
MIN_SAMPLES = 4
"""Paths per pixel, however many pixels there are."""


@dataclass(frozen=True)
class StepReport:
    """One step, for whoever watches."""

    channel: str
    stage: str
    step: int
    stage_step: int
    loss: float
    """Relative squared error on fitted images, sensor noise included; dimensionless. This and the errors are not below
    what the step's samples resolve."""
    fit_error: float | None
    held_out_error: float | None
    held_out_se: float | None
    """Monte Carlo standard error of ``held_out_error``."""
    parameters: dict[str, float]
    samples: int
    verdict: str
    tooth: int | None = None
    """FDI number, while a jaw's fit looks at one tooth alone."""


def told_place(channel: str, tooth: int | None) -> str:
    """What a fit's sentences begin with: the channel, and the tooth while a jaw's fit looks at one alone."""
    return channel if tooth is None else f"{channel}, tooth {tooth}"


def history_key(channel: str, step: int) -> str:
    """The journal's key of a step's report."""
    return f"{channel}/history/{step}"


def last_step(problem: StackProblem[Any], x: Array, model: ClosingModel, part_count: int, samples: int) -> Array:
    """The step from x (F,) by the closing measurement, or a shorter one; zeros where it promises no more than noise
    does, or is not better.

    Args:
        part_count: how many things the fit is about that images tell apart; what one of them promises is wrong
            independently of the others.
        samples: paths per pixel of a comparison.
    """
    step, slope_error = model.step(part_count), SLOPE_ERROR / math.sqrt(part_count)
    for trial in range(CLOSING_TRIALS):
        promised, promised_se = model.promise(step)
        if promised >= 0:
            break
        compared = problem.compare(x, x + step, samples=samples, step=0, trial=trial)
        change = compared.change + problem.domain.prior_change(x, x + step)
        judged = Judged(change, compared.se, promised, math.hypot(promised_se, slope_error * promised))
        if judged.is_better(LAST_STEP_Z):
            return step
        if not (judged.is_worse or judged.contradicted):
            break
        # Least on the parabola of slope and comparison (Nocedal and Wright 2006, section 3.5).
        slope = model.slope(step)
        step = max(0.5 * slope / (slope - max(change, 0.0)), CLOSING_MIN_SHARE) * step
    return np.zeros(len(x))


@dataclass(frozen=True)
class ChannelFit(Generic[Optics]):
    """A channel's result."""

    tissue: Optics
    domain: Domain
    solution: Solution
    equations: NormalEquations
    known: Uncertainty
    fit_error: float
    held_out_error: float | None
    steps: int
    evaluation: Evaluation
    problem: StackProblem[Optics]
    """At the solution."""
    samples: int
    """Paths per pixel of the last measurement."""


@dataclass(kw_only=True)
class Stages(ABC, Generic[Optics]):
    """Runs stages of one channel's fit; everything costly goes through the journal, under keys that begin with the
    seeds' channel.
    """

    files: ChannelFiles
    passes: Passes
    spec: JobSpec
    journal: Journal
    report: Callable[[StepReport, Evaluation], None]
    say: Callable[[str], None]
    """Tells whoever watches one sentence."""
    pause: Callable[[], None]
    """Called between steps; raises when the job is cancelled."""
    shown: Shown = ()
    steps: int = 0
    """Taken so far, those of earlier fits that are counted with this one included."""
    tooth: int | None = None
    """FDI number of the one tooth of a jaw that this fit is about."""

    @property
    @abstractmethod
    def media(self) -> tuple[str, ...]:
        """Media that reports of steps list."""

    @abstractmethod
    def _others(self, tissue: Optics) -> dict[str, float]:
        """What they list beside media."""

    def _told_name(self, name: str) -> str:
        """How reports of steps call a parameter."""
        return name

    @abstractmethod
    def _held(self, domain: Domain) -> Held:
        """Mean cosines that this domain holds, as the closing measurement takes them."""

    @property
    def part_count(self) -> int:
        """How many things the fit is about that images tell apart, such as teeth."""
        return 1

    @property
    def scope(self) -> str:
        """Begins the journal's keys of this fit."""
        return self.passes.seeds.channel

    @property
    def is_told(self) -> bool:
        """Whether the step just taken is in the history; one that was cut off before its report is not."""
        return history_key(self.files.channel, self.steps) in self.journal.entries

    def options(self, level: Level) -> Options:
        """Limits of a stage on images of this resolution; it has converged within ``image_tolerance``."""
        most = self.spec.max_samples_per_pixel
        samples = self.fewer(most) if level is self.files.full else most
        return Options(
            max_steps=self.spec.max_steps,
            max_samples=samples,
            tolerance=0.5 * self.spec.image_tolerance**2 * level.signal,
            parts=self.part_count,
        )

    def short(self, steps: int) -> Options:
        """Limits of a stage that only prepares the next: so many steps, few samples."""
        options = self.options(self.files.coarse)
        samples = min(2 * self.spec.samples_per_pixel, options.max_samples)
        return replace(options, max_steps=min(steps, options.max_steps), max_samples=samples)

    def in_similar_media(self, options: Options) -> Options:
        """Limits of a stage whose images are off by more than a few samples resolve: it only finds the
        neighbourhood.
        """
        most = min(2 * self.spec.samples_per_pixel, options.max_samples)
        return replace(options, max_samples=most, tolerance=0.5 * SIMILAR_TOLERANCE**2 * self.files.coarse.signal)

    def at_full_resolution(self) -> Options:
        """Go on with full images; returns the limits there."""
        self.passes = replace(self.passes, blocks=self.files.full.blocks)
        return self.options(self.files.full)

    def fewer(self, samples: int) -> int:
        """Paths per pixel of full images, for as many in all as ``samples`` are per pixel of coarse ones."""
        return max(round(samples * self.files.coarse.pixels / self.files.full.pixels), MIN_SAMPLES)

    def _iterate(
        self, problem: StackProblem[Optics], options: Options, samples: int, before: Solution | None = None
    ) -> tuple[Optics, Solution]:
        if problem.jacobian_g != problem.image_g:
            options = replace(options, slope_error=SLOPE_ERROR)
        solver = gauss_newton.GaussNewton(problem.domain, options)
        return self._run(
            solver,
            gauss_newton,
            problem,
            solver.init(self._start_of(problem), min(samples, options.max_samples), before),
        )

    def _start_of(self, problem: StackProblem[Optics]) -> Array:
        # Where a stage begins: its tissue, and the instrument's errors as the last stage left them.
        return problem.domain.x_of(problem.base, dict(self.passes.errors))

    def _see(self, domain: Domain, x: Array) -> None:
        # Later passes see photographs freed of the instrument's errors in x.
        if domain.errors.names:
            self.passes = replace(self.passes, errors=domain.errors_at(x))

    def _run(
        self, solver: Any, kind: Any, problem: StackProblem[Optics], state: Any, burst: int = 1
    ) -> tuple[Optics, Solution]:
        # A solver's loop from its first state; every ``burst`` steps are one journal entry, written and read by the
        # solver's module ``kind``, and one report.
        def advance(state: Any) -> Any:
            for _ in range(burst):
                state = state if solver.terminate(state) else solver.step(problem, state)
            return kind.state_record(state)

        while not solver.terminate(state):
            self.pause()
            entry, _ = self.journal.once(f"{self.scope}/{problem.stage}/{state.step}", partial(advance, state))
            self.steps -= state.step
            state = kind.state_from(entry)
            self.steps += state.step
            self._see(problem.domain, state.x)
            if not self.is_told:
                self._tell(problem, state)
        solution = solver.finish(state)
        return problem.domain.tissue_at(solution.x, problem.base), solution

    def _finish(self, problem: StackProblem[Optics], solution: Solution) -> ChannelFit[Optics]:
        # Curvature and noise around the solution, rendered anew only where the solver ended without them; and the
        # errors that are reported.
        samples = max(
            solution.samples, self.fewer(min(4 * self.spec.samples_per_pixel, self.spec.max_samples_per_pixel))
        )
        problem, solution, equations, known = self._close(problem, solution, samples)
        if not known.is_whole:
            # Too far for one linear model: look again from there, once.
            self._see(problem.domain, solution.x)
            again = replace(problem, passes=self.passes, stage=AGAIN)
            base, solution = self._iterate(again, self.options(self.files.full), samples)
            problem, solution, equations, known = self._close(replace(again, base=base), solution, samples)
        self._see(problem.domain, solution.x)
        samples_shown = self.fewer(self.spec.max_samples_per_pixel)
        evaluation = self._evaluate("final", problem.base, samples_shown, self.files.full, by_frame=True)
        fitted, held_out = evaluation.fitted.resolved_error or 0.0, evaluation.held_out.resolved_error
        return ChannelFit(
            problem.base,
            problem.domain,
            solution,
            equations,
            known,
            fitted,
            held_out,
            self.steps,
            evaluation,
            problem,
            samples,
        )

    def _close(
        self, problem: StackProblem[Optics], solution: Solution, samples: int
    ) -> tuple[StackProblem[Optics], Solution, NormalEquations, Uncertainty]:
        # The uncertainty at a solution, moved where the instrument's errors use their prior in full; all of them where
        # that puts the answer. Curvature and noise are rendered anew only where the solver ended without them.
        again, equations = f".{AGAIN}" if problem.stage == AGAIN else "", solution.equations
        if equations is None:
            self.pause()
            stored, _ = self.journal.once(
                f"{self.scope}/final{again}",
                lambda: problem.linearise(solution.x, samples=samples, step=0).record(),
            )
            equations = NormalEquations.of(stored)
        if problem.jacobian_g is None or solution.result is Result.STALLED:
            known = uncertainty(problem.domain, solution.x, equations, part_count=self.part_count)
            if not problem.domain.errors.names:
                return problem, solution, equations, known
        else:
            known = self._measured(f"{self.scope}/closing{again}", problem, solution.x, equations, samples)
        base = problem.domain.tissue_at(known.x, problem.base)
        return replace(problem, base=base), replace(solution, x=known.x), equations, known

    def _measured(
        self, key: str, problem: StackProblem[Optics], x: Array, equations: NormalEquations, samples: int
    ) -> Uncertainty:
        # Where Jacobians were those of similar media, the response of the exact images is measured, and one more step
        # made by it where it promises more than noise does, and is better by that promise and by images together.
        domain = problem.domain
        known, moves = whitening(domain, equations), self.files.moves

        def compute() -> dict[str, Any]:
            place = told_place(self.files.channel, self.tooth)
            self.say(f"{place}: renders around the answer tell its ±, which may take as long as all steps.")
            sums = measure_closing(
                problem, x, known.transform, self._held(domain), max(samples // CLOSING_SHARE, 1), moves
            )
            return {
                "sums": sums.record(),
                "step": last_step(
                    problem, x, closing_model(domain, x, equations, sums), self.part_count, samples
                ).tolist(),
            }

        self.pause()
        entry, _ = self.journal.once(key, compute)
        step = np.array(entry["step"])
        sums = ClosingSums.of(entry["sums"])
        bodies = [move.body for move in moves]
        return uncertainty(domain, x + step, equations, sums, step, bodies, self.part_count)

    def _solve(
        self, stage: str, domain: Domain, tissue: Optics, options: Options, samples: int, similar_g: float
    ) -> tuple[Optics, Solution]:
        # A stage in similar media.
        problem = StackProblem(self.passes, domain, tissue, stage, jacobian_g=similar_g, image_g=similar_g)
        return self._iterate(problem, self.in_similar_media(options), samples)

    def _evaluate(
        self, label: str, tissue: Tissue | Mouth, samples: int, level: Level, *, by_frame: bool = False
    ) -> Evaluation:
        passes = replace(self.passes, blocks=level.evaluation_blocks, recipe=self.files.evaluation_recipe)
        return evaluate(passes, label, tissue, samples, self.shown, by_frame=by_frame)

    def _tell(self, problem: StackProblem[Optics], state: State | adam.State) -> None:
        stage, tissue = problem.stage, problem.domain.tissue_at(state.x, problem.base)
        shown = tissue if problem.image_g is None else similar_tissue(tissue, problem.image_g)
        self._announce(stage, state.step, tissue, state.samples, state.verdict, shown)

    def _announce(
        self, stage: str, stage_step: int, tissue: Optics, samples: int, verdict: str, shown: Optics | None = None
    ) -> None:
        # Evaluate what is shown, the tissue itself unless it is fitted through other media, and report.
        evaluation = self._evaluate(
            f"{stage}-{stage_step}", shown or tissue, self.spec.samples_per_pixel, self.files.coarse
        )
        fitted, held_out = evaluation.fitted, evaluation.held_out
        leaves = ("sigma", "alpha", "beta", "g1", "g2", "sigma_s_reduced")
        values = {
            f"{part}.{leaf}": float(getattr(tissue.medium(part), leaf)) for part in self.media for leaf in leaves
        } | self._others(tissue)
        values = {self._told_name(name): value for name, value in values.items()}
        loss = fitted.loss or 0.0
        self.report(
            StepReport(
                self.files.channel,
                stage,
                self.steps,
                stage_step,
                loss,
                fitted.resolved_error,
                held_out.resolved_error,
                held_out.error_se,
                values,
                samples,
                verdict,
                self.tooth,
            ),
            evaluation,
        )
