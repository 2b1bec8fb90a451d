"""What a race of tooth fits tells: rows for its JSON file, a table of its levels, and sentences."""

from __future__ import annotations

from collections.abc import Sequence

from services.bench import Row
from services.bench.fits.race import Measured, Span, best, time_to, verdict
from services.bench.fits.race_floor import HELD_OUT, QUANTITIES, quantities
from services.bench.fits.race_runs import OURS, FloorRecord, Run
from services.transport.optics.parameters import Tissue

PARAMETER_LEVELS = (0.2, 0.1, 0.05)
IMAGE_LEVELS = (0.1, 0.05, 0.03)
ALL = "all"
"""The parameter that is furthest off: at some time one parameter alone may be right by chance."""
LEVELS = dict.fromkeys((ALL, *QUANTITIES), PARAMETER_LEVELS) | {HELD_OUT: IMAGE_LEVELS}
"""Relative errors to which each quantity is held."""
WORDS = {
    ALL: "all four parameters",
    "enamel.sigma_s_reduced": "enamel σs'",
    "dentin.sigma_s_reduced": "dentin σs'",
    "enamel.sigma_a": "enamel σa",
    "dentin.sigma_a": "dentin σa",
    HELD_OUT: "held-out images",
}


class PointRow(Row):
    """An iterate of a solver. ``error`` is the largest of the errors of its parameters."""

    rate: float | None
    """Learning rate of Adam; None for this project's fit."""
    stage: str
    parameters: dict[str, float]
    errors: dict[str, float]
    """Relative errors of reduced scattering and absorption."""
    held_out: float | None = None
    """Relative error of the held-out images; None where they were not compared."""
    held_out_se: float | None = None
    fitted: float | None = None
    """Relative error of the fitted images."""
    samples: int | None = None
    """Paths per pixel of each render that measured the images."""


class FloorRow(Row):
    """Smallest error that the photographs allow, one standard deviation, in ``error``."""

    quantity: str
    error_se: float


class LevelRow(Row):
    """When a solver reached a level, which stands in ``error``; ``seconds`` is ``by_s``, or else ``after_s``."""

    quantity: str
    after_s: float
    """Last time at which it was surely not there."""
    by_s: float | None
    """First time from which on it surely was."""
    lowest_ratio: float | None = None
    """Smallest and largest ratio of its time to that of this project's fit; None where there is none."""
    highest_ratio: float | None = None
    sentence: str = ""
    """What the race decides; empty for this project's fit, to which others are compared."""


def off(tissue: Tissue, truth: Tissue) -> dict[str, float]:
    """Relative errors of the quantities, and under ``ALL`` the largest of them."""
    true = quantities(truth)
    errors = {name: abs(value / true[name] - 1) for name, value in quantities(tissue).items()}
    return {ALL: max(errors.values())} | errors


def point_rows(runs: Sequence[Run], truth: Tissue) -> list[PointRow]:
    """Rows of all iterates of all runs."""
    rows = []
    for run in runs:
        images = {one.point: one for one in run.images}
        for k, point in enumerate(run.points):
            errors, seen = off(point.tissue, truth), images.get(k)
            more = {} if seen is None else seen.model_dump(exclude={"point"})
            rows.append(
                PointRow(
                    benchmark="tooth", peer=run.peer, rate=run.rate, seconds=point.seconds, stage=point.stage,
                    parameters=point.media, errors=errors, error=errors[ALL], **more,
                )
            )  # fmt: skip
    return rows


def measured(run: Run, quantity: str, truth: Tissue) -> list[Measured]:
    """Errors of a run's iterates in one quantity."""
    if quantity != HELD_OUT:
        return [Measured(point.seconds, off(point.tissue, truth)[quantity]) for point in run.points]
    images = sorted(run.images, key=lambda one: one.point)
    return [Measured(run.points[one.point].seconds, one.held_out, one.held_out_se) for one in images]


def level_rows(runs: Sequence[Run], truth: Tissue, floor: FloorRecord) -> list[FloorRow | LevelRow]:
    """Rows of the photographs' floor and of all levels."""
    largest = max(QUANTITIES, key=lambda name: floor.floor[name])
    floors, ses = ({ALL: known[largest]} | known for known in (floor.floor, floor.se))
    rows: list[FloorRow | LevelRow] = [
        FloorRow(benchmark="tooth-floor", peer="photographs", seconds=0.0, quantity=name, error=floors[name],
                 error_se=ses[name])
        for name in LEVELS
    ]  # fmt: skip
    peers = list(dict.fromkeys(run.peer for run in runs))
    for name, levels in LEVELS.items():
        errors = [(run, measured(run, name, truth)) for run in runs]
        for level in levels:
            spans = {
                peer: best(time_to(level, one, has_ended=run.has_ended) for run, one in errors if run.peer == peer)
                for peer in peers
            }
            rows += [level_row(name, level, floors[name], peer, spans) for peer in peers]
    return rows


def level_row(quantity: str, level: float, floor: float, peer: str, spans: dict[str, Span]) -> LevelRow:
    """Row of one peer at one level."""
    span = spans[peer]
    found = None if peer == OURS else verdict(level, floor, spans[OURS], span)
    return LevelRow(
        benchmark="tooth-level", peer=peer, quantity=quantity, error=level, after_s=span.after_s, by_s=span.by_s,
        seconds=span.after_s if span.by_s is None else span.by_s,
        lowest_ratio=found.lowest if found else None, highest_ratio=found.highest if found else None,
        sentence=found.sentence if found else "",
    )  # fmt: skip


def table(rows: Sequence[FloorRow | LevelRow]) -> list[str]:
    """Lines of a table in Markdown: by quantity, the processor seconds after which each solver kept its levels; behind
    ``>`` the last time at which it was surely above a level that it did not surely keep.
    """
    levels = [row for row in rows if isinstance(row, LevelRow)]
    peers = list(dict.fromkeys(row.peer for row in levels))
    lines = [f"| error kept, % | floor, % | {' | '.join(peers)} |", "|---" * (len(peers) + 2) + "|"]
    for floor in (row for row in rows if isinstance(row, FloorRow)):
        own = [row for row in levels if row.quantity == floor.quantity]
        names = "/".join(f"{100 * level:g}" for level in dict.fromkeys(row.error for row in own))
        cells = ["/".join(_time(row) for row in own if row.peer == peer) for peer in peers]
        allowed = f"{100 * floor.error:.2g}±{100 * floor.error_se:.1g}"
        lines.append(f"| {WORDS[floor.quantity]} {names} | {allowed} | {' | '.join(cells)} |")
    return lines


def _time(row: LevelRow) -> str:
    return f">{row.after_s:.0f}" if row.by_s is None else f"{row.by_s:.0f}"


def sentences(rows: Sequence[FloorRow | LevelRow]) -> list[str]:
    """What the race decides at each level, and a last sentence if it decides nothing at all."""
    compared = [row for row in rows if isinstance(row, LevelRow) and row.sentence]
    told = [f"{WORDS[row.quantity]} to {100 * row.error:g} %, {row.peer}: {row.sentence}." for row in compared]
    if all(row.lowest_ratio is None for row in compared):
        told.append("This race decides nothing; leave out --quick, or give it more time.")
    return told
