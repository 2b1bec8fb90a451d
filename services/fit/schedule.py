"""One channel's fit, from nothing to parameters: table search, homogeneous tooth, starts for two media, exact fit.

============  ===============================================  ========  =======================================================
stage         free                                             media     ends
============  ===============================================  ========  =======================================================
search        table over albedo x density x anisotropy         exact     best point
homogeneous   sigma, alpha shared by both media                similar   converged, or a few steps
start.k       sigma, alpha of both media, from several ratios  similar   two steps each; the least loss goes on
layered       the same                                         similar   converged, or max_steps
shape         the same and the dentin's blend weights          similar   converged, or max_steps; only where they are fitted
exact         the same                                         exact     converged, or max_steps
phase         g1, beta, g2 too                                 exact     converged, or max_steps; only with two lobes
============  ===============================================  ========  =======================================================

Similar media have the same reduced scattering and absorption at mean cosine 0 (similarity theory). They cost several times less for equal noise, and
their derivatives to sigma are several times less noisy, at an image error of 1 to 2 %. So they carry the fit to its neighbourhood. In the last stage
residuals come from the exact media and only the Jacobian from similar ones: where J'W r = 0 the exact image fits, whatever approximates J.

sigma and g are nearly one parameter in a thick medium. With one lobe g1 is held at the literature's centre and sigma, reported at that g, absorbs the
rest; reduced quantities do not depend on the choice. With two lobes g1, beta and g2 are free under weak Gaussian priors. Absorption of a thin enamel cap
is nearly invisible, so its exponent carries a prior two decades wide.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from services.core.records import JobSpec
from services.fit.closing import measure_closing
from services.fit.evaluate import Evaluation, evaluate
from services.fit.journal import Journal
from services.fit.next_capture import Sensor, advice
from services.fit.observations import ChannelFiles
from services.fit.optics.domain import Coordinate, Domain, similar_medium, similar_tissue, to_dual
from services.fit.optics.parameters import Medium, Tissue
from services.fit.passes import Passes, StackProblem, orders_task
from services.fit.solve import table_search
from services.fit.solve.closing import ClosingSums
from services.fit.solve.covariance import Uncertainty, closing_step, uncertainty, whitening
from services.fit.solve.gauss_newton import GaussNewton, Options, Result, Solution, State, state_from, state_record
from services.fit.solve.normal_equations import NormalEquations

PRIORS = {
    "g1": (to_dual("g1", 0.8), 0.35),
    "alpha": (2.3, 1.0),
    "beta": (to_dual("beta", 0.9), 1.0),
    "g2": (to_dual("g2", -0.1), 0.35),
}
"""Mean and standard deviation in the unbounded domain. g1: 0.64 to 0.89; 1 - alpha: 5e-4 to 5e-2; beta: 0.77 to 0.96; g2: -0.42 to 0.25 (one sigma)."""
HELD_G = 0.8
SIMILAR_G = 0.0
START_RATIOS = ((0.8, 1.25), (0.5, 1.6), (0.35, 2.5))
"""Density of enamel and dentin over the homogeneous tooth's: dentin scatters more in every source of the literature table."""
HOMOGENEOUS_STEPS = 4
EXACT_SAMPLES = 4
"""Paths per pixel at which the exact stages begin, over those of the start; they double as noise asks."""
SEARCH_SAMPLES = 64
"""Least paths per pixel of the search, which looks at a few hundred pixels only."""
CLOSING_TRIALS = 2
"""Lengths tried of the step after the closing measurement."""
START_STEPS = 2
START_SHAPE = 0.4
IMAGE_TOLERANCE = 0.004
"""A stage has converged when its next step is within Monte Carlo noise, and that noise in its parameters changes the images by no more, relative."""


@dataclass(frozen=True)
class StepReport:
    """One step, for whoever watches."""

    channel: str
    stage: str
    step: int
    stage_step: int
    loss: float
    """Relative squared error on fitted images, sensor noise included; dimensionless. This and the errors are not below what the step's samples resolve."""
    fit_error: float | None
    held_out_error: float | None
    held_out_se: float | None
    """Monte Carlo standard error of ``held_out_error``."""
    parameters: dict[str, float]
    samples: int
    verdict: str


@dataclass(frozen=True)
class ChannelFit:
    """A channel's result."""

    tissue: Tissue
    domain: Domain
    solution: Solution
    equations: NormalEquations
    known: Uncertainty
    fit_error: float
    held_out_error: float | None
    steps: int
    evaluation: Evaluation
    problem: StackProblem
    """At the solution."""
    samples: int
    """Paths per pixel of the last measurement."""


@dataclass
class ChannelSchedule:
    """Runs the stages of one channel; everything costly goes through the journal."""

    files: ChannelFiles
    passes: Passes
    spec: JobSpec
    journal: Journal
    has_dentin: bool
    modes: int
    """Blend weights to fit; 0 where the dentin's shape is known."""
    report: Callable[[StepReport, Evaluation], None]
    pause: Callable[[], None]
    """Called between steps; raises when the job is cancelled."""
    shown: tuple[tuple[str, int], ...] = ()
    shape: tuple[float, ...] = ()
    """Known blend weights."""
    steps: int = 0

    def run(self) -> ChannelFit:
        """Fit the channel."""
        spec, tissue, samples = self.spec, self._homogeneous_start(), self.spec.samples_per_pixel
        tolerance = 0.5 * IMAGE_TOLERANCE**2 * self.files.signal
        options = Options(max_steps=spec.max_steps, max_samples=spec.max_samples_per_pixel, tolerance=tolerance)
        parts = ("enamel", "dentin") if self.has_dentin else ("enamel",)
        domain = media_domain(parts, ("sigma", "alpha"))
        if self.has_dentin:
            short = replace(options, max_steps=min(HOMOGENEOUS_STEPS, spec.max_steps), max_samples=2 * samples)
            tissue, _ = self._solve("homogeneous", shared_domain(), tissue, short, samples, SIMILAR_G)
            tissue = self._best_start(tissue, replace(options, max_steps=min(START_STEPS, spec.max_steps), max_samples=2 * samples))
        stage = "layered" if self.has_dentin else "homogeneous"
        tissue, solution = self._solve(stage, domain, tissue, options, 2 * samples, SIMILAR_G)
        if self.modes:
            domain = Domain(domain.coordinates + tuple(Coordinate((f"shape.{k}",)) for k in range(self.modes)))
            tissue, solution = self._solve("shape", domain, tissue, options, solution.samples, SIMILAR_G)
        problem = StackProblem(self.passes, domain, tissue, "exact", jacobian_g=SIMILAR_G)
        tissue, solution = self._iterate(problem, options, min(solution.samples, EXACT_SAMPLES * samples))
        if spec.lobes == 2:
            domain = media_domain(parts, ("sigma", "alpha", "g1", "beta", "g2"))
            problem = StackProblem(self.passes, domain, self._with_lobes(tissue), "phase")
            tissue, solution = self._iterate(problem, options, min(solution.samples, EXACT_SAMPLES * samples))
        return self._finish(replace(problem, base=tissue, stage="final"), solution)

    def next_capture(self, fit: ChannelFit, folder: Path) -> str:
        """The light or view that would help this channel most, in one sentence."""
        self.pause()
        sensor, parts = Sensor(self.spec.sensor_noise_relative, self.spec.sensor_noise_floor), ("enamel", "dentin") if self.has_dentin else ("enamel",)
        given = folder, parts, sensor, self.files.weight, fit.samples, self.spec.pixel_step
        found, _ = self.journal.once(f"{self.files.channel}/next-capture", lambda: advice(fit.problem, fit.known, *given)[0])
        return str(found)

    def _homogeneous_start(self) -> Tissue:
        # The table's best point, seen as a medium of the mean cosine that is held.
        start = self._search()
        medium = similar_medium(Medium(start.sigma, start.alpha, g1=start.g), HELD_G)
        return Tissue(medium, medium, (START_SHAPE,) * self.modes if self.modes else self.shape)

    def _search(self) -> table_search.Candidate:
        # One render per node and view with two seeds each, so that <C,C> is free of noise; every albedo follows from it.
        nodes, edges = table_search.nodes(), table_search.order_edges()
        passes = replace(self.passes, blocks=self.files.search_blocks)

        def compute() -> list[dict[str, float]]:
            albedos = -(-self.spec.search_candidates // len(nodes))
            observed = [table_search.Observed.of(block) for block in passes.read_blocks()]
            pending = []
            for n, node in enumerate(nodes):
                medium = Medium(node.sigma, 1.0, g1=node.g)
                tissue = Tissue(medium, medium, (START_SHAPE,) * self.modes if self.modes else self.shape)
                label = f"{self.files.channel}-search-{n}"
                for task in passes.tasks(label, tissue, max(self.spec.samples_per_pixel, SEARCH_SAMPLES)):
                    for k in (1, 2):
                        seed = passes.seeds("search", n, k)
                        pending.append(passes.executor.submit(f"{label}-{task.index}-{k}", orders_task, task, edges, seed))
            parts = passes.executor.gather(pending)
            passes.record([row for _, row in parts])
            orders = iter([orders for orders, _ in parts])
            found = []
            for node in nodes:
                pairs = [(next(orders), next(orders)) for _ in passes.blocks]
                found.append(table_search.search_node(node, pairs, edges, observed, albedos))
            return [asdict(candidate) for candidate in table_search.best(found)]

        self.pause()
        best, _ = self.journal.once(f"{self.files.channel}/search", compute)
        return table_search.Candidate(**best[0])

    def _solve(self, stage: str, domain: Domain, tissue: Tissue, options: Options, samples: int, similar_g: float) -> tuple[Tissue, Solution]:
        problem = StackProblem(self.passes, domain, tissue, stage, jacobian_g=similar_g, image_g=similar_g)
        return self._iterate(problem, options, samples)

    def _iterate(self, problem: StackProblem, options: Options, samples: int) -> tuple[Tissue, Solution]:
        # The solver's loop; each step is one journal entry.
        domain, solver = problem.domain, GaussNewton(problem.domain, options)
        state = solver.init(domain.x_of(problem.base), min(samples, options.max_samples))
        while not solver.terminate(state):
            self.pause()
            before = state
            key = f"{self.files.channel}/{problem.stage}/{state.step}"
            entry, is_new = self.journal.once(key, lambda before=before: state_record(solver.step(problem, before)))  # type: ignore[misc]
            state = state_from(entry)
            self.steps += 1
            if is_new:
                self._tell(problem, state)
        solution = solver.finish(state)
        return domain.tissue_at(solution.x, problem.base), solution

    def _best_start(self, tissue: Tissue, options: Options) -> Tissue:
        # Several density ratios, each improved a little, then compared by loss with the same seeds: with few samples a single start may end with enamel
        # and dentin exchanged.
        domain, ends = media_domain(("enamel", "dentin"), ("sigma", "alpha")), []
        for k, (thin, dense) in enumerate(START_RATIOS):
            start = tissue.with_values({"enamel.sigma": thin * tissue.enamel.sigma, "dentin.sigma": dense * tissue.dentin.sigma})
            ends.append(self._solve(f"start.{k}", domain, start, options, self.spec.samples_per_pixel, SIMILAR_G)[0])
        samples = min(4 * self.spec.samples_per_pixel, self.spec.max_samples_per_pixel)
        problem = StackProblem(self.passes, domain, tissue, "starts", image_g=SIMILAR_G)

        def compute() -> int:
            best = 0
            for k in range(1, len(ends)):
                change = problem.compare(domain.x_of(ends[best]), domain.x_of(ends[k]), samples=samples, step=k, trial=0)
                best = k if change.change < 0 else best
            return best

        self.pause()
        best, _ = self.journal.once(f"{self.files.channel}/starts", compute)
        return ends[best]

    def _finish(self, problem: StackProblem, solution: Solution) -> ChannelFit:
        # Curvature and noise around the solution, rendered anew only where the solver ended without them; and the errors that are reported.
        samples = min(max(solution.samples, 4 * self.spec.samples_per_pixel), self.spec.max_samples_per_pixel)
        equations = solution.equations
        if equations is None:
            self.pause()
            stored, _ = self.journal.once(f"{self.files.channel}/final", lambda: problem.linearise(solution.x, samples=samples, step=0).record())
            equations = NormalEquations.of(stored)
        problem, solution, known = self._close(problem, solution, equations, samples)
        evaluation = self._evaluate("final", problem.base, self.spec.max_samples_per_pixel)
        fitted, held_out = evaluation.fitted.resolved_error or 0.0, evaluation.held_out.resolved_error
        return ChannelFit(problem.base, problem.domain, solution, equations, known, fitted, held_out, self.steps, evaluation, problem, samples)

    def _close(self, problem: StackProblem, solution: Solution, equations: NormalEquations, samples: int) -> tuple[StackProblem, Solution, Uncertainty]:
        # Where Jacobians were those of similar media, the response of the exact images is measured, and one more step made by it unless it is surely worse.
        domain, x = problem.domain, solution.x
        if problem.jacobian_g is None or solution.result is Result.STALLED:
            return problem, solution, uncertainty(domain, x, equations)
        known = whitening(domain, equations)
        held = {part: PRIORS["g1"] for part in (("enamel", "dentin") if self.has_dentin else ("enamel",)) if f"{part}.g1" not in domain.parameters}

        def compute() -> dict[str, Any]:
            sums = measure_closing(problem, x, known.transform, held, samples)
            step, (mean, precision) = closing_step(domain, x, equations, sums), domain.prior
            for trial in range(CLOSING_TRIALS):
                compared = problem.compare(x, x + step, samples=samples, step=0, trial=trial)
                change = compared.change + 0.5 * float(precision @ ((x + step - mean) ** 2 - (x - mean) ** 2))
                if change <= Options().sure_z * compared.se:
                    return {"sums": sums.record(), "step": step.tolist()}
                step = 0.3 * step
            return {"sums": sums.record(), "step": np.zeros(len(x)).tolist()}

        self.pause()
        entry, _ = self.journal.once(f"{self.files.channel}/closing", compute)
        step = np.array(entry["step"])
        measured = uncertainty(domain, x + step, equations, ClosingSums.of(entry["sums"]), step)
        return replace(problem, base=domain.tissue_at(x + step, problem.base)), replace(solution, x=x + step), measured

    def _evaluate(self, label: str, tissue: Tissue, samples: int) -> Evaluation:
        passes = replace(self.passes, blocks=self.files.evaluation_blocks, recipe=self.files.evaluation_recipe)
        return evaluate(passes, label, tissue, samples, self.shown)

    def _tell(self, problem: StackProblem, state: State) -> None:
        stage, tissue = problem.stage, problem.domain.tissue_at(state.x, problem.base)
        shown = tissue if problem.image_g is None else similar_tissue(tissue, problem.image_g)
        evaluation = self._evaluate(f"{stage}-{state.step}", shown, self.spec.samples_per_pixel)
        fitted, held_out = evaluation.fitted, evaluation.held_out
        parts = ("enamel", "dentin") if self.has_dentin else ("enamel",)
        values = {
            f"{part}.{leaf}": float(getattr(getattr(tissue, part), leaf))
            for part in parts
            for leaf in ("sigma", "alpha", "beta", "g1", "g2", "sigma_s_reduced")
        }
        values |= {f"shape.{k}": c for k, c in enumerate(tissue.shape)}
        loss = fitted.loss or 0.0
        self.report(
            StepReport(
                self.files.channel,
                stage,
                self.steps,
                state.step,
                loss,
                fitted.resolved_error,
                held_out.resolved_error,
                held_out.error_se,
                values,
                state.samples,
                state.verdict,
            ),
            evaluation,
        )

    def _with_lobes(self, tissue: Tissue) -> Tissue:
        # A second lobe starts at its prior's centre, the first keeps the mean cosine.
        beta, g2 = 0.9, -0.1
        g1 = (HELD_G - (1 - beta) * g2) / beta
        return tissue.with_values({f"{part}.{leaf}": v for part in ("enamel", "dentin") for leaf, v in (("beta", beta), ("g1", g1), ("g2", g2))})


def shared_domain() -> Domain:
    """Both media alike, sigma and alpha."""
    return Domain(tuple(_coordinate((f"enamel.{leaf}", f"dentin.{leaf}")) for leaf in ("sigma", "alpha")))


def media_domain(parts: tuple[str, ...], leaves: tuple[str, ...]) -> Domain:
    """Each medium on its own."""
    return Domain(tuple(_coordinate((f"{part}.{leaf}",)) for part in parts for leaf in leaves))


def _coordinate(targets: tuple[str, ...]) -> Coordinate:
    leaf = targets[0].split(".")[1]
    return Coordinate(targets, *PRIORS[leaf]) if leaf in PRIORS else Coordinate(targets)
