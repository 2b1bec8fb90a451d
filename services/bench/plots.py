"""Pictures of benchmarks: error against run time, everyone measured in the same run in the same picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

COLUMNS = 4
PANEL_INCHES = (4.6, 3.9)
OURS = "dentine"
SUMMARY = "-summary"
"""Ends the benchmark's name in rows that belong into the picture of the benchmark they summarise."""

Rows = list[dict[str, Any]]


def error_against_time(rows: Rows) -> Figure:
    """One panel per benchmark, or per parameter of one, log-log, this engine first; ``rows`` are as ``Row.model_dump``
    gives them.
    """
    panels: dict[tuple[str, str], Rows] = {}
    for row in rows:
        panels.setdefault((row["benchmark"].removesuffix(SUMMARY), row.get("parameter") or ""), []).append(row)
    # A summary over several panels has nothing to draw.
    panels = {
        name: drawn for name, drawn in panels.items() if any(not row["benchmark"].endswith(SUMMARY) for row in drawn)
    }
    figure, axes = grid(len(panels))
    for one, (name, drawn) in zip(axes, panels.items(), strict=True):
        draw_errors(one, drawn)
        one.set_title(" ".join(name))
    return figure


def grid(count: int) -> tuple[Figure, list[Axes]]:
    """A figure with so many panels, none of it known to pyplot."""
    columns = min(count, COLUMNS)
    lines = -(-count // columns)
    figure = Figure(figsize=(PANEL_INCHES[0] * columns, PANEL_INCHES[1] * lines), layout="constrained")
    return figure, [figure.add_subplot(lines, columns, k + 1) for k in range(count)]


def draw_errors(axes: Axes, rows: Rows, *, by: str = "peer", lines: bool = True) -> None:
    """Points of everyone measured; a peer's efficiency ratio stands in the legend.

    Args:
        by: field that tells them apart.
        lines: also draw for everyone what more or fewer paths give from the most efficient point, error = 1 /
            sqrt(efficiency x time).
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
    """Both axes logarithmic and at least a decade long, with names, grid and legend."""
    axes.set(xscale="log", yscale="log", xlabel=x, ylabel=y)
    axes.set(xlim=_a_decade(*axes.get_xlim()), ylim=_a_decade(*axes.get_ylim()))
    for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 100 * low else (1,)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())
    axes.grid(visible=True, which="both", alpha=0.25)
    axes.legend(fontsize=8)


def _a_decade(low: float, high: float) -> tuple[float, float]:
    wider = max(1.0, (12 * low / high) ** 0.5)
    return low / wider, high * wider


def write_png(figure: Figure, path: Path | BinaryIO) -> None:
    """Render without a display."""
    FigureCanvasAgg(figure).print_png(path)  # type: ignore[no-untyped-call]  # matplotlib has types, but none here
