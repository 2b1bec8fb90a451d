"""The runs of a race of tooth fits, as records stored after every round, so that a race goes on after a kill."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from services.bench.fits.race import MAX_KNOWN_SHARE, Measured
from services.bench.fits.stock_fit import StockFit, StockRecipe
from services.bench.fits.tooth_capture import PreparedTooth, tissue_of
from services.core.errors import InputError
from services.core.geometry import Record
from services.core.stage import LocalContext, StageEvent
from services.core.store import read_record, write_record
from services.transport.numerics import NUMERICS
from services.transport.optics.parameters import MEDIUM_FIELDS, Tissue

OURS = "dentine"
FIRST_SAMPLES = 64
"""Paths per pixel of the first two renders that measure an iterate's images."""
SAMPLES_GROWTH = 4
"""Factor by which they grow until enough is known; the renders before then cost a third of the last one."""
MARK_GROWTH = 1.5
"""Ratio of the times of two successive iterates whose images are compared."""


MEDIA_NAMES = tuple(f"{part}.{leaf}" for part in ("enamel", "dentin") for leaf in MEDIUM_FIELDS)


class Point(Record):
    """An iterate of a solver."""

    seconds: float
    """Processor time of the solver so far."""
    stage: str
    media: dict[str, float]
    """Parameters of both media, ``enamel.sigma`` and so on."""

    @property
    def tissue(self) -> Tissue:
        """The media."""
        return tissue_of(self.media)


class ImageErrors(Record):
    """Relative errors of the images of an iterate."""

    point: int
    """Index of the iterate."""
    held_out: float
    held_out_se: float
    """Standard error by the noise of both renders and of the photographs."""
    fitted: float
    samples: int
    """Paths per pixel of each of the two renders that it took."""


class Run(Record):
    """A solver's run so far."""

    peer: str
    rate: float | None = None
    """Learning rate of Adam; None for this project's fit."""
    points: tuple[Point, ...] = ()
    is_finished: bool = False
    has_ended: bool = False
    """Whether the solver ended by itself; False where its time was up."""
    solver: dict[str, Any] | None = None
    """State from which the peer goes on; None for this project's fit."""
    images: tuple[ImageErrors, ...] = ()
    """Errors of the images of some iterates."""

    @property
    def name(self) -> str:
        """Name of the run, and of the file of its state."""
        return self.peer if self.rate is None else f"{self.peer}-{self.rate:g}"


class Settings(Record):
    """What stored runs depend on: how large a race is, and the version of the numbers."""

    pixel_step: int
    """Edge of the squares of pixels that are fitted."""
    rates: tuple[float, ...]
    """Learning rates of Adam in the unbounded domain."""
    limit_s: float
    """Processor time of each peer's run."""
    max_samples: int
    """Most paths per pixel of each of the two renders that compare an iterate's images."""
    floor_samples: int
    """Paths per pixel of each Jacobian of the photographs' floor."""
    numerics: int = NUMERICS
    """Version of this project's numbers, so that no run goes on under another one."""


class FloorRecord(Record):
    """Floor of the photographs and its standard error, by quantity."""

    floor: dict[str, float]
    se: dict[str, float]


@dataclass(frozen=True)
class RaceState:
    """Folder with the state of a race, one file a run."""

    folder: Path

    def open(self, settings: Settings) -> None:
        """Make the folder, or take it where it holds the same race.

        Raises:
            InputError: it holds the state of another race.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        file = self.folder / "settings.json"
        if file.is_file() and read_record(file, Settings) != settings:
            raise InputError(
                f"{self.folder} holds the state of another race or version; delete it, or name another --json file."
            )
        write_record(file, settings)

    def stored(self, fresh: Run) -> Run:
        """The stored run of this name, or the given one where there is none."""
        file = self._file(fresh)
        if not file.is_file():
            return fresh
        print(f"{fresh.name} goes on from {file}; delete its folder to run the race anew.", file=sys.stderr)
        return read_record(file, Run)

    def keep(self, run: Run) -> Run:
        """Store a run, and return it."""
        write_record(self._file(run), run)
        return run

    def floor(self, measure: Callable[[], tuple[dict[str, float], dict[str, float]]]) -> FloorRecord:
        """The stored floor, or the measured one."""
        file = self.folder / "floor.json"
        if file.is_file():
            return read_record(file, FloorRecord)
        found, se = measure()
        record = FloorRecord(floor=found, se=se)
        write_record(file, record)
        return record

    def _file(self, run: Run) -> Path:
        return self.folder / f"run-{run.name}.json"


def our_run(case: PreparedTooth, folder: Path, state: RaceState) -> Run:
    """Run this project's own fit stage in this process, with a point after every step of its solver and at its end. A
    run that was interrupted begins anew.
    """
    run = state.stored(Run(peer=OURS))
    if run.is_finished:
        return run
    from services.core.store import StageWriter
    from services.fit.stage import ENGINE
    from services.fit.stages.attempt import Attempt
    from services.fit.stages.tooth.driver import FitDriver

    points: list[Point] = []

    def add(stage: str, values: dict[str, float]) -> None:
        points.append(Point(seconds=time.process_time() - started, stage=stage, media=media_of(tissue_of(values))))

    def listen(event: StageEvent) -> None:
        if event.kind == "step":
            add(event.data["stage"], event.data["parameters"])

    folder.mkdir()
    (folder / "prepared").symlink_to(case.job / "prepared")
    started = time.process_time()
    context = LocalContext(folder, listener=listen)
    report = FitDriver(Attempt(case.spec, context, StageWriter(folder, "fit", 1), ENGINE)).run(time.time())
    add("final", {name: estimate.value for name, estimate in report.parameters["green"].items()})
    return state.keep(run.model_copy(update={"points": tuple(points), "is_finished": True, "has_ended": True}))


def peer_run(
    case: PreparedTooth, folder: Path, state: RaceState, recipe: StockRecipe, rate: float, limit_s: float
) -> Run:
    """Run a peer until its time is up, with a point after every round; a run that was interrupted goes on from its last
    round.
    """
    run = state.stored(Run(peer=recipe.name, rate=rate))
    if run.is_finished:
        return run
    fit = StockFit(case, folder, rate, recipe, run.solver)
    while not run.is_finished:
        fit.step()
        point = Point(seconds=fit.seconds, stage=f"round {fit.rounds}", media=media_of(fit.tissue()))
        is_finished = fit.seconds >= limit_s
        more = {"points": (*run.points, point), "solver": fit.state, "is_finished": is_finished}
        run = state.keep(run.model_copy(update=more))
    return run


def media_of(tissue: Tissue) -> dict[str, float]:
    """Parameters of both media by name."""
    return {name: tissue.value(name) for name in MEDIA_NAMES}


def logged(run: Run) -> tuple[int, ...]:
    """Indices of the handful of iterates whose images are compared: the last one and, back in time from it, those that
    are earlier by ``MARK_GROWTH``, so that the end of a run, where levels are kept, is seen in most detail.
    """
    chosen = [len(run.points) - 1]
    for k in reversed(range(len(run.points) - 1)):
        if run.points[k].seconds * MARK_GROWTH <= run.points[chosen[-1]].seconds:
            chosen.append(k)
    return tuple(reversed(chosen))


def is_known(measured: Measured, levels: Sequence[float]) -> bool:
    """Whether an error is known well enough to be held to the levels: on which side of each it lies, and to a third of
    itself or of the smallest level.
    """
    sides = all(measured.is_above(level) or measured.is_below(level) for level in levels)
    return sides and measured.se <= MAX_KNOWN_SHARE * max(measured.error, *levels)


def image_errors(case: PreparedTooth, run: Run, point: int, levels: Sequence[float], max_samples: int) -> ImageErrors:
    """Compare the images of an iterate with the photographs, with more and more paths until its error is known."""
    samples = FIRST_SAMPLES
    while True:
        fitted, held_out = case.errors(run.points[point].tissue, samples=samples, seed=11)
        error = held_out.resolved_error or 0.0
        # The photographs' noise changes the squared error by the square of what they resolve.
        by_photographs = case.resolution() ** 2 / (2 * max(error, case.resolution()))
        se = math.hypot(held_out.error_se or 0.0, by_photographs)
        if is_known(Measured(0.0, error, se), levels) or SAMPLES_GROWTH * samples > max_samples:
            return ImageErrors(
                point=point, held_out=error, held_out_se=se, fitted=fitted.resolved_error or 0.0, samples=samples
            )
        samples *= SAMPLES_GROWTH


def with_images(case: PreparedTooth, run: Run, state: RaceState, levels: Sequence[float], max_samples: int) -> Run:
    """Return a finished run with the errors of the images of its logged iterates, of which some may be stored."""
    for point in logged(run):
        if all(known.point != point for known in run.images):
            errors = image_errors(case, run, point, levels, max_samples)
            run = state.keep(run.model_copy(update={"images": (*run.images, errors)}))
    return run
