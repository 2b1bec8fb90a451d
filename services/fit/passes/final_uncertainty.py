"""The final uncertainty estimate of a fit whose Jacobians came from similar media (see ``solve.final_uncertainty``):
one task per block, on any worker.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.files.content_files import StoredFile
from services.fit.coordinates.domain import Domain, similar_medium, to_natural
from services.fit.measurements.blocks import BlockTask
from services.fit.measurements.instrument.moves import Move
from services.fit.measurements.instrument.photographs import block_of, error_derivatives, photographed
from services.fit.passes.derivatives import Differentiation
from services.fit.passes.moves import Changes, by_scene, moves_task
from services.fit.passes.passes import StackProblem, TraceRow, trace_row
from services.fit.solve.final_uncertainty import FinalSums, final_sums
from services.tasks.engine_host import EngineHost
from services.transport.optics.parameters import MEDIUM_FIELDS, Mouth, Optics, Tissue

Array = NDArray[np.float64]
HeldCosines = Mapping[tuple[str, ...], tuple[float, float]]
"""Media whose mean cosine was held, and the mean and standard deviation of its prior in the unbounded domain; the error
of one entry's media is common to them."""
HeldShapes = Sequence[tuple[dict[str, float], dict[str, float]]]
"""Blend weights by name at both ends of each independent error of a held shape, one standard deviation on either
side."""

MOVE_DIVISOR = 4
"""Divisor of the paths for images of displaced dentin and of moved scans and domes, because there are many."""
SHIFT_DIVISOR = 2
"""Divisor of the paths for images of changed media, because they enter a variance only and not the solution."""


@dataclass(frozen=True)
class DisplacedScene:
    """Scene whose dentin has further blend modes after those of the fit: displacements of one standard deviation that
    no fitted shape can make, outwards, and then the same inwards, because weights of modes are positive.
    """

    recipe: StoredFile
    count: int
    """Number of the displacements, without their opposites."""


def measure_final_uncertainty(
    problem: StackProblem[Optics],
    x: Array,
    whiten: Array,
    held: HeldCosines,
    samples: int,
    moves: Sequence[Move] = (),
    shapes: HeldShapes = (),
    displaced: DisplacedScene | None = None,
) -> FinalSums:
    """Closing sums of all blocks at x (F,), added in block order.

    Args:
        problem: the stage's least-squares problem.
        x: the solution (F,).
        whiten: T (F, F), x = T y.
        held: held mean cosines; each entry costs four images.
        samples: paths per pixel and seed.
        moves: moves of scan and dome; each costs two images, and their changes come last in the sums.
        shapes: held shapes of the dentin; each costs four images, and their changes follow those of ``held``.
        displaced: displacements of the dentin; each costs four images, and their changes follow those of ``shapes``.
    """
    run, label = problem.passes.executor, f"{problem.passes.seeds.channel}-{problem.stage}-closing"
    tissue, similar, differentiation = problem.jacobian_media(x)
    first, second = (tuple(problem.seed(0, f"closing-{name}-{k}") for k in (1, 2)) for name in ("similar", "exact"))
    images = problem.seed(0, "closing-image-1"), problem.seed(0, "closing-image-2")
    slopes, copied = problem.exact_differentiation(x), _copied_rows(problem.domain)
    ends = tuple(
        (_with_cosine(tissue, parts, mean - sd), _with_cosine(tissue, parts, mean + sd))
        for parts, (mean, sd) in held.items()
    ) + tuple((tissue.with_values(low), tissue.with_values(high)) for low, high in shapes)
    tasks = problem.passes_at(x).tasks(label, tissue, samples)
    few = [replace(task, samples=max(task.samples // MOVE_DIVISOR, 1)) for task in tasks]
    changes = _changes_by_scene(problem, few, displaced, moves, label)
    common = (similar, differentiation, first, whiten, slopes, copied, second, images, ends)
    pending = [
        run.submit(f"{label}-{task.index}", final_task, task, *common, *own)
        for task, own in zip(tasks, changes, strict=True)
    ]
    parts: list[tuple[FinalSums, tuple[TraceRow, ...]]] = run.gather(pending)
    problem.passes.record([row for _, rows in parts for row in rows])
    total = parts[0][0]
    for sums, _ in parts[1:]:
        total = total + sums
    return total


def _changes_by_scene(
    problem: StackProblem[Optics],
    tasks: Sequence[BlockTask],
    displaced: DisplacedScene | None,
    moves: Sequence[Move],
    label: str,
) -> list[list[Any]]:
    # Results by block and scene, of ``displacements_task`` and then of ``moves_task``. All blocks of one scene come
    # before the next scene, because a worker keeps few scenes.
    scenes: list[tuple[str, Callable[..., Any], Any]] = [("moves", moves_task, scene) for scene in by_scene(moves)]
    if displaced is not None:
        scenes.insert(0, ("displacements", displacements_task, displaced))
    results = []
    for number, (name, task, scene) in enumerate(scenes):
        seeds = problem.seed(0, f"closing-{name}-1"), problem.seed(0, f"closing-{name}-2")
        results.append(
            [
                problem.passes.executor.submit(
                    f"{label}-{name}-{number}-{one.index}", task, one, one.tissue, scene, seeds
                )
                for one in tasks
            ]
        )
    return [[of_scene[k] for of_scene in results] for k in range(len(tasks))]


def displacements_task(
    host: EngineHost, task: BlockTask, tissue: Tissue, scene: DisplacedScene, seeds: tuple[int, int]
) -> Changes:
    """Changes of a block's images by the displacements of a scene's dentin: (K, 2, L, N) by displacement and seed."""
    start, view = time.time(), block_of(task).fitted_view

    def images(mode: int) -> Array:
        weights = np.zeros(2 * scene.count)
        weights[mode] = 1.0
        moved = replace(tissue, shape=(*tissue.shape, *weights.tolist()))
        stacks = [
            host.call("images", scene.recipe, moved, view, samples=task.samples, seed=seed, batches=1) for seed in seeds
        ]
        return np.stack([np.asarray(stack.mean, dtype=np.float64) for stack in stacks])

    changes = [0.5 * (images(k) - images(scene.count + k)) for k in range(scene.count)]
    return Changes(np.array(changes).astype(np.float32), trace_row("displacements", task, start))


def final_task(
    host: EngineHost,
    task: BlockTask,
    similar: Tissue | Mouth,
    differentiation: Differentiation,
    similar_seeds: tuple[int, int],
    whiten: Array,
    slopes: Differentiation,
    copied: NDArray[np.bool_],
    seeds: tuple[int, int],
    image_seeds: tuple[int, int],
    ends: tuple[tuple[Tissue | Mouth, Tissue | Mouth], ...],
    *changes: Changes,
) -> tuple[FinalSums, tuple[TraceRow, ...]]:
    """One block's closing sums and trace, with the changes by the displacements or moves of each scene.

    Rows of ``slopes`` that are ``copied`` are taken from the similar media's Jacobian.
    """
    start, block = time.time(), block_of(task)
    view, errors = block.fitted_view, dict(task.errors)

    def image(tissue: Tissue | Mouth, seed: int, samples: int) -> Array:
        return np.asarray(
            host.call("images", task.recipe, tissue, view, samples=samples, seed=seed, batches=1).mean, dtype=np.float64
        ).reshape(-1)

    renders = [image(task.tissue, seed, task.samples) for seed in image_seeds]
    few = max(task.samples // SHIFT_DIVISOR, 1)
    size = renders[0].size
    moved = [[0.5 * (image(high, seed, few) - image(low, seed, few)) for seed in image_seeds] for low, high in ends]

    error_rows = [error_derivatives(render.reshape(block.reference.shape), block, slopes.errors) for render in renders]

    def derivatives(of: Differentiation, of_task: BlockTask, pair: tuple[int, int]) -> list[Array]:
        rows = of.render(host, of_task, view, pair, block.parts)
        return [np.concatenate([own, more]) for own, more in zip(rows, error_rows, strict=True)]

    def residual(render: Array) -> Array:
        return (photographed(render.reshape(block.reference.shape), block, errors) - block.reference).reshape(-1)

    similar_rows = derivatives(differentiation, replace(task, tissue=similar), similar_seeds)
    exact = similar_rows if copied.all() else derivatives(slopes, task, seeds)
    sums = final_sums(
        whiten,
        (similar_rows[0], similar_rows[1]),
        (exact[0], exact[1]),
        copied,
        (residual(renders[0]), residual(renders[1])),
        np.concatenate(
            [np.array(moved).reshape(len(ends), 2, size), *(one.values.reshape(-1, 2, size) for one in changes)]
        ),
        block.fit_weight.reshape(-1),
        len(block.reference),
        len(slopes.errors),
        block.functions,
    )
    return sums, (*(one.trace for one in changes), trace_row("closing", task, start))


def _copied_rows(domain: Domain) -> NDArray[np.bool_]:
    # Mask (F,) of derivatives copied from the similar media: those of the dentin's shape, which are not rendered again,
    # and those of the instrument's errors.
    shapes = [coordinate.kind == "shape" for coordinate in domain.coordinates]
    return np.array(shapes + [True] * len(domain.errors.names))


def _with_cosine(tissue: Optics, parts: tuple[str, ...], dual: float) -> Optics:
    media = {part: similar_medium(tissue.medium(part), to_natural("g1", dual)) for part in parts}
    return tissue.with_values(
        {f"{part}.{leaf}": float(getattr(medium, leaf)) for part, medium in media.items() for leaf in MEDIUM_FIELDS}
    )
