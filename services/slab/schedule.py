"""Distribution of a slab's work: whole wavelengths on a worker each, or the blocks of paths of one wavelength on all
workers.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from services.core.slab.folder import SlabFolder, read_folder
from services.core.stage import raise_if
from services.slab.cell.dictionary import KNOTS
from services.slab.cell.forward import Blocks, BlockSums, PathBlock
from services.slab.dictionaries.chosen import dictionary_of
from services.slab.fit import fit_images
from services.slab.options import SlabOptions
from services.slab.read.images import read_images
from services.slab.results.stored import FIT, fingerprint, open_journal, store_result
from services.slab.solve.checkpoint import Checkpoint, Checkpoints
from services.slab.solve.normal import Each
from services.tasks.executors import Executor
from services.tasks.journal import Journal

MAX_TRAVELLING_BYTES = 32 * 2**20
"""Largest size of the sums that a task may send to another worker: their paths take seconds, in which any network
between workers carries ten times that. Where one block's are larger, they stay on their worker."""

TASKS_PER_THREAD = 4
"""Number of tasks into which a render's blocks are divided, per thread of the workers: each task costs some
milliseconds, and several per thread keep all threads busy until the end."""


def unguarded() -> None:
    """Let every write pass."""


@dataclass(frozen=True)
class WavelengthTask:
    """The fit of one wavelength of a job."""

    root: Path
    wavelength_nm: float
    options: SlabOptions
    place: Path
    """Folder in which the result is stored."""
    flag: Path
    """File whose existence means that the job is cancelled."""
    guard: Callable[[], None] = unguarded
    """Called before every write; raises when this attempt has lost the right to write."""

    def journal(self) -> Journal:
        """The wavelength's journal, continued where an earlier attempt stopped."""
        return open_journal(self.place, fingerprint(self.root, self.wavelength_nm, self.options), self.guard)


CheckpointCallback = Callable[[float, Checkpoint], None]
"""Callback that takes a wavelength in nm and the state of its fit."""


def run_wavelengths(
    run_on: Executor, tasks: Sequence[WavelengthTask], workers: int, on_checkpoint: CheckpointCallback = lambda *_: None
) -> Iterator[Path]:
    """Fit the wavelengths that no earlier attempt has fitted; gives the folder of each as soon as it is done.

    First as many wavelengths as are a multiple of the workers run, each whole on one of them. Those that are left run
    one after the other here, and their blocks on all workers. A block's sums depend on its description alone and are
    added in the order of the blocks, so the answer is the same to the last digit.

    Args:
        workers: number of workers that the job asked for; some may still be starting.
        on_checkpoint: called before each of the last steps of a wavelength whose blocks run on all workers.

    Raises:
        JobCancelledError: between two blocks of paths.
    """
    block_bytes = max((_block_bytes(read_folder(task.root)) for task in tasks), default=0)
    threads = run_on.threads(workers)
    shared = 0 if block_bytes > MAX_TRAVELLING_BYTES else len(tasks) % threads
    whole = tasks[: len(tasks) - shared]
    yield from run_on.as_completed([(f"{task.wavelength_nm:g}", wavelength_task, (task,)) for task in whole])
    # While this process computes with the workers' sums, they wait, and it may use as many threads as they have.
    with ThreadPoolExecutor(min(threads, os.cpu_count() or 1)) as pool:
        for task in tasks[len(whole) :]:
            on_step = partial(on_checkpoint, task.wavelength_nm)
            yield fit_wavelength(task, _spread(run_on, task, block_bytes), on_step, pool.map)


def wavelength_task(_host: Any, task: WavelengthTask) -> Path:
    """Fit a whole wavelength, one block after the other."""

    def blocks(trace: Callable[[PathBlock], BlockSums], some: Sequence[PathBlock]) -> Iterator[BlockSums]:
        for block in some:
            raise_if(task.flag.exists)
            yield trace(block)

    return fit_wavelength(task, blocks)


def blocks_task(
    _host: Any, trace: Callable[[PathBlock], BlockSums], blocks: Sequence[PathBlock], flag: Path
) -> list[BlockSums]:
    """Trace some blocks of paths, one after the other."""
    sums = []
    for block in blocks:
        raise_if(flag.exists)
        sums.append(trace(block))
    return sums


def fit_wavelength(
    task: WavelengthTask,
    blocks: Blocks,
    on_checkpoint: Callable[[Checkpoint], None] = lambda _: None,
    each: Each = map,
) -> Path:
    """Fit one wavelength into its folder, unless an earlier attempt has; a fit that was cut short continues before the
    last step that it saved.
    """
    journal = task.journal()
    if FIT not in journal.entries:
        folder = read_folder(task.root)
        measured = read_images(task.root, folder, task.wavelength_nm)
        dictionary = dictionary_of(task.root, folder, task.wavelength_nm, task.options)
        checkpoints = Checkpoints(journal, on_checkpoint)
        fit = fit_images(folder, task.wavelength_nm, measured, task.options, blocks, dictionary, checkpoints, each)
        store_result(journal, fit)
    return task.place


def _spread(run_on: Executor, task: WavelengthTask, block_bytes: int) -> Blocks:
    """A function that runs blocks on all workers and gives their sums in the order of the blocks."""
    numbers = itertools.count()

    def blocks(trace: Callable[[PathBlock], BlockSums], some: Sequence[PathBlock]) -> list[BlockSums]:
        raise_if(task.flag.exists)
        name = f"{task.wavelength_nm:g}-{next(numbers)}"
        size = max(1, min(len(some) // (TASKS_PER_THREAD * run_on.threads()), MAX_TRAVELLING_BYTES // block_bytes))
        pending = [
            run_on.submit(f"{name}-{first}", blocks_task, trace, some[first : first + size], task.flag)
            for first in range(0, len(some), size)
        ]
        return list(itertools.chain.from_iterable(run_on.gather(pending)))

    return blocks


def _block_bytes(folder: SlabFolder) -> int:
    """Largest size of a block's sums."""
    return len(folder.cameras) * folder.pixels.columns * folder.pixels.rows * (8 + 4 * (KNOTS + 1))
