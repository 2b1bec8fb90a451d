"""Weights of the next round for a loss whose weights depend on the residuals: render all blocks once, then write them
with new weights.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from services.core.files.content_files import StoredFile
from services.core.records import Loss
from services.fit.measurements.blocks import BlockTask, write_block
from services.fit.measurements.instrument.photographs import block_of, photographed
from services.fit.passes.passes import Passes, TraceRow, trace_row
from services.fit.solve.losses import weights
from services.tasks.engine_host import EngineHost
from services.tasks.journal import Journal
from services.transport.optics.parameters import Tissue
from services.transport.scene.recipe import StackEstimate


@dataclass(frozen=True)
class Residual:
    """Render minus reference of one block, and the render's variance, (L, N) each."""

    residual: NDArray[np.float64]
    variance: NDArray[np.float64]
    trace: TraceRow


def residual_task(host: EngineHost, task: BlockTask, seed: int) -> Residual:
    """Render a block and subtract the reference."""
    start, block = time.time(), block_of(task)
    stack: StackEstimate = host.call(
        "images", task.recipe, task.tissue, block.fitted_view, samples=task.samples, seed=seed
    )
    return Residual(
        photographed(stack.mean, block, dict(task.errors)) - block.reference,
        stack.variance,
        trace_row("weights", task, start),
    )


def reweighted(passes: Passes, journal: Journal, loss: Loss, tissue: Tissue, *, samples: int, stage: str) -> Passes:
    """The passes over blocks with new weights, which follow from the residuals of a tissue with a seed that no other
    pass uses.
    """
    key = f"{passes.seeds.channel}/{stage}/weights"

    def compute() -> list[tuple[str, str]]:
        seed = passes.seeds(stage, "weights")
        residuals: list[Residual] = passes.run(
            f"{passes.seeds.channel}-{stage}-weights", tissue, samples, residual_task, seed
        )
        passes.record([r.trace for r in residuals])
        blocks = passes.read_blocks()

        # Compute one set of weights over all blocks, because scale and floor are those of the whole channel.
        fitted = [block.fit_weight > 0 for block in blocks]
        columns = zip(
            *(
                (b.reference[f], b.variance[f], r.residual[f], r.variance[f])
                for b, r, f in zip(blocks, residuals, fitted, strict=True)
            ),
            strict=True,
        )
        found = weights(loss, *(np.concatenate(column) for column in columns))
        parts = np.split(found, np.cumsum([f.sum() for f in fitted])[:-1])
        files = []
        for block, chosen, part, old in zip(blocks, fitted, parts, passes.blocks, strict=True):
            weight = np.zeros_like(block.fit_weight)
            weight[chosen] = part
            file = write_block(old.path.parent, replace(block, fit_weight=weight))
            files.append((file.path.name, file.digest))
        return files

    files, _ = journal.get_or_compute(key, compute)
    folder = passes.blocks[0].path.parent
    return replace(passes, blocks=tuple(StoredFile(folder / name, digest) for name, digest in files))
