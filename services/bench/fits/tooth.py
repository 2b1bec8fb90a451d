"""Benchmark of a tooth's fit: held-out error against processor time, for this fit and for the recipe of stock Mitsuba,
on the smallest real case.

Both fit the same noisy photographs under five lights, from no knowledge to parameters: extinction and albedo of enamel
and dentin, the peer with g held fixed, the product as it is. Loading scenes and compiling kernels counts as time. At
several times of each fit its error is measured in the same way, which does not count as time: on three held-out lights,
with exact media, 1,024 paths per pixel and two seeds of this engine, without sensor noise and the truth's Monte Carlo
noise.

Each has one thread, and seconds are its processor time, which other jobs on the machine change little. The peer tries
three learning rates for five minutes each and takes that of the smallest error on the fitted images; this fit goes on
until 40 minutes, of which those five count. The peer's ratio is its time to the target divided by ours. The target is
our last error times ``MARGIN``, or the error that the photographs' noise resolves if that is larger. A fit has reached
it where no later error is above it by more than its standard error. A peer that does not reach the target gets a lower
bound of the ratio, and another row with the ratio at the error that it ended with.

An error must be known to a third of the target, or the race decides nothing and its row says so in place of a ratio:
an error known to 4 % touches any target below that by chance. Each row also has the largest relative error of the
reduced scattering coefficients, as images may be right where parameters are not.
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
from services.transport.optics.parameters import Tissue
from services.transport.platform import prepare_device

if TYPE_CHECKING:
    from matplotlib.figure import Figure

OURS, OUR_ADAM, PEER = "dentine", "dentine-adam", "mitsuba-prbvolpath-adam"
RATES = (0.02, 0.05, 0.15)
"""Learning rates of Adam in the unbounded domain."""
CHOICE_S, LIMIT_S = 300.0, 2400.0
"""Processor time of each learning rate's trial, and of the whole fit with the best one."""
QUICK_CHOICE_S, QUICK_LIMIT_S = 20.0, 60.0
MARK_GROWTH = 1.12
"""Ratio of the times of two successive measurements of a peer's error."""
MARGIN = 1.1
CLEAR_Z = 3.0
"""Standard errors by which an error lies above the target where it has clearly not reached it."""
MAX_ERROR_SE = 1 / 3
"""Largest standard error of an error that decides a race, as a share of the target."""
ERROR_SAMPLES = 1024

Case = Literal["race", "scale"]
Keep = Callable[[list[dict[str, Any]]], None]


class ToothRow(Row):
    """State of a fit after so many seconds of processor time.

    ``error`` is the relative error on the held-out images.
    """

    error_se: float
    """Standard error of ``error`` by the Monte Carlo noise of its measurement."""
    fitted_error: float
    """Relative error on the fitted images."""
    parameter_error: float | None = None
    """Largest relative error of the reduced scattering coefficients; None where the truth is not known."""
    stage: str
    parameters: dict[str, float]
    rate: float | None = None
    """Learning rate of Adam; None for the product."""
    lower_bound: bool = False
    """Whether ``efficiency_ratio``, here the ratio of times to one held-out error, is only a bound."""
    undecided: str = ""
    """In a summary without a ratio, the sentence that says why the race decides nothing."""


@dataclass
class ErrorRecorder:
    """Measures the error of a tooth's parameters, makes a row of it and passes on all rows so far."""

    case: PreparedTooth
    keep: Keep
    samples: int
    rows: list[ToothRow] = field(default_factory=list)

    def record(self, peer: str, seconds: float, tissue: Tissue, stage: str, **more: Any) -> ToothRow:
        """Measure the error of a tooth's media and keep the row."""
        fitted, held_out = self.case.errors(tissue, samples=self.samples, seed=11)
        values = {
            f"{part}.{leaf}": getattr(getattr(tissue, part), leaf)
            for part in ("enamel", "dentin")
            for leaf in ("sigma", "alpha", "sigma_s_reduced")
        }
        off = [abs(values[name] / true - 1) for name, true in self.case.truth.items()]
        row = ToothRow(
            benchmark="tooth", peer=peer, seconds=seconds, error=held_out.resolved_error or 0.0,
            error_se=held_out.error_se or 0.0, fitted_error=fitted.resolved_error or 0.0, stage=stage,
            parameter_error=max(off, default=None), parameters=values, **more,
        )  # fmt: skip
        self.rows.append(row)
        self.keep([one.model_dump() for one in self.rows])
        return row


def run(*, quick: bool, case: Case = "race", keep: Keep = lambda _: None) -> list[dict[str, Any]]:
    """Return the rows of all fits and, at the end, the peers' summaries.

    Args:
        quick: take fewer pixels, less time and fewer samples.
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
        recorder = ErrorRecorder(tooth, keep, 256 if quick else ERROR_SAMPLES)
        ours = our_fit(recorder, folder / "ours", OURS, tooth.spec)
        peers = {
            PEER: stock_fit(recorder, folder, *((QUICK_CHOICE_S, QUICK_LIMIT_S) if quick else (CHOICE_S, LIMIT_S)))
        }
        if "solver" in JobSpec.model_fields:
            peers[OUR_ADAM] = our_fit(
                recorder, folder / "adam", OUR_ADAM, tooth.spec.model_copy(update={"solver": "adam"})
            )
        target = max(MARGIN * ours[-1].error, tooth.resolution())
        for rows in peers.values():
            recorder.rows.append(summary(ours, rows, target))
            if recorder.rows[-1].undecided:
                print(recorder.rows[-1].undecided)
            elif recorder.rows[-1].lower_bound:
                recorder.rows.append(summary(ours, rows, rows[-1].error, "tooth-at-its-end"))
    return [row.model_dump() for row in recorder.rows]


def our_fit(recorder: ErrorRecorder, folder: Path, peer: str, spec: JobSpec) -> list[ToothRow]:
    """Run the product's own fit stage in this process, and measure its error after every step of its solver and at its
    end.
    """
    from services.core.store import StageWriter
    from services.fit.stage import ENGINE
    from services.fit.stages.attempt import Attempt
    from services.fit.stages.tooth.driver import FitDriver

    rows: list[ToothRow] = []
    paused = 0.0

    def listen(event: StageEvent) -> None:
        nonlocal paused
        if event.kind == "step":
            begun = time.process_time()
            rows.append(
                recorder.record(
                    peer, begun - started - paused, tissue_of(event.data["parameters"]), event.data["stage"]
                )
            )
            paused += time.process_time() - begun

    folder.mkdir()
    (folder / "prepared").symlink_to(recorder.case.job / "prepared")
    context = LocalContext(folder, listener=listen)
    started = time.process_time()
    report = FitDriver(Attempt(spec, context, StageWriter(folder, "fit", 1), ENGINE)).run(time.time())
    seconds = time.process_time() - started - paused
    values = {name: estimate.value for name, estimate in report.parameters["green"].items()}
    rows.append(recorder.record(peer, seconds, tissue_of(values), "final"))
    return rows


def stock_fit(recorder: ErrorRecorder, folder: Path, choice_s: float, limit_s: float) -> list[ToothRow]:
    """Run the peer at its best learning rate until ``limit_s``, after a trial of ``choice_s`` for each rate."""
    tried: list[tuple[StockFit, list[ToothRow]]] = []
    for rate in RATES:
        tried.append((StockFit(recorder.case, folder, rate), []))
        _descend(recorder, *tried[-1], choice_s)
    fit, rows = min(tried, key=lambda one: one[1][-1].fitted_error)
    _descend(recorder, fit, rows, limit_s)
    return rows


def _descend(recorder: ErrorRecorder, fit: StockFit, rows: list[ToothRow], until_s: float) -> None:
    mark = fit.seconds if not rows else MARK_GROWTH * fit.seconds
    while fit.seconds < until_s:
        fit.step()
        if fit.seconds >= mark or fit.seconds >= until_s:
            rows.append(recorder.record(PEER, fit.seconds, fit.tissue(), f"round {fit.rounds}", rate=fit.rate))
            mark = MARK_GROWTH * fit.seconds


def summary(ours: list[ToothRow], peer: list[ToothRow], target: float, name: str = "tooth-summary") -> ToothRow:
    """Return a row with the ratio of the peer's time to the target to ours; where the peer does not reach the target,
    its last time counts and the ratio is a lower bound. Where errors are known too roughly, the row has no ratio.
    """
    own, others = reached(ours, target) or ours[-1], reached(peer, target)
    last = others or peer[-1]
    # A peer that is clearly above the target has not reached it, however roughly its error is known.
    is_clear = others is None and last.error - CLEAR_Z * last.error_se > target
    vaguest = max(row.error_se for row in ((own,) if is_clear else (own, last)))
    changes: dict[str, Any] = {"benchmark": name, "lower_bound": others is None}
    if vaguest > MAX_ERROR_SE * target:
        changes["undecided"] = (
            f"This race decides nothing: its errors are known to {100 * vaguest:.1f} %, and a level of"
            f" {100 * target:.1f} % needs a third of that; leave out --quick."
        )
    else:
        changes["efficiency_ratio"] = last.seconds / own.seconds
    return last.model_copy(update=changes)


def reached(rows: list[ToothRow], target: float) -> ToothRow | None:
    """The first row from which on no error is above the target by more than its standard error; None where there is
    none.
    """
    above = [k for k, row in enumerate(rows) if row.error - row.error_se > target]
    first = above[-1] + 1 if above else 0
    return rows[first] if first < len(rows) else None


def picture(rows: list[dict[str, Any]]) -> Figure:
    """Draw held-out error against processor time; for the scale case against run time, by number of workers."""
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
            ratio = end["efficiency_ratio"]
            label += (
                ", undecided"
                if ratio is None
                else f", {'over ' if end['lower_bound'] else ''}{ratio:.3g} times our time"
            )
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
