"""Race of tooth fits: errors of parameters and of held-out images against processor time, for this fit, for stock
``prbvolpath`` with Adam and for the recipe of teeth 2018 (``stock_fit``), on the smallest real case.

All fit the same noisy photographs, which stock Mitsuba rendered, under five lights, from no knowledge to parameters of
enamel and dentin. Each runs in this process on one thread, and seconds are its processor time, which other jobs on the
machine change little. Loading scenes and compiling kernels counts. A peer may run at several learning rates, each for
the whole time, and every level counts the fastest one. Errors of parameters follow from each iterate and the truth.
Images of a few iterates are compared afterwards, which does not count as time, with exact media and with as many paths
as it takes to tell on which side of each level they are. ``race`` has the rules by which a level counts as reached.

With a folder for its state the race goes on after it was killed: a peer from its last round, this fit anew.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from services.bench.fits.race_floor import HELD_OUT, floor
from services.bench.fits.race_rows import LEVELS, level_rows, point_rows, sentences, table
from services.bench.fits.race_runs import RaceState, Run, Settings, our_run, peer_run, with_images
from services.bench.fits.stock_fit import TEETH_2018, TUTORIAL
from services.bench.fits.tooth_capture import smallest_case
from services.transport.platform import prepare_device

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PEERS = (TUTORIAL, TEETH_2018)
FULL = Settings(pixel_step=1, rates=(0.05,), limit_s=450.0, max_samples=1024, floor_samples=512)
"""The rate was the best of 0.02, 0.05 and 0.15 on this tooth in trials of 300 s each, with mean cosines held."""
QUICK = Settings(pixel_step=3, rates=(0.05,), limit_s=40.0, max_samples=256, floor_samples=512)
FLOOR_SEED = 31

Case = Literal["race", "scale"]
Keep = Callable[[list[dict[str, Any]]], None]


def run(
    *, quick: bool, case: Case = "race", keep: Keep = lambda _: None, state: Path | None = None
) -> list[dict[str, Any]]:
    """Return a row for each iterate, each level and each floor.

    Args:
        quick: take fewer pixels, less time and fewer paths.
        case: ``scale`` measures a full-resolution tooth on one and on two workers instead.
        keep: called with all rows so far after every finished run.
        state: folder from which a race that was killed goes on; without it every race begins anew.

    Raises:
        InputError: the folder holds the state of another race.
    """
    if case == "scale":
        from services.bench.fits.tooth_scale import run as run_scale

        return run_scale(quick=quick, keep=keep)
    prepare_device(threads=1)
    settings = QUICK if quick else FULL
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        stored = RaceState(folder / "state" if state is None else state)
        stored.open(settings)
        tooth = smallest_case(folder, pixel_step=settings.pixel_step)
        truth = tooth.truth
        assert truth is not None

        def rows_of(runs: Sequence[Run]) -> list[dict[str, Any]]:
            return [row.model_dump() for row in point_rows(runs, truth)]

        runs = [our_run(tooth, folder / "ours", stored)]
        for recipe in PEERS:
            for rate in settings.rates:
                keep(rows_of(runs))
                runs.append(peer_run(tooth, folder, stored, recipe, rate, settings.limit_s))
        for k, one in enumerate(runs):
            keep(rows_of(runs))
            runs[k] = with_images(tooth, one, stored, LEVELS[HELD_OUT], settings.max_samples)
        allowed = stored.floor(lambda: floor(tooth, truth, settings.floor_samples, FLOOR_SEED))
    decided = level_rows(runs, truth, allowed)
    print("\n".join([*table(decided), *sentences(decided)]), file=sys.stderr)
    return rows_of(runs) + [row.model_dump() for row in decided]


def picture(rows: list[dict[str, Any]]) -> Figure:
    """Draw errors against processor time; for the scale case against run time, by number of workers."""
    from services.bench.fits.race_picture import picture as race_picture
    from services.bench.plots import draw_errors, finish, grid

    if rows and rows[0]["benchmark"].startswith("tooth-scale"):
        figure, (axes,) = grid(1)
        draw_errors(axes, rows, lines=False)
        finish(axes, "run time, s", "held-out error")
        return figure
    return race_picture(rows)
