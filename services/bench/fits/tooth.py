"""A tooth's fit: held-out error against processor time, ours and the stock recipe, on the smallest real case.

Everyone fits the same noisy photographs of five lights, from nothing to parameters: extinction and albedo of enamel and
dentin, the peer with g held, the product as it is. Scenes are loaded and kernels compiled on the clock. At marks along
the way everyone's parameters are judged alike, off the clock: three held-out lights, exact media, 1,024 paths per pixel
and two seeds of this engine, sensor noise and the truth's Monte Carlo noise taken out.

Everyone has one thread, and seconds are its processor time, which other jobs on the machine hardly move. The peer
chooses one of three learning rates, five minutes each, by its error on the fitted images; the best one goes on until 40
minutes, of which those five count. Its ratio is its time to the target over ours; the target is our last error times
``MARGIN``, or what the photographs' noise resolves where that is more. A peer that never got there has a lower bound
there, and beside it the ratio at the error that it ended with.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from services.bench import Row
from services.bench.fits.stock_fit import StockFit
from services.bench.fits.tooth_capture import PreparedTooth, smallest_case, tissue_of
from services.core.records import JobSpec
from services.core.stage import LocalContext, StageEvent
from services.fit.optics.parameters import Tissue
from services.fit.transport.platform import prepare_device

if TYPE_CHECKING:
    from matplotlib.figure import Figure

OURS, OUR_ADAM, PEER = "dentine", "dentine-adam", "mitsuba-prbvolpath-adam"
RATES = (0.02, 0.05, 0.15)
"""Of Adam in the unbounded domain."""
CHOICE_S, LIMIT_S = 300.0, 2400.0
QUICK_CHOICE_S, QUICK_LIMIT_S = 20.0, 60.0
MARK_GROWTH = 1.12
"""From one mark of a peer to the next, in time."""
MARGIN = 1.1
JUDGE_SAMPLES = 1024

Case = Literal["race", "scale"]
Keep = Callable[[list[dict[str, Any]]], None]


class ToothRow(Row):
    """Where a fit stood after so many seconds of processor time.

    ``error`` is the relative error on the held-out images.
    """

    error_se: float
    """By the judge's own samples."""
    fitted_error: float
    stage: str
    parameters: dict[str, float]
    rate: float | None = None
    """Learning rate."""
    lower_bound: bool = False
    """Whether ``efficiency_ratio``, here the ratio of times to one held-out error, is only a bound."""


@dataclass
class Judge:
    """Turns parameters into rows and passes on all rows so far."""

    case: PreparedTooth
    keep: Keep
    samples: int
    rows: list[ToothRow] = field(default_factory=list)

    def row(self, peer: str, seconds: float, tissue: Tissue, stage: str, **more: Any) -> ToothRow:
        """Judge and keep one point."""
        fitted, held_out = self.case.errors(tissue, samples=self.samples, seed=11)
        values = {
            f"{part}.{leaf}": getattr(getattr(tissue, part), leaf)
            for part in ("enamel", "dentin")
            for leaf in ("sigma", "alpha", "sigma_s_reduced")
        }
        row = ToothRow(
            benchmark="tooth", peer=peer, seconds=seconds, error=held_out.resolved_error or 0.0,
            error_se=held_out.error_se or 0.0, fitted_error=fitted.resolved_error or 0.0, stage=stage,
            parameters=values, **more,
        )  # fmt: skip
        self.rows.append(row)
        self.keep([one.model_dump() for one in self.rows])
        return row


def run(*, quick: bool, case: Case = "race", keep: Keep = lambda _: None) -> list[dict[str, Any]]:
    """Rows of everyone's way down and, at the end, the peers' summaries.

    Args:
        case: ``scale`` measures a full-resolution tooth on one and on two workers instead.
        keep: called with all rows so far after every new one.
    """
    if case == "scale":
        from services.bench.fits.tooth_scale import run as run_scale

        return run_scale(quick=quick, keep=keep)
    prepare_device(threads=1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tooth = smallest_case(folder, pixel_step=3 if quick else 1)
        judge = Judge(tooth, keep, 256 if quick else JUDGE_SAMPLES)
        ours = our_fit(judge, folder / "ours", OURS, tooth.spec)
        peers = {PEER: stock_fit(judge, folder, *((QUICK_CHOICE_S, QUICK_LIMIT_S) if quick else (CHOICE_S, LIMIT_S)))}
        if "solver" in JobSpec.model_fields:
            peers[OUR_ADAM] = our_fit(
                judge, folder / "adam", OUR_ADAM, tooth.spec.model_copy(update={"solver": "adam"})
            )
        target = max(MARGIN * ours[-1].error, tooth.resolution())
        for rows in peers.values():
            judge.rows.append(summary(ours, rows, target))
            if judge.rows[-1].lower_bound:
                judge.rows.append(summary(ours, rows, rows[-1].error, "tooth-at-its-end"))
    return [row.model_dump() for row in judge.rows]


def our_fit(judge: Judge, folder: Path, peer: str, spec: JobSpec) -> list[ToothRow]:
    """The product's own fit stage in this process, judged after every step of its solver and at its end."""
    from services.core.store import StageWriter
    from services.fit.execution.attempt import Attempt
    from services.fit.stage import ENGINE
    from services.fit.tooth.driver import FitDriver

    rows: list[ToothRow] = []
    paused = 0.0

    def listen(event: StageEvent) -> None:
        nonlocal paused
        if event.kind == "step":
            begun = time.process_time()
            rows.append(
                judge.row(peer, begun - started - paused, tissue_of(event.data["parameters"]), event.data["stage"])
            )
            paused += time.process_time() - begun

    folder.mkdir()
    (folder / "prepared").symlink_to(judge.case.job / "prepared")
    context = LocalContext(folder, listener=listen)
    started = time.process_time()
    report = FitDriver(Attempt(spec, context, StageWriter(folder, "fit", 1), ENGINE)).run(time.time())
    seconds = time.process_time() - started - paused
    values = {name: estimate.value for name, estimate in report.parameters["green"].items()}
    rows.append(judge.row(peer, seconds, tissue_of(values), "final"))
    return rows


def stock_fit(judge: Judge, folder: Path, choice_s: float, limit_s: float) -> list[ToothRow]:
    """The peer at its best learning rate, until ``limit_s``."""
    tried: list[tuple[StockFit, list[ToothRow]]] = []
    for rate in RATES:
        tried.append((StockFit(judge.case, folder, rate), []))
        _descend(judge, *tried[-1], choice_s)
    fit, rows = min(tried, key=lambda one: one[1][-1].fitted_error)
    _descend(judge, fit, rows, limit_s)
    return rows


def _descend(judge: Judge, fit: StockFit, rows: list[ToothRow], until_s: float) -> None:
    mark = fit.seconds if not rows else MARK_GROWTH * fit.seconds
    while fit.seconds < until_s:
        fit.step()
        if fit.seconds >= mark or fit.seconds >= until_s:
            rows.append(judge.row(PEER, fit.seconds, fit.tissue(), f"round {fit.rounds}", rate=fit.rate))
            mark = MARK_GROWTH * fit.seconds


def summary(ours: list[ToothRow], peer: list[ToothRow], target: float, name: str = "tooth-summary") -> ToothRow:
    """The peer's time to the target over ours; of its last point, and a lower bound, where it never got there.

    The peer is there when it first shows the target; we are when no later point, of another start say, is above it by
    more than the judge's error.
    """
    above = [k for k, row in enumerate(ours) if row.error - row.error_se > target]
    settled = ours[min(above[-1] + 1, len(ours) - 1) if above else 0]
    reached = next((row for row in peer if row.error <= target), None)
    last = reached or peer[-1]
    changes = {"benchmark": name, "efficiency_ratio": last.seconds / settled.seconds, "lower_bound": reached is None}
    return last.model_copy(update=changes)


def picture(rows: list[dict[str, Any]]) -> Figure:
    """Held-out error against processor time; of the scale case, workers against time."""
    from services.bench.plots import draw_errors, finish, grid

    if rows and rows[0]["benchmark"].startswith("tooth-scale"):
        figure, (axes,) = grid(1)
        draw_errors(axes, rows, lines=False)
        finish(axes, "run time, s", "held-out error")
        return figure
    figure, (axes,) = grid(1)
    ratios = {row["peer"]: row for row in rows if row["benchmark"].endswith("-summary")}
    curves = list(dict.fromkeys((row["peer"], row["rate"]) for row in rows if row["benchmark"] == "tooth"))
    for number, (peer, rate) in enumerate(curves):
        mine = [row for row in rows if (row["benchmark"], row["peer"], row["rate"]) == ("tooth", peer, rate)]
        label = peer if rate is None else f"{peer}, rate {rate:g}"
        if (end := ratios.get(peer)) is not None and end["rate"] == rate:
            label += f", {'over ' if end['lower_bound'] else ''}{end['efficiency_ratio']:.3g} times our time"
        axes.plot(
            [row["seconds"] for row in mine],
            [100 * row["error"] for row in mine],
            "o-",
            color=f"C{number}",
            markersize=4,
            label=label,
        )
    finish(axes, "processor time, s", "held-out error, %")
    axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.15))
    figure.set_size_inches(6.0, 6.0)
    return figure
