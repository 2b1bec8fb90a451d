"""Whole preparations: growth of the time with the number of images, gain by a second worker, and gain by preparing only
the tooth's region.

Every preparation runs the stage itself, from a published capture to a published store, in processes of its own.
Seconds are of processor time, which other work on the machine changes little. The gain by a second worker appears only
in seconds by the clock, so it must be measured on an idle machine.
"""

from __future__ import annotations

import multiprocessing
import resource
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from services.bench.preparation.scene import SHARE_OF_HEIGHT, make_scene
from services.core.errors import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SIZES = {True: (1280, 960), False: (5120, 3840)}
"""Width and height by ``quick``."""
LIGHTS = 54
"""Number of images of one slice, as many as one camera of the rig takes. Capture and store of a slice take 15 GB of
disk."""
SLICES = 3
"""Number of slices, as many as the rig has cameras."""
FEWER = (6, 18)
"""Numbers of images of the two smaller captures."""
SHARES = (0.2, SHARE_OF_HEIGHT, 1.5)
"""Ratios of the tooth's height to the image's; at 1.5 the tooth fills the image, so that no region is left out."""
TURNS = 2
"""Number of runs with each number of workers."""
Row = dict[str, Any]
Keep = Callable[[list[Row]], object]


def run(quick: bool = False, case: str = "images", keep: Keep = lambda _rows: None) -> list[Row]:
    """Return the rows of one case.

    Args:
        quick: take small images.
        case: ``images``: 6 and 18 images, then three slices of 54, together 162. ``workers``: 18 images by one and by
            two workers, and two captures at once by one worker each, alternately. ``region``: 6 images of teeth of
            several sizes.
        keep: called with all rows so far after every new one.

    Raises:
        InputError: the case is unknown.
    """
    cases = {"images": _images, "workers": _workers, "region": _region}
    if case not in cases:
        raise InputError(f"Case {case} does not exist; known are {', '.join(cases)}.")
    rows: list[Row] = []
    for row in cases[case](SIZES[quick]):
        rows.append(row)
        keep(rows)
    return rows


def picture(rows: list[Row]) -> Figure:
    """Draw the seconds of each row: processor time where it was measured, else time by the clock."""
    from services.bench.plots import grid

    figure, (axes,) = grid(1)
    axes.plot([row["seconds"] if "seconds" in row else row["clock_s"] for row in rows], "o")
    varied = ("captures", "workers", "tooth_by_height")
    names = [", ".join(f"{row[key]:g} {key}" for key in ("images", *varied) if key in row) for row in rows]
    axes.set_xticks(range(len(rows)), names, rotation=30, ha="right", fontsize=8)
    axes.set(ylabel="s", ylim=(0, None))
    axes.grid(alpha=0.25)
    return figure


def _images(size: tuple[int, int]) -> Iterator[Row]:
    """Yield a row for each capture, of which each slice is another one; the last row sums up all slices."""
    slices = []
    for number, lights in enumerate((*FEWER, *[LIGHTS] * SLICES)):
        with _captured(size, lights, seed=number + 1) as root:
            row = _row(lights, *_prepared_apart(root))
        slices.append(row)
        yield row
    whole = slices[len(FEWER) :]
    seconds, peak_gib = sum(row["seconds"] for row in whole), max(row["peak_gib"] for row in whole)
    yield _row(LIGHTS * SLICES, seconds, peak_gib) | {"clock_s": sum(row["clock_s"] for row in whole)}


def _workers(size: tuple[int, int]) -> Iterator[Row]:
    """Yield a row for each run. Two captures at once by one worker each wait for nothing of each other, so they show
    what a second processor of this machine brings at most.
    """
    with _captured(size, FEWER[1]) as root, _captured(size, FEWER[1], seed=2) as other:
        for _ in range(TURNS):
            for workers in (1, 2):
                yield {"images": FEWER[1], "captures": 1, "workers": workers, "clock_s": _prepared_on(root, workers)}
            with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as apart:
                seconds = max(apart.map(_prepared_on, (root, other), (1, 1)))
            yield {"images": 2 * FEWER[1], "captures": 2, "workers": 2, "clock_s": seconds}


def _region(size: tuple[int, int]) -> Iterator[Row]:
    for share in SHARES:
        with _captured(size, FEWER[0], share=share) as root:
            yield {"tooth_by_height": share, **_row(FEWER[0], *_prepared_apart(root))}


def _row(images: int, seconds: float, peak_gib: float, clock_s: float = 0.0) -> Row:
    return {
        "images": images,
        "seconds": seconds,
        "seconds_per_image": seconds / images,
        "peak_gib": peak_gib,
        "clock_s": clock_s,
    }


@contextmanager
def _captured(size: tuple[int, int], lights: int, seed: int = 1, share: float = SHARE_OF_HEIGHT) -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        make_scene(Path(folder), size, lights, seed=seed, share=share)
        yield Path(folder)


def _prepared_apart(root: Path) -> tuple[float, float, float]:
    """Return processor seconds, peak memory in GiB and clock seconds of a preparation in a process of its own."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as apart:
        return apart.submit(_prepare, root).result()


def _prepare(root: Path) -> tuple[float, float, float]:
    import cv2

    from services.core.records import JobSpec
    from services.core.stage import LocalContext
    from services.preprocess import stage

    cv2.setNumThreads(1)
    stage.check()
    began_s, clock_s = time.process_time(), time.monotonic()
    stage.run(JobSpec(capture=root), LocalContext(root))
    seconds, clock_s = time.process_time() - began_s, time.monotonic() - clock_s
    return seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, clock_s


def _prepared_on(root: Path, workers: int) -> float:
    """Return the seconds by the clock of a preparation as a task of a cluster whose workers have imported all modules
    before.
    """
    import dask
    from distributed import Client, LocalCluster

    from services.core.placement import STAGES, UNLIMITED
    from services.core.records import JobSpec
    from services.core.stage import LocalContext
    from services.pipeline.dask_config import DASK_CONFIG
    from services.preprocess import stage

    shutil.rmtree(root / "prepared", ignore_errors=True)
    with (
        dask.config.set(DASK_CONFIG),
        LocalCluster(
            n_workers=workers, threads_per_worker=1, dashboard_address=None, resources={STAGES: UNLIMITED}
        ) as cluster,
        Client(cluster) as client,
    ):
        client.run(stage.check)
        began_s = time.monotonic()
        client.submit(stage.run, JobSpec(capture=root), LocalContext(root), resources={STAGES: 1}).result()
        return time.monotonic() - began_s
