"""Pictures of benchmarks: error against run time, with all peers of one run in one picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogFormatterMathtext, LogLocator, NullFormatter

COLUMNS = 4
PANEL_INCHES = (4.6, 3.9)
OURS = "dentine"
SUMMARY = "-summary"
"""Suffix of the benchmark's name in summary rows, which are drawn in the panel of the benchmark that they summarise."""

Rows = list[dict[str, Any]]


def error_against_time(rows: Rows) -> Figure:
    """Draw a log-log panel for each benchmark, or for each parameter of a benchmark, with this engine first.

    Args:
        rows: rows as ``Row.model_dump`` returns them.
    """
    panels: dict[tuple[str, str], Rows] = {}
    for row in rows:
        panels.setdefault((row["benchmark"].removesuffix(SUMMARY), row.get("parameter") or ""), []).append(row)
    # Leave out panels that would contain summary rows only.
    panels = {
        name: drawn for name, drawn in panels.items() if any(not row["benchmark"].endswith(SUMMARY) for row in drawn)
    }
    figure, axes = grid(len(panels))
    for one, (name, drawn) in zip(axes, panels.items(), strict=True):
        draw_errors(one, drawn)
        one.set_title(" ".join(name))
    return figure


def grid(count: int) -> tuple[Figure, list[Axes]]:
    """Return a figure with so many panels, which is not registered with pyplot."""
    columns = min(count, COLUMNS)
    lines = -(-count // columns)
    figure = Figure(figsize=(PANEL_INCHES[0] * columns, PANEL_INCHES[1] * lines), layout="constrained")
    return figure, [figure.add_subplot(lines, columns, k + 1) for k in range(count)]


def draw_errors(axes: Axes, rows: Rows, *, by: str = "peer", lines: bool = True) -> None:
    """Draw the points of all peers; a peer's efficiency ratio is written in the legend.

    Args:
        axes: panel to draw on.
        rows: rows as ``Row.model_dump`` returns them.
        by: field by which the rows are grouped.
        lines: also draw, through the most efficient point of each group, the error that more or fewer paths would give:
            error = 1 / sqrt(efficiency x time).
    """
    drawn = [row for row in rows if row["error"] > 0 and row["seconds"] > 0]
    for number, one in enumerate(sorted({row[by] for row in drawn}, key=lambda one: (one != OURS, one))):
        mine = [row for row in drawn if row[by] == one]
        seconds, error = np.array([(row["seconds"], row["error"]) for row in mine]).T
        ratios = [row["efficiency_ratio"] for row in mine if row.get("efficiency_ratio") is not None]
        label = f"{one}, {ratios[-1]:.3g} times our cost" if ratios else str(one)
        axes.plot(seconds, error, "o", color=f"C{number}", markersize=5, label=label)
        if lines:
            best = np.argmin(seconds * error**2)
            along = np.array([min(row["seconds"] for row in drawn), max(row["seconds"] for row in drawn)])
            axes.plot(along, error[best] * np.sqrt(seconds[best] / along), "--", color=f"C{number}", linewidth=1)
    finish(axes, "run time, s", "relative standard error")


def finish(axes: Axes, x: str, y: str) -> None:
    """Make both axes logarithmic and at least about a decade long, and add their names, a grid and a legend."""
    axes.set(xscale="log", yscale="log", xlabel=x, ylabel=y)
    axes.set(xlim=_a_decade(*axes.get_xlim()), ylim=_a_decade(*axes.get_ylim()))
    for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 100 * low else (1,)))
        plain = FuncFormatter(lambda value, _: f"{value:g}")
        axis.set_major_formatter(plain if high < 1e5 * low else LogFormatterMathtext())
        axis.set_minor_formatter(NullFormatter())
    axes.grid(visible=True, which="both", alpha=0.25)
    axes.legend(fontsize=8)


def _a_decade(low: float, high: float) -> tuple[float, float]:
    wider = max(1.0, (12 * low / high) ** 0.5)
    return low / wider, high * wider


def write_png(figure: Figure, path: Path | BinaryIO) -> None:
    """Write a figure as PNG without a display."""
    FigureCanvasAgg(figure).print_png(path)  # type: ignore[no-untyped-call]  # matplotlib has types, but none here
