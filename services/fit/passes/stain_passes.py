"""The stain stage of one channel, after its media are fitted: steps of the texture alternate with steps of the media,
and each step is a journal entry.

::

    images(block), seed 1 ── cotangents w C and w ref ── stain_gradient(block), seed 2, of both ── sum in block order ──
    step

The common factor of a texture and the absorption of the media are nearly one parameter. So the first steps fit the
pattern up to a factor, the media then take up that factor, and exact steps of the texture and refits of the media
alternate to the end.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.fit.coordinates.domain import similar_tissue
from services.fit.measurements.blocks import BlockTask
from services.fit.measurements.instrument.photographs import block_of, photographed
from services.fit.passes.passes import Passes, TraceRow, compare_task, trace_row
from services.fit.solve.normal_equations import LossChange
from services.fit.solve.stains import StainSolver, StainState, StainSums, clean_state
from services.tasks.engine_host import EngineHost
from services.tasks.journal import Journal
from services.transport.optics.parameters import Tissue
from services.transport.scene.recipe import StackEstimate, StainGradient
from services.transport.scene.stain_uv import StainLayout
from services.transport.stain_view import seen_texels

RATIO_STEPS, PATTERN_STEPS = 2, 3
"""Numbers of ratio and pattern steps before the media's first refit."""
EXACT_STEPS = (3, 2)
"""Numbers of exact steps before the media's second and third refit."""
GRADIENT_G = 0.0
"""Mean cosine of the similar media in which gradients are rendered, as Jacobians are."""
SIGNIFICANCE_Z = 3.0
"""Standard errors by which the gain of a texture has to exceed that of fitted noise."""


@dataclass(frozen=True)
class StainPart:
    """What one block of N pixels adds to the sums, and its trace."""

    explained: NDArray[np.float64]
    """Derivative of sum(w ref C) with respect to the texels (H, W)."""
    carried: NDArray[np.float64]
    """Derivative of sum(w C1 C), from the same paths."""
    squares: float
    """Sum of weighted squared residuals without their Monte Carlo variance."""
    count: int
    """Number of measurements."""
    light: NDArray[np.float64]
    """sum w C1^2 of each pixel (N,) over the lights, without its Monte Carlo variance."""
    trace: TraceRow


def stain_task(host: EngineHost, task: BlockTask, similar: Tissue, seeds: tuple[int, int]) -> StainPart:
    """Render a block and the derivatives with respect to the texels."""
    start, block = time.time(), block_of(task)
    view, weight = block.fitted_view, block.fit_weight
    image: StackEstimate = host.call("images", task.recipe, task.tissue, view, samples=task.samples, seed=seeds[0])

    def gradient(cotangent: NDArray[np.float64]) -> NDArray[np.float64]:
        found: StainGradient = host.call(
            "stain_gradient", task.recipe, similar, view, cotangent, samples=task.samples, seed=seeds[1]
        )
        (texels,) = found.gradient
        assert texels is not None
        return texels

    rendered = photographed(image.mean, block, dict(task.errors))
    return StainPart(
        gradient(weight * block.reference),
        gradient(weight * rendered),
        float((weight * ((rendered - block.reference) ** 2 - image.variance)).sum()),
        int((weight > 0).sum()),
        np.maximum((weight * (rendered**2 - image.variance)).sum(axis=0), 0.0),
        trace_row("stain", task, start),
    )


@dataclass
class StainStage:
    """Fit of one tooth's stain texture in one channel."""

    passes: Passes
    journal: Journal
    layout: StainLayout
    samples: int
    """Paths per pixel of every pass."""
    raise_if_cancelled: Callable[[], None]
    report: Callable[[str, int, Tissue, str], None]
    """Called after every step with the stage, the number of the step in it, the tissue and a sentence on
    the outcome."""

    def run(self, tissue: Tissue, refit: Callable[[Tissue, int, bool], Tissue]) -> Tissue | None:
        """Fit the texture of a tooth whose media are fitted.

        Args:
            tissue: the fitted tissue without stains.
            refit: fits the media of a stained tissue; takes the tissue, the number of the refit from 0, and whether it
                is the last.

        Returns:
            The tissue with its stain and the stain's standard errors, or None where a clean surface explains the images
            equally well.
        """
        solver = StainSolver(self.layout.neighbours, len(self.layout.points_mm))
        state, stained = clean_state(solver.texels), tissue
        for step, solve in enumerate((solver.ratio_step,) * RATIO_STEPS + (solver.pattern_step,) * PATTERN_STEPS):
            state = self._step("stain.0", step, stained, state, solve)
            stained = self._with_stain(stained, state)
        stained = refit(stained, 0, False)
        done = 0
        for refit_number, steps in enumerate(EXACT_STEPS, 1):
            for step in range(steps):
                state = self._step(
                    f"stain.{refit_number}", step, stained, state, partial(solver.exact_step, number=done)
                )
                stained, done = self._with_stain(stained, state), done + 1
            stained = refit(stained, refit_number, refit_number == len(EXACT_STEPS))
        return self._with_errors(stained, state, solver) if self._is_better(tissue, stained, state) else None

    def parts(self, label: str, tissue: Tissue, seeds: tuple[int, int]) -> list[StainPart]:
        """What each block adds at a stained tissue, from an image seed and a gradient seed."""
        found: list[StainPart] = self.passes.run(
            f"{self.passes.seeds.channel}-{label}",
            tissue,
            self.samples,
            stain_task,
            similar_tissue(tissue, GRADIENT_G),
            seeds,
        )
        self.passes.record([part.trace for part in found])
        return found

    def sums(self, parts: Sequence[StainPart], tissue: Tissue) -> StainSums:
        """Sums over all blocks at a stained tissue."""
        assert tissue.stain is not None
        touched, a_t = self.layout.index >= 0, tissue.stain.transmittance
        none = np.zeros(touched.sum())
        return StainSums(
            sum(((a_t * part.explained)[touched] for part in parts), none),
            sum(((a_t * part.carried)[touched] for part in parts), none),
            sum(part.squares for part in parts),
            sum(part.count for part in parts),
        )

    def _step(
        self, stage: str, step: int, tissue: Tissue, state: StainState,
        solve: Callable[[StainState, StainSums], StainState]
    ) -> StainState:  # fmt: skip

        def compute() -> dict[str, object]:
            seeds = self.passes.seeds(stage, step, "image"), self.passes.seeds(stage, step, "gradient")
            stained = self._with_stain(tissue, state)
            return solve(state, self.sums(self.parts(f"{stage}-{step}", stained, seeds), stained)).record()

        self.raise_if_cancelled()
        entry, _ = self.journal.get_or_compute(f"{self.passes.seeds.channel}/{stage}/{step}", compute)
        moved = StainState.of(entry)
        size = float(np.sqrt(np.mean((moved.depth - state.depth) ** 2)))
        self.report(stage, step + 1, self._with_stain(tissue, moved), f"texels moved by {size:.3f}")
        return moved

    def _with_stain(self, tissue: Tissue, state: StainState) -> Tissue:
        return replace(tissue, stain=self.layout.texture(state.depth))

    def _with_errors(self, tissue: Tissue, state: StainState, solver: StainSolver) -> Tissue:
        # One more pass, of the media as the last refit left them.
        def compute() -> list[float]:
            seeds = self.passes.seeds("stain.errors", "image"), self.passes.seeds("stain.errors", "gradient")
            parts = self.parts("stain.errors", tissue, seeds)
            exits: Any = 0
            for part, block in zip(parts, self.passes.read_blocks(), strict=True):
                shares = seen_texels(self.layout, block.view)
                exits = exits + shares.T @ shares.multiply(part.light[:, None])
            errors: list[float] = solver.depth_errors(state.depth, self.sums(parts, tissue), exits).tolist()
            return errors

        self.raise_if_cancelled()
        errors, _ = self.journal.get_or_compute(f"{self.passes.seeds.channel}/stain.errors", compute)
        return replace(tissue, stain=self.layout.texture(state.depth, np.array(errors)))

    def _is_better(self, plain: Tissue, stained: Tissue, state: StainState) -> bool:
        # Fitted noise lowers F by half a unit per fitted texel, so the texture has to lower F by a whole unit per texel
        # (Akaike 1974).
        def compute() -> dict[str, float]:
            seeds = self.passes.seeds("stain.compare", 1), self.passes.seeds("stain.compare", 2)
            parts = self.passes.run(
                f"{self.passes.seeds.channel}-stain-compare", plain, self.samples, compare_task, stained, seeds, False
            )
            self.passes.record([row for _, row in parts])
            total: LossChange = parts[0][0]
            for change, _ in parts[1:]:
                total = total + change
            return {"change": total.change, "se": total.se}

        self.raise_if_cancelled()
        found, _ = self.journal.get_or_compute(f"{self.passes.seeds.channel}/stain.compare", compute)
        return bool(found["change"] + int(state.determined.sum()) + SIGNIFICANCE_Z * found["se"] < 0)
