"""Tasks of one step over blocks of pixels, on any worker: images of some blocks render beside Jacobians of others.

::

    image(block) ── residual, at most 4 MB ── jacobian(block) ── products ── ordered sum ── solve

The Jacobian task renders its two seeds in one process and multiplies them there, by each other and by the residual. So
Jacobians never leave their task; only residuals and sums over the block leave a worker. A task whose worker dies runs
again elsewhere from the same seeds, with the same result.

Pairs of seeds tell the noise of residuals and derivatives. So these are rendered as one batch, which traces exactly the
paths asked for and takes a tenth less time a path; batches are for images whose own variance enters a sum.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic

import numpy as np
from numpy.typing import NDArray

from services.core.files.content_files import StoredFile
from services.fit.coordinates.domain import Domain, similar_tissue
from services.fit.coordinates.instrument_errors import kind_of_error
from services.fit.measurements.blocks import BlockTask, PixelBlock, read_block
from services.fit.measurements.instrument.photographs import (
    block_of,
    error_derivatives,
    photographed,
    placed,
    slope_noise,
)
from services.fit.passes.derivatives import Differentiation, differentiation, exact_differentiation
from services.fit.passes.neighbours import Neighbours
from services.fit.solve.adam import Gradient
from services.fit.solve.normal_equations import LossChange, NormalEquations, Region, loss_change, normal_equations
from services.tasks.engine_host import EngineHost
from services.tasks.executors import Executor
from services.tasks.seeds import Seeds
from services.transport.optics.parameters import Mouth, Optics, Tissue
from services.transport.scene.recipe import StackEstimate

Array = NDArray[np.float64]
Near = tuple[tuple[int, ...], ...]
"""For each tooth of a jaw, by its position, the coordinates that act on the pixels near it."""
Errors = tuple[tuple[str, float], ...]
"""Errors of the instrument, by name."""


@dataclass(frozen=True)
class TraceRow:
    """Time and place of one finished task."""

    kind: str
    step: str
    block: int
    worker: str
    start_s: float
    """Seconds since the epoch."""
    end_s: float


@dataclass(frozen=True)
class Residual:
    """Render minus reference of one block (L, N), from two seeds."""

    first: Array
    second: Array
    trace: TraceRow
    images: tuple[Array, Array] | None = None
    """The renders themselves, for derivatives to the instrument's errors; None where these are not fitted."""


@dataclass(frozen=True)
class Products:
    """One block's normal equations, and the trace of the tasks that made them."""

    equations: NormalEquations
    trace: tuple[TraceRow, ...]


def image_task(host: EngineHost, task: BlockTask, seeds: tuple[int, int]) -> Residual:
    """Render a block twice, each time with half the samples, and subtract the reference."""
    start, block = time.time(), block_of(task)
    half = max(task.samples // 2, 1)
    stacks: list[StackEstimate] = [
        host.call("images", task.recipe, task.tissue, block.fitted_view, samples=half, seed=seed, batches=1)
        for seed in seeds
    ]
    first, second = (photographed(stack.mean, block, dict(task.errors)) - block.reference for stack in stacks)
    images = (stacks[0].mean, stacks[1].mean) if task.errors else None
    return Residual(first, second, trace_row("image", task, start), images)


def jacobian_task(
    host: EngineHost,
    task: BlockTask,
    differentiation: Differentiation,
    seeds: tuple[int, int],
    residual: Residual,
    near: Near | None,
) -> Products:
    """Render a block's derivatives with two seeds and multiply them by each other and by the residual."""
    start, block = time.time(), block_of(task)
    j1, j2 = differentiation.render(host, task, block.fitted_view, seeds, block.parts)
    if residual.images is not None:
        j1, j2 = (
            np.concatenate([own, error_derivatives(image, block, differentiation.errors)])
            for own, image in zip((j1, j2), residual.images, strict=True)
        )
    rendered, start = trace_row("jacobian", task, start), time.time()
    r1, r2, variance, weight = (
        a.reshape(-1) for a in (residual.first, residual.second, block.variance, block.fit_weight)
    )
    regions = None if near is None else _regions(block, near)
    equations = normal_equations(
        j1,
        j2,
        r1,
        r2,
        variance,
        weight,
        len(block.reference),
        regions,
        len(differentiation.errors),
        sum(kind_of_error(name) == "shift" for name in differentiation.errors),
        block.functions,
    )
    if differentiation.errors and block.motion is not None:
        equations = equations.without_noise(*slope_noise(block, differentiation.errors))
    none = np.zeros_like(r1)
    loss = loss_change(none, none, r1, r2, weight, len(block.reference), block.cell)
    equations = replace(equations, loss=loss.change, loss_variance=loss.variance)
    return Products(equations, (residual.trace, rendered, trace_row("products", task, start)))


def _regions(block: PixelBlock, near: Near) -> list[Region]:
    assert block.parts is not None
    lights = len(block.reference)
    return [(near[tooth], np.tile(block.parts.tooth == tooth, lights)) for tooth in np.unique(block.parts.tooth)]


def gradient_task(
    host: EngineHost, task: BlockTask, similar: Tissue, differentiation: Differentiation, seeds: tuple[int, int]
) -> tuple[Gradient, TraceRow]:
    """One block's stochastic gradient: residual from one seed, derivatives from another."""
    start, block = time.time(), block_of(task)
    stack: StackEstimate = host.call(
        "images", task.recipe, task.tissue, block.fitted_view, samples=task.samples, seed=seeds[0]
    )
    residual, weight = stack.mean - block.reference, block.fit_weight
    (rows,) = differentiation.render(host, replace(task, tissue=similar), block.fitted_view, seeds[1:], block.parts)
    loss = 0.5 * float((weight * (residual**2 - stack.variance)).sum())
    return Gradient(rows @ (weight * residual).reshape(-1), loss), trace_row("gradient", task, start)


def compare_task(
    host: EngineHost,
    task: BlockTask,
    new: Tissue | Mouth,
    seeds: tuple[int, int],
    by_cells: bool = True,
    new_errors: Errors | None = None,
) -> tuple[LossChange, TraceRow]:
    """Render a block at two points with the same two seeds and compare their losses, from the means of cells or pixel
    by pixel.

    Args:
        new: tissue at the second point.
        seeds: the two seeds.
        by_cells: whether cells' means are compared.
        new_errors: errors of the instrument at the second point; None for those of the task.
    """
    start, block = time.time(), read_block(task.block)

    def residuals(tissue: Tissue | Mouth, errors: Errors) -> tuple[Array, Array]:
        view = placed(block, dict(errors)).fitted_view
        stacks = [
            host.call("images", task.recipe, tissue, view, samples=task.samples, seed=seed, batches=1) for seed in seeds
        ]
        first, second = ((photographed(one.mean, block, dict(errors)) - block.reference).reshape(-1) for one in stacks)
        return first, second

    changed = task.errors if new_errors is None else new_errors
    given = *residuals(task.tissue, task.errors), *residuals(new, changed), block.fit_weight.reshape(-1)
    return loss_change(*given, len(block.reference), block.cell if by_cells else None), trace_row(
        "compare", task, start
    )


def orders_task(host: EngineHost, task: BlockTask, edges: NDArray[np.int64], seed: int) -> tuple[Array, TraceRow]:
    """Images (K, L, N) of a block at albedo 1, split by scattering order, with their trace."""
    start, block = time.time(), block_of(task)
    orders = host.call(
        "order_images", task.recipe, task.tissue, block.fitted_view, bin_edges=edges, samples=task.samples, seed=seed
    )
    return np.asarray(orders, dtype=np.float64), trace_row("orders", task, start)


@dataclass(frozen=True)
class Passes:
    """Blocks of one channel, and the executor of their tasks."""

    executor: Executor
    blocks: tuple[StoredFile, ...]
    recipe: StoredFile
    seeds: Seeds
    record: Callable[[Sequence[TraceRow]], None]
    """Receives the trace of finished tasks."""
    errors: Errors = ()
    """Present estimates of the instrument's errors, which are applied to renders before they are compared with
    photographs."""

    def run(self, label: str, tissue: Tissue | Mouth, samples: int, task: Callable[..., Any], *args: Any) -> list[Any]:
        """Run one task per block; results in block order."""
        return self.executor.gather(
            [self.executor.submit(f"{label}-{t.index}", task, t, *args) for t in self.tasks(label, tissue, samples)]
        )

    def read_blocks(self) -> list[PixelBlock]:
        """The blocks themselves, in order."""
        return [read_block(stored) for stored in self.blocks]

    def tasks(self, label: str, tissue: Tissue | Mouth, samples: int) -> list[BlockTask]:
        """Arguments of the blocks' tasks, in block order."""
        given = self.recipe, label, tissue, samples, self.errors
        return [BlockTask(block, k, *given) for k, block in enumerate(self.blocks)]


@dataclass(frozen=True)
class StackProblem(Generic[Optics]):
    """Least-squares problem of one stage (implements ``solve.gauss_newton.Problem`` and ``solve.adam.Problem``)."""

    passes: Passes
    domain: Domain
    base: Optics
    stage: str
    jacobian_g: float | None = None
    """Mean cosine of the similar media in which derivatives to sigma, alpha and shape are rendered; None for the media
    themselves."""
    image_g: float | None = None
    """Mean cosine of the similar media in which images are rendered; None for the media themselves."""
    neighbours: Neighbours | None = None
    """Neighbourhood of a jaw's teeth: it limits the coordinates between which the curvature's noise is stored, and
    selects those that are differentiated at once; None for a single tooth."""

    def linearise(self, x: Array, *, samples: int, step: int) -> NormalEquations:
        """See Problem: an image and a Jacobian task per block, summed in block order."""
        run, label = self.passes.executor, f"{self._prefix}-{step}"
        tissue, similar, differentiation = self.jacobian_media(x)
        seeds = self.seed(step, "jacobian-1"), self.seed(step, "jacobian-2")
        near = None if self.neighbours is None else self.neighbours.near(self.domain)
        pending = []
        for task in self.passes_at(x).tasks(label, tissue, samples):
            image = run.submit(
                f"{label}-image-{task.index}",
                image_task,
                task,
                (self.seed(step, "image-1"), self.seed(step, "image-2")),
            )
            pending.append(
                run.submit(
                    f"{label}-jacobian-{task.index}",
                    jacobian_task,
                    replace(task, tissue=similar),
                    differentiation,
                    seeds,
                    image,
                    near,
                )
            )
        products: list[Products] = run.gather(pending)
        self.passes.record([row for p in products for row in p.trace])
        total = products[0].equations
        for p in products[1:]:
            total = total + p.equations
        return total

    def gradient(self, x: Array, *, samples: int, step: int) -> Gradient:
        """See adam.Problem: one task per block, summed in block order."""
        tissue, similar, differentiation = self.jacobian_media(x)
        seeds = self.seed(step, "image"), self.seed(step, "jacobian")
        parts = self.passes.run(
            f"{self._prefix}-{step}", tissue, samples, gradient_task, similar, differentiation, seeds
        )
        self.passes.record([row for _, row in parts])
        total: Gradient = parts[0][0]
        for part, _ in parts[1:]:
            total = total + part
        return total

    def compare(self, x_old: Array, x_new: Array, *, samples: int, step: int, trial: int) -> LossChange:
        """See Problem: half the samples per seed, summed in block order."""
        label = f"{self._prefix}-{step}-trial-{trial}"
        old, new = self._image_media(x_old), self._image_media(x_new)
        seeds = self.seed(step, "compare-1", trial), self.seed(step, "compare-2", trial)
        given = new, seeds, True, self.domain.errors_at(x_new) or None
        parts = self.passes_at(x_old).run(label, old, max(samples // 2, 1), compare_task, *given)
        self.passes.record([row for _, row in parts])
        total: LossChange = parts[0][0]
        for change, _ in parts[1:]:
            total = total + change
        return total

    def passes_at(self, x: Array) -> Passes:
        """The passes with the instrument's errors of x (F,)."""
        return replace(self.passes, errors=self.domain.errors_at(x)) if self.domain.errors.names else self.passes

    def _image_media(self, x: Array) -> Optics:
        tissue = self.domain.tissue_at(x, self.base)
        return tissue if self.image_g is None else similar_tissue(tissue, self.image_g)

    def jacobian_media(self, x: Array) -> tuple[Optics, Optics, Differentiation]:
        """Media of the images, media of the derivatives, and the differentiation."""
        tissue = self.domain.tissue_at(x, self.base)
        similar = tissue if self.jacobian_g is None else similar_tissue(tissue, self.jacobian_g)
        return (
            self._image_media(x),
            similar,
            differentiation(self.domain, x, self.base, self.jacobian_g, self.neighbours),
        )

    def exact_differentiation(self, x: Array) -> Differentiation:
        """Differentiation of the images in their own media, without blend weights."""
        return exact_differentiation(self.domain, x, self.base, self.neighbours)

    @property
    def _prefix(self) -> str:
        return f"{self.passes.seeds.channel}-{self.stage}"

    def seed(self, step: int, *purpose: str | int) -> int:
        """Seed of a pass of this stage."""
        return self.passes.seeds(self.stage, step, *purpose)


def trace_row(kind: str, task: BlockTask, start_s: float) -> TraceRow:
    """Trace of a task that ends at this moment in this process."""
    return TraceRow(kind, task.step, task.index, f"{socket.gethostname()}:{os.getpid()}", start_s, time.time())
