"""Weights of the next round of a fit whose loss follows residuals: one render of all blocks, then the blocks written anew."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from services.core.records import Loss
from services.fit.blocks import StoredFile, write_block
from services.fit.journal import Journal
from services.fit.optics.parameters import Tissue
from services.fit.passes import Passes, Residual, image_task
from services.fit.solve.losses import weights


def reweighted(passes: Passes, journal: Journal, loss: Loss, tissue: Tissue, *, samples: int, stage: str) -> Passes:
    """The same passes over blocks with weights by the residuals of a tissue, from a seed that no other pass has."""
    key = f"{passes.seeds.channel}/{stage}/weights"

    def compute() -> list[tuple[str, str]]:
        seed = passes.seeds(stage, "weights")
        residuals: list[Residual] = passes.run(f"{passes.seeds.channel}-{stage}-weights", tissue, samples, image_task, seed)
        passes.record([r.trace for r in residuals])
        blocks = passes.read_blocks()

        # One set of weights over all blocks, because scale and floor are those of the whole channel.
        fitted = [block.fit_weight > 0 for block in blocks]
        columns = zip(*((b.reference[f], b.variance[f], r.residual[f], r.variance[f]) for b, r, f in zip(blocks, residuals, fitted, strict=True)), strict=True)
        found = weights(loss, *(np.concatenate(column) for column in columns))
        parts = np.split(found, np.cumsum([f.sum() for f in fitted])[:-1])
        files = []
        for block, chosen, part, old in zip(blocks, fitted, parts, passes.blocks, strict=True):
            weight = np.zeros_like(block.fit_weight)
            weight[chosen] = part
            file = write_block(old.path.parent, replace(block, fit_weight=weight))
            files.append((str(file.path), file.digest))
        return files

    files, _ = journal.once(key, compute)
    return replace(passes, blocks=tuple(StoredFile(Path(path), digest) for path, digest in files))
