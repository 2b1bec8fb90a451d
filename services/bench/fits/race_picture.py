"""Picture of a race of tooth fits: the error of each parameter and of held-out images against processor time."""

from __future__ import annotations

from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from services.bench.fits.race_floor import HELD_OUT
from services.bench.fits.race_rows import LEVELS, WORDS

INCHES = (11.0, 7.2)
COLOURS = ("#0b6e4f", "#c8553d", "#3d5a98", "#8a5a9e")
"""Colours of the solvers, distinct on white and in grey."""
STYLES = ("-", "--", ":")
"""Lines of a solver's learning rates."""
MIN_PERCENT = 0.1
"""Smallest error that is drawn: errors of parameters cross zero, which a logarithmic axis does not have."""


def picture(rows: list[dict[str, Any]]) -> Figure:
    """Draw a panel for each quantity, with the levels as lines and the photographs' floor as a grey band."""
    figure = Figure(figsize=INCHES, layout="constrained", facecolor="white")
    panels = [figure.add_subplot(2, 3, k + 1) for k in range(len(LEVELS))]
    points = [row for row in rows if row["benchmark"] == "tooth"]
    floors = {row["quantity"]: row["error"] for row in rows if row["benchmark"] == "tooth-floor"}
    for axes, name in zip(panels, LEVELS, strict=True):
        _draw(axes, points, name, floors.get(name))
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    return figure


def _draw(axes: Axes, points: list[dict[str, Any]], name: str, floor: float | None) -> None:
    peers = list(dict.fromkeys(row["peer"] for row in points))
    for peer, colour in zip(peers, COLOURS, strict=False):
        rates = list(dict.fromkeys(row["rate"] for row in points if row["peer"] == peer))
        for rate, style in zip(rates, STYLES, strict=False):
            mine = [row for row in points if (row["peer"], row["rate"]) == (peer, rate)]
            label = peer if rate is None else f"{peer}, rate {rate:g}"
            _line(axes, mine, name, label, colour, style)
    for level in LEVELS[name]:
        axes.axhline(100 * level, color="0.55", linewidth=0.7, linestyle=":", label="_level")
    if floor is not None:
        axes.axhspan(MIN_PERCENT, 100 * floor, color="0.85", label="allowed by the photographs' noise", zorder=0)
    axes.set(xscale="log", yscale="log", title=WORDS[name], xlabel="processor time, s", ylabel="error, %")
    axes.set_ylim(bottom=MIN_PERCENT if name != HELD_OUT else 0.5)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(lambda value, _: f"{value:g}")
        axis.set_minor_formatter(NullFormatter())
    axes.grid(visible=True, which="major", alpha=0.25)


def _line(axes: Axes, rows: list[dict[str, Any]], name: str, label: str, colour: str, style: str) -> None:
    if name == HELD_OUT:
        seen = [row for row in rows if row["held_out"] is not None]
        axes.errorbar(
            [row["seconds"] for row in seen], [100 * row["held_out"] for row in seen],
            yerr=[100 * row["held_out_se"] for row in seen], color=colour, linestyle=style, marker="o", markersize=3.5,
            linewidth=1.3, capsize=2, label=label,
        )  # fmt: skip
        return
    errors = [max(100 * row["errors"][name], MIN_PERCENT) for row in rows]
    axes.plot([row["seconds"] for row in rows], errors, color=colour, linestyle=style, linewidth=1.4, label=label)
    axes.plot(rows[-1]["seconds"], errors[-1], "o", color=colour, markersize=4)
