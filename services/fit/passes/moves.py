"""Changes of images by rigid moves of dome and scan, as tasks."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.files.content_files import StoredFile
from services.core.geometry import Camera
from services.fit.measurements.blocks import BlockTask
from services.fit.measurements.instrument.moves import DIFFERENCE_WIDTH, Move
from services.fit.measurements.instrument.photographs import block_of
from services.fit.passes.passes import TraceRow, trace_row
from services.tasks.engine_host import EngineHost
from services.transport.optics.parameters import Mouth, Tissue
from services.transport.scene.recipe import View

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Changes:
    """Changes (K, 2, L, N) of a block's images, by change and seed, and the trace of the task that rendered them."""

    values: NDArray[np.float32]
    trace: TraceRow


def by_scene(moves: Sequence[Move]) -> tuple[tuple[Move, ...], ...]:
    """Moves grouped by their scene, in order."""
    scenes = dict.fromkeys(move.recipe.digest for move in moves)
    return tuple(tuple(move for move in moves if move.recipe.digest == digest) for digest in scenes)


def moves_task(
    host: EngineHost, task: BlockTask, tissue: Tissue | Mouth, moves: tuple[Move, ...], seeds: tuple[int, int]
) -> Changes:
    """Changes of a block's images by the moves of one scene, of one standard deviation each: (K, 2, L, N) by move and
    seed.
    """
    start, block = time.time(), block_of(task)
    view, count = block.fitted_view, len(block.reference)
    lit = view.lights if view.lights is not None else tuple(range(count))

    def image(recipe: StoredFile, camera: Camera, first: int, seed: int) -> Array:
        chosen = View(camera, view.pixels, tuple(first + light for light in lit))
        stack = host.call("images", recipe, tissue, chosen, samples=task.samples, seed=seed, batches=1)
        return np.asarray(stack.mean[first : first + count], dtype=np.float64)

    base = [image(moves[0].recipe, view.camera, 0, seed) for seed in seeds]
    changes = [
        [
            image(move.recipe, move.moved_camera(view.camera), move.first, seed) - unmoved
            for seed, unmoved in zip(seeds, base, strict=True)
        ]
        for move in moves
    ]
    return Changes((np.array(changes) / DIFFERENCE_WIDTH).astype(np.float32), trace_row("moves", task, start))
