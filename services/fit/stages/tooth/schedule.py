"""Schedule of one channel's fit: table search, homogeneous tooth, starts for two media, fit of the exact media.

============  ===============================================  ========  ===============================================
stage         free                                             media     ends
============  ===============================================  ========  ===============================================
search        table over albedo x density x anisotropy         exact     best point
homogeneous   sigma, alpha shared by both media                similar   converged, or a few steps
start.k       sigma of both, alpha of dentin, several ratios   similar   two steps each; the least loss continues
layered       the same                                         similar   converged, or max_steps
shape         alpha of both, and the dentin's blend weights    exact     converged, or max_steps; where they are fitted
exact         the same                                         exact     converged, or max_steps
phase         g1, beta, g2 too                                 exact     converged, or max_steps; only with two lobes
again, …      the same                                         exact     as before; where errors moved x far
stain.*       texture of stains, in turn with the media        exact     a fixed number of steps each; where fitted
============  ===============================================  ========  ===============================================

Similar media have the same reduced scattering and absorption at mean cosine 0 (similarity theory). At equal noise they
cost several times less, and their derivatives to sigma have several times less noise, at an image error of 1 to 15 %.
So they bring the fit into the neighbourhood of the solution. In the last stage residuals come from the exact media and
only the Jacobian from similar ones: where J'W r = 0 the exact image fits, whatever approximates J.

sigma and g are nearly one parameter in a thick medium. With one lobe the enamel's mean cosine is a coordinate at
constant reduced scattering and absorption, from the first exact stage on, under a weak prior: it decides how much light
turns back after few scatterings. With two lobes g1, beta and g2 are free under weak Gaussian priors. The instrument's
errors become coordinates in the first exact stage: in similar media they would only compensate the bias of these. So
does the albedo of the gums around the tooth, where the scene has them.
The other channels start in the exact stage, from what the first one found (``first_channel``).
Absorption of a thin enamel cap is nearly invisible, so its exponent has a prior that is two decades wide. In similar
media it stays at the homogeneous tooth's: their bias would drive it towards 0, where derivatives to its exponent vanish
and exact stages are slow to bring it back.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.errors import SettingsError
from services.fit.checks.next_capture import Sensor, capture_advice
from services.fit.coordinates.domain import BOUNDS, HELD_G, Coordinate, Domain, similar_medium, to_dual
from services.fit.coordinates.media import media_domain, shared_domain
from services.fit.coordinates.priors import COSINE, GUMS_SD, SHAPE, WEAK, Priors, priors_of
from services.fit.measurements.observations import COARSE_PIXELS
from services.fit.passes.final_uncertainty import DisplacedScene, HeldCosines, HeldShapes
from services.fit.passes.passes import StackProblem, orders_task
from services.fit.passes.reweighting import reweighted
from services.fit.passes.stain_passes import StainStage
from services.fit.solve import adam, table_search
from services.fit.solve.gauss_newton import Options
from services.fit.solve.losses import is_reweighted
from services.fit.solve.outcome import Solution
from services.fit.stages.channel_fit import ChannelFit, Stages
from services.fit.stages.tooth.first_channel import FirstChannel
from services.transport.optics.parameters import Medium, Tissue
from services.transport.scene.stain_uv import StainLayout

ALL_LEAVES = ("sigma", "alpha", "g1", "beta", "g2")
"""Parameters of a medium with two lobes."""
SIMILAR_G = 0.0
"""Mean cosine of the similar media."""
START_RATIOS = ((0.8, 1.25), (0.5, 1.6), (0.35, 2.5))
"""Densities of enamel and dentin relative to the homogeneous tooth's: dentin scatters more in every source of the
literature table."""
HOMOGENEOUS_STEPS = 3
"""Largest number of steps of the homogeneous tooth before layers, and of each refit of the media but the last in the
stain stage."""
EXACT_SAMPLES = 4
"""Paths per pixel at the beginning of the exact stages, relative to those of the start, for three views. Where standard
errors do not tell how many are needed (``has_usual_precision``), they double where noise requires it."""
MIN_EXACT_SAMPLES = 32
"""Least number of paths per pixel at the beginning of the exact stages, where the limit allows it. With fewer,
comparisons of full images decide little: a large stack takes longer from 11 to its limit of 21 than at 21 alone."""
SEARCH_SAMPLES = 64
"""Least number of paths per pixel in the search, which renders only a few hundred pixels."""
REWEIGHTINGS = 2
"""Rounds of reweighting after the first exact stage, for losses whose weights depend on the residuals."""
STAIN_SAMPLES = 2
"""Least number of paths per pixel in a step of the stains, relative to those of the start; never fewer than the media
needed in the end."""
START_STEPS = 2
"""Largest number of steps from each start."""
ADAM_STEPS_PER_ENTRY = 10
"""Number of Adam steps between two journal entries and reports, each of which costs an evaluation of all images."""

Fitted = tuple[StackProblem[Tissue], Tissue, Solution]


@dataclass(kw_only=True)
class ChannelSchedule(Stages[Tissue]):
    """The stages of one channel of a tooth."""

    has_dentin: bool
    modes: int
    """Blend weights to fit; 0 where the dentin's shape is known."""
    shape: tuple[float, ...] = ()
    """Known blend weights."""
    shape_covariance: tuple[tuple[float, ...], ...] = ()
    """Covariance of the known blend weights, which another channel's fit found; empty where they are exact."""
    first: FirstChannel | None = None
    """What the first channel's fit tells; None for the first channel itself."""
    stain_layout: StainLayout | None = None
    """Texels to fit; None where the surface is taken as clean."""
    make_displaced_scene: Callable[[Tissue], DisplacedScene] | None = None
    """Makes the scene whose dentin also moves as its blend modes cannot; None where the dentin is known or absent."""
    gums: Medium | None = None
    """Start of the gums around the tooth, whose albedo is fitted in exact images; None for a scene without gums."""

    def run(self) -> ChannelFit[Tissue]:
        """Fit the channel."""
        if not self._domain(("sigma", "alpha")).coordinates and not self.modes:
            raise SettingsError(f"held = {sorted(self.spec.held)} leaves nothing to fit; hold fewer parameters.")
        problem, tissue, solution = self._adam_stages() if self.spec.solver == "adam" else self._stages()
        if self.stain_layout is not None:
            problem, tissue, solution = self._fit_stains(self.stain_layout, problem, tissue, solution)
        return self._finish(replace(problem, base=tissue, stage="final"), solution)

    def start(self) -> Tissue:
        """Run the first stages alone: the table's best point, and with dentin a few steps of the homogeneous tooth."""
        tissue = self._homogeneous_start()
        if not self.has_dentin:
            return tissue
        domain, options = shared_domain(self._priors), self.preparatory_options(HOMOGENEOUS_STEPS)
        return self._solve("homogeneous", domain, tissue, options, self.spec.samples_per_pixel, SIMILAR_G)[0]

    @property
    def media(self) -> tuple[str, ...]:
        """See Stages."""
        return ("enamel", "dentin") if self.has_dentin else ("enamel",)

    def _held_cosines(self, domain: Domain) -> HeldCosines:
        fixed = {
            name.rpartition(".")[0]
            for name in (*domain.parameters, *self.spec.held)
            if name.endswith((".g1", ".cosine"))
        }
        return {(part,): WEAK[f"{part}.g1"] for part in self.media if part not in fixed}

    def _held_shapes(self) -> HeldShapes:
        # One standard deviation to either side along each principal axis of the covariance, inside the bounds.
        if not self.shape_covariance:
            return ()
        variances, axes = np.linalg.eigh(np.array(self.shape_covariance))
        steps = (axes * np.sqrt(np.maximum(variances, 0.0))).T

        def weights(step: NDArray[np.float64]) -> dict[str, float]:
            inside = np.clip(np.array(self.shape) + step, *BOUNDS["shape"])
            return {f"shape.{k}": float(weight) for k, weight in enumerate(inside)}

        return [(weights(-step), weights(step)) for step in steps]

    def _displaced_scene(self, tissue: Tissue) -> DisplacedScene | None:
        return None if self.make_displaced_scene is None else self.make_displaced_scene(tissue)

    def _other_values(self, tissue: Tissue) -> dict[str, float]:
        return {f"shape.{k}": c for k, c in enumerate(tissue.shape)}

    def next_capture(self, fit: ChannelFit[Tissue], folder: Path) -> str:
        """One sentence on the light or view that would help this channel most."""
        self.raise_if_cancelled()
        sensor = Sensor(self.spec.sensor_noise_relative, self.spec.sensor_noise_floor)
        given = folder, self.media, sensor, self.files.weight, fit.samples
        found, _ = self.journal.get_or_compute(
            f"{self.scope}/next-capture", lambda: capture_advice(fit.problem, fit.uncertainty, *given)[0]
        )
        return str(found)

    def _stages(self) -> Fitted:
        # Fit the media and the dentin's shape by Gauss-Newton.
        spec, samples, options = self.spec, self.spec.samples_per_pixel, self.options(self.files.coarse)
        domain = self._domain(("sigma", "alpha"))
        if self.first is not None:
            tissue, samples_reached = self.first.start(spec.lobes).with_values(spec.held), 2 * samples
            known = tuple((name, self.first.errors.get(name, 0.0)) for name in self.files.errors.names)
            self.passes = replace(self.passes, errors=known)
        elif domain.coordinates:
            tissue, samples_reached = self._fit_similar_media(domain, options)
        else:
            tissue, samples_reached = self._held_tissue(), 2 * samples
        domain = self._with_shape(self._with_gums(self._with_cosines(domain) if spec.lobes == 1 else domain))
        domain = replace(domain, errors=self.files.errors)
        previous: Solution | None = None
        if self.modes:
            problem = StackProblem(self.passes, domain, tissue, "shape", jacobian_g=SIMILAR_G)
            tissue, previous = self._iterate(problem, options, samples_reached)

        options = self.switch_to_full_resolution()
        exact_samples = max(
            self.full_image_samples(
                round(EXACT_SAMPLES * samples * max(1.0, 3 * COARSE_PIXELS / self.files.coarse.pixels))
            ),
            MIN_EXACT_SAMPLES,
        )
        self._reweight("exact", tissue)
        problem = StackProblem(self.passes, domain, tissue, "exact", jacobian_g=SIMILAR_G)
        is_same = self.files.full.blocks == self.files.coarse.blocks and not is_reweighted(spec.loss)
        limits = self.exact_options(exact_samples) if spec.lobes == 1 else options
        tissue, solution = self._iterate(problem, limits, exact_samples, previous if is_same else None)
        for again in range(1, REWEIGHTINGS + 1) if is_reweighted(spec.loss) else ():
            self._reweight(f"exact.{again}", tissue)
            problem = replace(problem, passes=self.passes, base=tissue, stage=f"exact.{again}")
            tissue, solution = self._iterate(problem, options, solution.samples)
        if spec.lobes == 2:
            domain = replace(self._with_shape(self._with_gums(self._domain(ALL_LEAVES))), errors=self.files.errors)
            problem = StackProblem(self.passes, domain, self._with_lobes(tissue), "phase")
            tissue, solution = self._iterate(problem, options, min(solution.samples, exact_samples))
        return problem, tissue, solution

    def _fit_similar_media(self, domain: Domain, options: Options) -> tuple[Tissue, int]:
        # Run the stages in similar media; returns the tissue and the last number of paths per pixel.
        tissue = self.start()
        if self.has_dentin:
            kept = tuple(c for c in domain.coordinates if c.name != "enamel.alpha")
            domain = Domain(kept or domain.coordinates)
            tissue = self._best_start(tissue, domain, self.preparatory_options(START_STEPS))
        stage = "layered" if self.has_dentin else "homogeneous"
        tissue, solution = self._solve(
            stage, domain, tissue.with_values(self.spec.held), options, 2 * self.spec.samples_per_pixel, SIMILAR_G
        )
        return tissue, solution.samples

    def _held_tissue(self) -> Tissue:
        # Media that are held in whole, so that only the dentin's shape is fitted.
        return self._uniform(Medium(1.0, 0.5, g1=HELD_G)).with_values(self.spec.held)

    def _uniform(self, medium: Medium) -> Tissue:
        return Tissue(medium, medium, (SHAPE[0],) * self.modes if self.modes else self.shape, gums=self.gums)

    def _adam_stages(self) -> Fitted:
        # Fit as in teeth 2018: a homogeneous tooth, then both media and the dentin's shape together, by Adam.
        tissue = self._homogeneous_start()
        if self.has_dentin:
            _, tissue, _ = self._descend(
                "homogeneous", shared_domain(self._priors), tissue, self.spec.samples_per_pixel
            )
        tissue = (self._with_lobes(tissue) if self.spec.lobes == 2 else tissue).with_values(self.spec.held)
        domain = self._domain(ALL_LEAVES if self.spec.lobes == 2 else ("sigma", "alpha"))
        domain = self._with_shape(self._with_gums(domain))
        self.switch_to_full_resolution()
        return self._descend(
            "layered" if self.has_dentin else "homogeneous",
            domain,
            tissue,
            self.full_image_samples(self.spec.samples_per_pixel),
        )

    def _descend(self, stage: str, domain: Domain, tissue: Tissue, samples: int) -> Fitted:
        # Descend by Adam in the exact media with their own derivatives, at a constant number of samples.
        self._reweight(stage, tissue)
        problem = StackProblem(self.passes, domain, tissue, stage)
        solver = adam.Adam(domain, adam.Options(self.spec.adam_rate, max_steps=self.spec.adam_steps))
        return problem, *self._run(
            solver, adam, problem, solver.init(domain.x_of(tissue), samples), ADAM_STEPS_PER_ENTRY
        )

    def _reweight(self, stage: str, tissue: Tissue) -> None:
        # Compute new weights, which all later stages use, where the loss depends on the residuals.
        if is_reweighted(self.spec.loss):
            self.raise_if_cancelled()
            samples = self.full_image_samples(self.spec.max_samples_per_pixel)
            self.passes = reweighted(self.passes, self.journal, self.spec.loss, tissue, samples=samples, stage=stage)

    def _fit_stains(
        self, layout: StainLayout, problem: StackProblem[Tissue], tissue: Tissue, solution: Solution
    ) -> Fitted:
        # Fit the texture and the media alternately; return the plain fit where a texture gains nothing.
        options = self.options(self.files.full)
        samples = min(
            max(self.full_image_samples(STAIN_SAMPLES * self.spec.samples_per_pixel), solution.samples),
            options.max_samples,
        )
        last = problem, tissue, solution

        def refit(stained: Tissue, number: int, is_last: bool) -> Tissue:
            nonlocal last
            if self.spec.solver == "adam":
                last = self._descend(
                    f"stained.{number}", problem.domain, stained, self.full_image_samples(self.spec.samples_per_pixel)
                )
                return last[1]
            limits = options if is_last else replace(options, max_steps=min(HOMOGENEOUS_STEPS, options.max_steps))
            problem_now = replace(problem, base=stained, stage=f"stained.{number}")
            last = problem_now, *self._iterate(problem_now, limits, samples)
            return last[1]

        def report(stage: str, step: int, stained: Tissue, verdict: str) -> None:
            self.steps += 1
            if not self.is_reported:
                self._evaluate_and_report(stage, step, stained, samples, verdict)

        stage = StainStage(self.passes, self.journal, layout, samples, self.raise_if_cancelled, report)
        kept = stage.run(tissue, refit)
        return (problem, tissue, solution) if kept is None else (last[0], kept, last[2])

    def _domain(self, leaves: tuple[str, ...]) -> Domain:
        # Domain of the media's parameters that are not held.
        domain = media_domain(self.media, leaves, self._priors)
        return Domain(tuple(c for c in domain.coordinates if not set(c.targets) & self.spec.held.keys()))

    def _with_cosines(self, domain: Domain) -> Domain:
        # Add the enamel's mean cosine unless some parameter of the enamel is held, which another cosine would change.
        # The dentin's is left out, because light that reaches it has scattered often.
        fitted = [part for part in self.media[:1] if not any(name.startswith(f"{part}.") for name in self.spec.held)]
        priors = {} if self.first is None else self.first.cosines
        own = tuple(Coordinate((f"{part}.cosine",), *priors.get(part, COSINE)) for part in fitted)
        return Domain(domain.coordinates + own)

    def _with_gums(self, domain: Domain) -> Domain:
        # Add the gums' albedo, which decides how much light they return to the tooth, under the prior of a jaw's gums.
        if self.gums is None:
            return domain
        prior = to_dual("alpha", self.gums.alpha), GUMS_SD["alpha"]
        return Domain((*domain.coordinates, Coordinate(("gums.alpha",), *prior)))

    def _with_shape(self, domain: Domain) -> Domain:
        return Domain(domain.coordinates + tuple(Coordinate((f"shape.{k}",), *SHAPE) for k in range(self.modes)))

    @property
    def _priors(self) -> Priors:
        return priors_of(self.spec.prior)

    def _homogeneous_start(self) -> Tissue:
        # Start at the table's best point, as a similar medium of the mean cosine that is held.
        start = self._search()
        return self._uniform(similar_medium(Medium(start.sigma, start.alpha, g1=start.g), HELD_G))

    def _search(self) -> table_search.Candidate:
        # Render once per node and block with two seeds, so that noise does not bias <C,C>; every albedo follows from
        # these renders.
        nodes, edges = table_search.nodes(), table_search.order_edges()
        passes = replace(self.passes, blocks=self.files.search_blocks)

        def compute() -> list[dict[str, float]]:
            albedos = -(-self.spec.search_candidates // len(nodes))
            observed = [
                table_search.Observed.of(block.reference, block.variance, block.fit_weight)
                for block in passes.read_blocks()
            ]
            pending = []
            for n, node in enumerate(nodes):
                tissue = self._uniform(Medium(node.sigma, 1.0, g1=node.g))
                label = f"{self.scope}-search-{n}"
                for task in passes.tasks(label, tissue, max(self.spec.samples_per_pixel, SEARCH_SAMPLES)):
                    for k in (1, 2):
                        seed = passes.seeds("search", n, k)
                        pending.append(
                            passes.executor.submit(f"{label}-{task.index}-{k}", orders_task, task, edges, seed)
                        )
            parts = passes.executor.gather(pending)
            passes.record([row for _, row in parts])
            orders = iter([orders for orders, _ in parts])
            found = []
            for node in nodes:
                pairs = [(next(orders), next(orders)) for _ in passes.blocks]
                found.append(table_search.search_node(node, pairs, edges, observed, albedos))
            return [asdict(candidate) for candidate in table_search.best(found)]

        self.raise_if_cancelled()
        best, _ = self.journal.get_or_compute(f"{self.scope}/search", compute)
        return table_search.Candidate(**best[0])

    def _best_start(self, tissue: Tissue, domain: Domain, options: Options) -> Tissue:
        # Improve several density ratios by a few steps each and compare their losses with the same seeds: with few
        # samples a single start may end with enamel and dentin exchanged.
        ends = list[Tissue]()
        for k, (thin, dense) in enumerate(START_RATIOS):
            start = tissue.with_values(
                {"enamel.sigma": thin * tissue.enamel.sigma, "dentin.sigma": dense * tissue.dentin.sigma}
                | self.spec.held
            )
            ends.append(self._solve(f"start.{k}", domain, start, options, self.spec.samples_per_pixel, SIMILAR_G)[0])
        samples = min(4 * self.spec.samples_per_pixel, self.spec.max_samples_per_pixel)
        problem = StackProblem(self.passes, domain, tissue, "starts", image_g=SIMILAR_G)

        def compute() -> int:
            best = 0
            for k in range(1, len(ends)):
                change = problem.compare(
                    domain.x_of(ends[best]), domain.x_of(ends[k]), samples=samples, step=k, trial=0
                )
                best = k if change.change < 0 else best
            return best

        self.raise_if_cancelled()
        best, _ = self.journal.get_or_compute(f"{self.scope}/starts", compute)
        return ends[int(best)]

    def _with_lobes(self, tissue: Tissue) -> Tissue:
        # Start the second lobe at its prior's centre; the first keeps the mean cosine.
        beta, g2 = 0.9, -0.1
        g1 = (HELD_G - (1 - beta) * g2) / beta
        lobes = (("beta", beta), ("g1", g1), ("g2", g2))
        return tissue.with_values(
            {f"{part}.{leaf}": value for part in ("enamel", "dentin") for leaf, value in lobes} | self.spec.held
        )
