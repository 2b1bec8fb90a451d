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
stain.*       texture of stains, in turn with the media        exact     a fixed number of steps each; only where stains are fitted
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
from functools import partial
from typing import Any

from services.core.records import JobSpec
from services.fit.anatomy.stain_uv import StainLayout
from services.fit.evaluate import Evaluation, evaluate
from services.fit.journal import Journal
from services.fit.observations import ChannelFiles
from services.fit.optics.domain import Coordinate, Domain, similar_medium, similar_tissue
from services.fit.optics.parameters import Medium, Tissue
from services.fit.optics.priors import HELD_G, WEAK, Priors, priors_of
from services.fit.passes import Passes, StackProblem, orders_task
from services.fit.reweighting import reweighted
from services.fit.solve import adam, gauss_newton, table_search
from services.fit.solve.gauss_newton import Options, Solution, State
from services.fit.solve.losses import is_reweighted
from services.fit.solve.normal_equations import NormalEquations
from services.fit.stain_passes import StainStage

ALL_LEAVES = ("sigma", "alpha", "g1", "beta", "g2")
SIMILAR_G = 0.0
START_RATIOS = ((0.8, 1.25), (0.5, 1.6), (0.35, 2.5))
"""Density of enamel and dentin over the homogeneous tooth's: dentin scatters more in every source of the literature table."""
HOMOGENEOUS_STEPS = 4
EXACT_SAMPLES = 4
"""Paths per pixel at which the exact stages begin, over those of the start; they double as noise asks."""
SEARCH_SAMPLES = 64
"""Least paths per pixel of the search, which looks at a few hundred pixels only."""
REWEIGHTINGS = 2
"""Rounds of a loss that follows residuals, after the first exact stage."""
STAIN_SAMPLES = 2
"""Least paths per pixel of a step of the stains, over those of the start; as many as the media needed in the end."""
START_STEPS = 2
START_SHAPE = 0.4
IMAGE_TOLERANCE = 0.004
"""A stage has converged when its next step is within Monte Carlo noise, and that noise in its parameters changes the images by no more, relative."""


ADAM_BURST = 10
"""Steps of Adam between two journal entries and reports, each of which costs an evaluation of all images."""

Fitted = tuple[StackProblem, Tissue, Solution]


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
    fit_error: float
    held_out_error: float | None
    steps: int
    evaluation: Evaluation


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
    stain_layout: StainLayout | None = None
    """Texels to fit; None where the surface counts as clean."""
    steps: int = 0

    def run(self) -> ChannelFit:
        """Fit the channel."""
        tolerance = 0.5 * IMAGE_TOLERANCE**2 * self.files.signal
        options = Options(max_steps=self.spec.max_steps, max_samples=self.spec.max_samples_per_pixel, tolerance=tolerance)
        start = self._homogeneous_start()
        problem, tissue, solution = self._paper_stages(start) if self.spec.solver == "adam" else self._stages(start, options)
        if self.stain_layout is not None:
            problem, tissue, solution = self._stained(self.stain_layout, problem, tissue, solution, options)
        return self._finish(replace(problem, base=tissue, stage="final"), solution)

    def _stages(self, tissue: Tissue, options: Options) -> Fitted:
        # The media, and the dentin's shape, by Gauss-Newton.
        spec, samples, parts = self.spec, self.spec.samples_per_pixel, self._parts
        domain = media_domain(parts, ("sigma", "alpha"), self._priors)
        if self.has_dentin:
            short = replace(options, max_steps=min(HOMOGENEOUS_STEPS, spec.max_steps), max_samples=2 * samples)
            tissue, _ = self._solve("homogeneous", shared_domain(self._priors), tissue, short, samples, SIMILAR_G)
            tissue = self._best_start(tissue, replace(options, max_steps=min(START_STEPS, spec.max_steps), max_samples=2 * samples))
        stage = "layered" if self.has_dentin else "homogeneous"
        tissue, solution = self._solve(stage, domain, tissue, options, 2 * samples, SIMILAR_G)
        if self.modes:
            domain = self._with_shape(domain)
            tissue, solution = self._solve("shape", domain, tissue, options, solution.samples, SIMILAR_G)
        self._reweight("exact", tissue)
        problem = StackProblem(self.passes, domain, tissue, "exact", jacobian_g=SIMILAR_G)
        tissue, solution = self._iterate(problem, options, min(solution.samples, EXACT_SAMPLES * samples))
        for again in range(1, REWEIGHTINGS + 1) if is_reweighted(spec.loss) else ():
            self._reweight(f"exact.{again}", tissue)
            problem = replace(problem, passes=self.passes, base=tissue, stage=f"exact.{again}")
            tissue, solution = self._iterate(problem, options, solution.samples)
        if spec.lobes == 2:
            domain = media_domain(parts, ALL_LEAVES, self._priors)
            problem = StackProblem(self.passes, domain, self._with_lobes(tissue), "phase")
            tissue, solution = self._iterate(problem, options, min(solution.samples, EXACT_SAMPLES * samples))
        return problem, tissue, solution

    def _paper_stages(self, tissue: Tissue) -> Fitted:
        # As in teeth 2018: a homogeneous tooth, then both media and the dentin's shape together, by Adam.
        if self.has_dentin:
            _, tissue, _ = self._descend("homogeneous", shared_domain(self._priors), tissue)
        tissue = self._with_lobes(tissue) if self.spec.lobes == 2 else tissue
        domain = media_domain(self._parts, ALL_LEAVES if self.spec.lobes == 2 else ("sigma", "alpha"), self._priors)
        return self._descend("layered" if self.has_dentin else "homogeneous", self._with_shape(domain), tissue)

    def _descend(self, stage: str, domain: Domain, tissue: Tissue) -> Fitted:
        # The exact media and their own derivatives, at constant samples.
        self._reweight(stage, tissue)
        problem = StackProblem(self.passes, domain, tissue, stage)
        options = adam.Options(self.spec.adam_rate, max_steps=self.spec.adam_steps)
        return problem, *self._run(adam.Adam(domain, options), adam, problem, self.spec.samples_per_pixel, ADAM_BURST)

    def _reweight(self, stage: str, tissue: Tissue) -> None:
        # New weights where the loss follows residuals; all later stages have them.
        if is_reweighted(self.spec.loss):
            self.pause()
            samples = self.spec.max_samples_per_pixel
            self.passes = reweighted(self.passes, self.journal, self.spec.loss, tissue, samples=samples, stage=stage)

    def _stained(self, layout: StainLayout, problem: StackProblem, tissue: Tissue, solution: Solution, options: Options) -> Fitted:
        # The texture in turn with the media; what is returned is the plain fit where a texture gains nothing.
        samples = min(max(STAIN_SAMPLES * self.spec.samples_per_pixel, solution.samples), self.spec.max_samples_per_pixel)
        last = problem, tissue, solution

        def refit(stained: Tissue, turn: int, is_last: bool) -> Tissue:
            nonlocal last
            if self.spec.solver == "adam":
                last = self._descend(f"stained.{turn}", problem.domain, stained)
                return last[1]
            limits = options if is_last else replace(options, max_steps=min(HOMOGENEOUS_STEPS, options.max_steps))
            problem_now = replace(problem, base=stained, stage=f"stained.{turn}")
            last = problem_now, *self._iterate(problem_now, limits, samples)
            return last[1]

        def tell(stage: str, step: int, stained: Tissue, verdict: str, is_new: bool) -> None:
            self.steps += 1
            if is_new:
                self._announce(stage, step, stained, samples, verdict)

        stage = StainStage(self.passes, self.journal, layout, samples, self.pause, tell)
        return last if stage.run(tissue, refit) is not None else (problem, tissue, solution)

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
        solver = gauss_newton.GaussNewton(problem.domain, options)
        return self._run(solver, gauss_newton, problem, min(samples, options.max_samples))

    def _run(self, solver: Any, kind: Any, problem: StackProblem, samples: int, burst: int = 1) -> tuple[Tissue, Solution]:
        # A solver's loop; every ``burst`` steps are one journal entry, written and read by the solver's module ``kind``, and one report.
        def advance(state: Any) -> Any:
            for _ in range(burst):
                state = state if solver.terminate(state) else solver.step(problem, state)
            return kind.state_record(state)

        state = solver.init(problem.domain.x_of(problem.base), samples)
        while not solver.terminate(state):
            self.pause()
            entry, is_new = self.journal.once(f"{self.files.channel}/{problem.stage}/{state.step}", partial(advance, state))
            self.steps -= state.step
            state = kind.state_from(entry)
            self.steps += state.step
            if is_new:
                self._tell(problem, state)
        solution = solver.finish(state)
        return problem.domain.tissue_at(solution.x, problem.base), solution

    @property
    def _parts(self) -> tuple[str, ...]:
        return ("enamel", "dentin") if self.has_dentin else ("enamel",)

    @property
    def _priors(self) -> Priors:
        return priors_of(self.spec.prior)

    def _with_shape(self, domain: Domain) -> Domain:
        return Domain(domain.coordinates + tuple(Coordinate((f"shape.{k}",)) for k in range(self.modes)))

    def _best_start(self, tissue: Tissue, options: Options) -> Tissue:
        # Several density ratios, each improved a little, then compared by loss with the same seeds: with few samples a single start may end with enamel
        # and dentin exchanged.
        domain, ends = media_domain(("enamel", "dentin"), ("sigma", "alpha"), self._priors), []
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
        evaluation = self._evaluate("final", problem.base, self.spec.max_samples_per_pixel)
        fitted, held_out = evaluation.fitted.resolved_error or 0.0, evaluation.held_out.resolved_error
        return ChannelFit(problem.base, problem.domain, solution, equations, fitted, held_out, self.steps, evaluation)

    def _evaluate(self, label: str, tissue: Tissue, samples: int) -> Evaluation:
        passes = replace(self.passes, blocks=self.files.evaluation_blocks, recipe=self.files.evaluation_recipe)
        return evaluate(passes, label, tissue, samples, self.shown)

    def _tell(self, problem: StackProblem, state: State | adam.State) -> None:
        stage, tissue = problem.stage, problem.domain.tissue_at(state.x, problem.base)
        shown = tissue if problem.image_g is None else similar_tissue(tissue, problem.image_g)
        self._announce(stage, state.step, tissue, state.samples, state.verdict, shown)

    def _announce(self, stage: str, stage_step: int, tissue: Tissue, samples: int, verdict: str, shown: Tissue | None = None) -> None:
        # Evaluate what is shown, the tissue itself unless it is fitted through other media, and report.
        evaluation = self._evaluate(f"{stage}-{stage_step}", shown or tissue, self.spec.samples_per_pixel)
        fitted, held_out = evaluation.fitted, evaluation.held_out
        values = {
            f"{part}.{leaf}": float(getattr(getattr(tissue, part), leaf))
            for part in self._parts
            for leaf in ("sigma", "alpha", "beta", "g1", "g2", "sigma_s_reduced")
        }
        values |= {f"shape.{k}": c for k, c in enumerate(tissue.shape)}
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
            ),
            evaluation,
        )

    def _with_lobes(self, tissue: Tissue) -> Tissue:
        # A second lobe starts at its prior's centre, the first keeps the mean cosine.
        beta, g2 = 0.9, -0.1
        g1 = (HELD_G - (1 - beta) * g2) / beta
        return tissue.with_values({f"{part}.{leaf}": v for part in ("enamel", "dentin") for leaf, v in (("beta", beta), ("g1", g1), ("g2", g2))})


def shared_domain(priors: Priors = WEAK) -> Domain:
    """Both media alike, sigma and alpha."""
    return Domain(tuple(_coordinate((f"enamel.{leaf}", f"dentin.{leaf}"), priors) for leaf in ("sigma", "alpha")))


def media_domain(parts: tuple[str, ...], leaves: tuple[str, ...], priors: Priors = WEAK) -> Domain:
    """Each medium on its own."""
    return Domain(tuple(_coordinate((f"{part}.{leaf}",), priors) for part in parts for leaf in leaves))


def _coordinate(targets: tuple[str, ...], priors: Priors) -> Coordinate:
    # What both media share has a prior only where theirs are one.
    (prior, *others) = (priors.get(target) for target in targets)
    return Coordinate(targets) if prior is None or any(other != prior for other in others) else Coordinate(targets, *prior)
