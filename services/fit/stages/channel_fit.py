"""Common parts of the stages of every fit: the solver's loop with its journal, a report after each step, and the errors
and curvature at the end.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Generic

import numpy as np
from numpy.typing import NDArray

from services.core.records import JobSpec
from services.fit.coordinates.domain import Domain, similar_tissue
from services.fit.measurements.observations import ChannelFiles, Level
from services.fit.passes.evaluate import Evaluation, Shown, evaluate
from services.fit.passes.final_uncertainty import DisplacedScene, HeldCosines, HeldShapes, measure_final_uncertainty
from services.fit.passes.passes import Passes, StackProblem
from services.fit.solve import adam, gauss_newton, solver_state
from services.fit.solve.closing import Closing
from services.fit.solve.covariance import Uncertainty, final_model, uncertainty, whitening
from services.fit.solve.elimination import weighed
from services.fit.solve.gauss_newton import Options
from services.fit.solve.normal_equations import NormalEquations, pool
from services.fit.solve.outcome import Result, Solution
from services.fit.solve.precision import samples_needed
from services.fit.solve.solver_state import State
from services.fit.stages.last_step import SLOPE_ERROR, last_step
from services.fit.stages.step_report import StepReport, history_key, message_prefix
from services.tasks.journal import Journal
from services.transport.optics.parameters import Mouth, Optics, Tissue

Array = NDArray[np.float64]

SIMILAR_TOLERANCE = 0.02
"""Relative change of the images at which a stage in similar media has converged: its next step is within Monte Carlo
noise, and that noise in its parameters changes the images by no more. For exact media the option ``image_tolerance``
takes this place."""
FINAL_DIVISOR = 2
"""Divisor of the paths for the final uncertainty estimate, which is combined with all equations of the exact steps."""
REPEAT_STAGES = ("again", "again.1")
"""Names of the stages that continue a fit from its solution, where the prior of the instrument's errors moved that
far."""
MIN_SAMPLES = 4
"""Least number of paths per pixel, however many pixels there are."""


@dataclass(frozen=True)
class ChannelFit(Generic[Optics]):
    """Result of one channel's fit."""

    tissue: Optics
    domain: Domain
    solution: Solution
    equations: NormalEquations
    uncertainty: Uncertainty
    fit_error: float
    held_out_error: float | None
    steps: int
    evaluation: Evaluation
    problem: StackProblem[Optics]
    """The least-squares problem at the solution."""
    samples: int
    """Paths per pixel of the last measurement."""


@dataclass(kw_only=True)
class Stages(ABC, Generic[Optics]):
    """Stages of one channel's fit; every costly result is recorded in the journal, under a key that begins with the
    seeds' channel.
    """

    files: ChannelFiles
    passes: Passes
    spec: JobSpec
    journal: Journal
    report: Callable[[StepReport, Evaluation], None]
    log: Callable[[str], None]
    """Reports one sentence to the job's event log."""
    raise_if_cancelled: Callable[[], None]
    """Called between steps; raises when the job is cancelled."""
    shown: Shown = ()
    steps: int = 0
    """Number of steps so far, with those of earlier fits that count as part of this one."""
    tooth: int | None = None
    """FDI number of the tooth, where this is the fit of one tooth of a jaw."""

    @property
    @abstractmethod
    def media(self) -> tuple[str, ...]:
        """Media that the reports of steps list."""

    @abstractmethod
    def _other_values(self, tissue: Optics) -> dict[str, float]:
        """Values, by name, that the reports of steps list beside the media."""

    def _reported_name(self, name: str) -> str:
        """Name of a parameter in the reports of steps."""
        return name

    @abstractmethod
    def _held_cosines(self, domain: Domain) -> HeldCosines:
        """Mean cosines that this domain holds, as input of the final uncertainty estimate."""

    def _held_shapes(self) -> HeldShapes:
        """Shapes of the dentin that this fit holds though they have an error."""
        return ()

    def _displaced_scene(self, tissue: Optics) -> DisplacedScene | None:  # noqa: ARG002 - for those that have one
        """Scene whose dentin also moves as no fitted shape can, as input of the final uncertainty estimate."""
        return None

    @property
    def part_count(self) -> int:
        """Number of objects that the fit treats as separate in the images, such as teeth."""
        return 1

    @property
    def scope(self) -> str:
        """Start of this fit's journal keys."""
        return self.passes.seeds.channel

    @property
    def is_reported(self) -> bool:
        """Whether the last step is in the history; a step that was interrupted before its report is not."""
        return history_key(self.files.channel, self.steps) in self.journal.entries

    def options(self, level: Level) -> Options:
        """Solver limits of a stage on images of this resolution; it has converged within ``image_tolerance``."""
        most = self.spec.max_samples_per_pixel
        samples = self.full_image_samples(most) if level is self.files.full else most
        return Options(
            max_steps=self.spec.max_steps,
            max_samples=samples,
            tolerance=0.5 * self.spec.image_tolerance**2 * level.signal,
            part_count=self.part_count,
        )

    def preparatory_options(self, steps: int) -> Options:
        """Solver limits of a stage that only prepares the next: at most ``steps`` steps, with few samples."""
        options = self.options(self.files.coarse)
        samples = min(2 * self.spec.samples_per_pixel, options.max_samples)
        return replace(options, max_steps=min(steps, options.max_steps), max_samples=samples)

    def similar_media_options(self, options: Options) -> Options:
        """Solver limits of a stage in similar media, which only finds the neighbourhood of the solution, because the
        images' bias is larger than the noise of a few samples.
        """
        most = min(2 * self.spec.samples_per_pixel, options.max_samples)
        return replace(options, max_samples=most, tolerance=0.5 * SIMILAR_TOLERANCE**2 * self.files.coarse.signal)

    def switch_to_full_resolution(self) -> Options:
        """Continue with images of full resolution; returns the solver limits there."""
        self.passes = replace(self.passes, blocks=self.files.full.blocks)
        return self.options(self.files.full)

    def full_image_samples(self, samples: int) -> int:
        """Paths per pixel of full images that cost as much in all as ``samples`` per pixel of coarse images."""
        return max(round(samples * self.files.coarse.pixels / self.files.full.pixels), MIN_SAMPLES)

    def _iterate(
        self, problem: StackProblem[Optics], options: Options, samples: int, previous: Solution | None = None
    ) -> tuple[Optics, Solution]:
        if problem.jacobian_g != problem.image_g:
            options = replace(options, slope_error=SLOPE_ERROR)
        solver = gauss_newton.GaussNewton(problem.domain, options)
        return self._run(
            solver,
            solver_state,
            problem,
            solver.init(self._start_of(problem), min(samples, options.max_samples), previous),
        )

    def _start_of(self, problem: StackProblem[Optics]) -> Array:
        # Start of a stage: its tissue, and the instrument's errors as the last stage left them.
        return problem.domain.x_of(problem.base, dict(self.passes.errors))

    def _apply_errors(self, domain: Domain, x: Array) -> None:
        # Apply the instrument's errors in x to the renders of later passes.
        if domain.errors.names:
            self.passes = replace(self.passes, errors=domain.errors_at(x))

    def _run(
        self, solver: Any, records: Any, problem: StackProblem[Optics], state: Any, steps_per_entry: int = 1
    ) -> tuple[Optics, Solution]:
        # Run a solver from its first state. Every ``steps_per_entry`` steps are one journal entry, written and read by
        # ``records``, and one report.
        def advance(state: Any) -> Any:
            for _ in range(steps_per_entry):
                state = state if solver.terminate(state) else solver.step(problem, state)
            return records.state_record(state)

        while not solver.terminate(state):
            self.raise_if_cancelled()
            entry, _ = self.journal.get_or_compute(
                f"{self.scope}/{problem.stage}/{state.step}", partial(advance, state)
            )
            self.steps -= state.step
            state = records.state_from(entry)
            self.steps += state.step
            self._apply_errors(problem.domain, state.x)
            if not self.is_reported:
                self._report_step(problem, state)
        solution = solver.finish(state)
        return problem.domain.tissue_at(solution.x, problem.base), solution

    def _finish(self, problem: StackProblem[Optics], solution: Solution) -> ChannelFit[Optics]:
        # Uncertainty at the solution, and the errors that are reported.
        samples = max(
            solution.samples,
            self.full_image_samples(min(4 * self.spec.samples_per_pixel, self.spec.max_samples_per_pixel)),
        )
        equations, closing, known = self._with_uncertainty(problem, solution, samples)
        for stage in REPEAT_STAGES:
            if known.is_full_step:
                break
            # The move is too long for one linear model: fit once more from its end.
            self._apply_errors(problem.domain, known.x)
            base = problem.domain.tissue_at(known.x, problem.base)
            problem = replace(problem, base=base, passes=self.passes, stage=stage)
            base, solution = self._iterate(
                problem, replace(self.options(self.files.full), max_samples=samples), samples
            )
            problem = replace(problem, base=base)
            equations, closing, known = self._with_uncertainty(problem, solution, samples)
        problem = replace(problem, domain=known.domain)
        if closing is not None:
            ending, more = problem, 0
            if known.is_full_step and self.has_usual_precision:
                more = samples_needed(known, samples, self.options(self.files.full).max_samples) - samples
            if more:
                ending = replace(problem, stage="refined")
                equations = self._refined(ending, solution, equations, more)
            closing = self._with_last_step(ending, solution.x, equations, closing, max(samples, more))
            samples += more
            known = closing.uncertainty(problem.domain, solution.x, equations, self.part_count)
        base = problem.domain.tissue_at(known.x, problem.base)
        problem, solution = replace(problem, base=base), replace(solution, x=known.x)
        self._apply_errors(problem.domain, solution.x)
        samples_shown = self.full_image_samples(self.spec.max_samples_per_pixel)
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

    @property
    def has_usual_precision(self) -> bool:
        """Whether the paths of a single tooth may be those that its standard errors need. A job that asks for more, and
        one without errors of the instrument, takes as many as noise requires from the first exact stage on.
        """
        usual = float(JobSpec.model_fields["image_tolerance"].default)
        return bool(self.files.errors.names) and self.part_count == 1 and self.spec.image_tolerance >= usual

    def exact_options(self, samples: int) -> Options:
        """Solver limits of the first exact stage. Its paths stay as they are where the final uncertainty estimate tells
        how many are needed.
        """
        options = self.options(self.files.full)
        return replace(options, max_samples=min(samples, options.max_samples)) if self.has_usual_precision else options

    def _with_uncertainty(
        self, problem: StackProblem[Optics], solution: Solution, samples: int
    ) -> tuple[NormalEquations, Closing | None, Uncertainty]:
        # Uncertainty at a solution, moved where the instrument's errors use their prior in full. Curvature and noise
        # are rendered anew only where the solver ended without them.
        again, equations = f".{problem.stage}" if problem.stage in REPEAT_STAGES else "", solution.equations
        if equations is None:
            self.raise_if_cancelled()
            stored, _ = self.journal.get_or_compute(
                f"{self.scope}/final{again}",
                lambda: problem.linearise(solution.x, samples=samples, step=0).record(),
            )
            equations = NormalEquations.of(stored)
        problem = replace(problem, domain=weighed(problem.domain, equations))
        if problem.jacobian_g is None or solution.result is Result.STALLED:
            return equations, None, uncertainty(problem.domain, solution.x, equations, part_count=self.part_count)
        closing = self._closing(f"{self.scope}/closing{again}", problem, solution.x, equations, samples)
        return equations, closing, closing.uncertainty(problem.domain, solution.x, equations, self.part_count)

    def _closing(
        self, key: str, problem: StackProblem[Optics], x: Array, equations: NormalEquations, samples: int
    ) -> Closing:
        # Measure the response of the exact images where Jacobians came from similar media.
        domain = problem.domain
        whitened, moves, shapes = whitening(domain, equations), self.files.moves, self._held_shapes()

        def compute() -> dict[str, Any]:
            displaced = self._displaced_scene(domain.tissue_at(x, problem.base))
            prefix = message_prefix(self.files.channel, self.tooth)
            self.log(f"{prefix}: the final uncertainty estimate begins, which may take as long as all steps.")
            held, fewer = self._held_cosines(domain), max(samples // FINAL_DIVISOR, 1)
            sums = measure_final_uncertainty(problem, x, whitened.transform, held, fewer, moves, shapes, displaced)
            changed = len(shapes) + (0 if displaced is None else displaced.count)
            sources = ("shape",) * changed + tuple(move.body for move in moves)
            return Closing(sums, sources, np.zeros(len(x))).record()

        self.raise_if_cancelled()
        entry, _ = self.journal.get_or_compute(key, compute)
        return Closing.of(entry)

    def _refined(
        self, problem: StackProblem[Optics], solution: Solution, equations: NormalEquations, more: int
    ) -> NormalEquations:
        # The gradient with so many more paths, where the final uncertainty estimate was made. What that estimate
        # measured of the response, and the curvature that its coordinates whiten, stay.
        self.raise_if_cancelled()
        stored, _ = self.journal.get_or_compute(
            f"{self.scope}/refined", lambda: problem.linearise(solution.x, samples=more, step=0).record()
        )
        pooled = pool(equations, max(solution.equation_samples, 1.0), NormalEquations.of(stored), float(more))
        return replace(
            equations, gradient=pooled.gradient, gradient_noise=pooled.gradient_noise, carried=pooled.carried
        )

    def _with_last_step(
        self, problem: StackProblem[Optics], x: Array, equations: NormalEquations, closing: Closing, samples: int
    ) -> Closing:
        # One more step by the measured response, where the predicted gain exceeds noise, and prediction and comparison
        # combined are better.
        def compute() -> dict[str, Any]:
            model = final_model(problem.domain, x, equations, closing.sums)
            step, remaining = last_step(problem, x, model, self.part_count, samples)
            return {"step": step.tolist(), "remaining": remaining}

        self.raise_if_cancelled()
        entry, _ = self.journal.get_or_compute(f"{self.scope}/last-step", compute)
        return replace(closing, step=np.array(entry["step"]), remaining=float(entry["remaining"]))

    def _solve(
        self, stage: str, domain: Domain, tissue: Optics, options: Options, samples: int, similar_g: float
    ) -> tuple[Optics, Solution]:
        # Fit a stage in similar media.
        problem = StackProblem(self.passes, domain, tissue, stage, jacobian_g=similar_g, image_g=similar_g)
        return self._iterate(problem, self.similar_media_options(options), samples)

    def _evaluate(
        self, label: str, tissue: Tissue | Mouth, samples: int, level: Level, *, by_frame: bool = False
    ) -> Evaluation:
        passes = replace(self.passes, blocks=level.evaluation_blocks, recipe=self.files.evaluation_recipe)
        return evaluate(passes, label, tissue, samples, self.shown, by_frame=by_frame)

    def _report_step(self, problem: StackProblem[Optics], state: State | adam.State) -> None:
        stage, tissue = problem.stage, problem.domain.tissue_at(state.x, problem.base)
        shown = tissue if problem.image_g is None else similar_tissue(tissue, problem.image_g)
        self._evaluate_and_report(stage, state.step, tissue, state.samples, state.verdict, shown)

    def _evaluate_and_report(
        self, stage: str, stage_step: int, tissue: Optics, samples: int, verdict: str, shown: Optics | None = None
    ) -> None:
        # Evaluate ``shown``, which is the tissue itself unless it is fitted through other media, and report.
        evaluation = self._evaluate(
            f"{stage}-{stage_step}", shown or tissue, self.spec.samples_per_pixel, self.files.coarse
        )
        fitted, held_out = evaluation.fitted, evaluation.held_out
        leaves = ("sigma", "alpha", "beta", "g1", "g2", "sigma_s_reduced")
        values = {
            f"{part}.{leaf}": float(getattr(tissue.medium(part), leaf)) for part in self.media for leaf in leaves
        } | self._other_values(tissue)
        values = {self._reported_name(name): value for name, value in values.items()}
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
