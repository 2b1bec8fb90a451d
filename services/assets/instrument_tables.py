"""Tables of the report on the instrument: estimates of its errors, and the sources of each standard error."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from services.core.results import Estimate, FitReport

SOURCES = {
    "photographs": "photographs",
    "rendering": "rendering",
    "gain": "gain",
    "light_gain": "lights",
    "flare": "flare",
    "teeth": "scan",
    "dome": "dome",
    "shift": "motion",
    "prior": "prior",
    "mean_cosine": "mean cosine",
    "shape": "dentin's shape",
    "unfinished": "unfinished",
}
"""Sources of a standard error, with their headings in the report."""
SHOWN_UNITS = {"1": ("%", 100.0), "rad": ("°", math.degrees(1)), "mm": ("mm", 1.0), "px": ("px", 1.0)}
"""Unit of an error of the instrument in the report, and the factor to it, by its unit."""
MIN_SHARE = 0.005
"""Smallest share of a squared standard error that is shown."""


def source_tables(
    report: FitReport, leading: Callable[[str], bool], label: Callable[[str], str]
) -> list[dict[str, Any]]:
    """Tables, by channel, of the shares by source of the squared standard errors of the report's leading quantities.

    Args:
        report: the fit's report.
        leading: whether the parameter of a name is shown.
        label: the label of a parameter, by its name.
    """
    tables = []
    for channel, table in _tables(report).items():
        shown = {name: one for name, one in table.items() if leading(name) and one.se and one.se_parts}
        present = [name for name in SOURCES if any(_share(one, name) >= MIN_SHARE for one in shown.values())]
        rows = [(label(name), [_percent(_share(one, source)) for source in present]) for name, one in shown.items()]
        if rows:
            tables.append({"channel": channel, "labels": [SOURCES[name] for name in present], "rows": rows})
    return tables


def instrument_tables(report: FitReport) -> list[dict[str, Any]]:
    """Tables, by channel, of each error of the instrument: estimate, its standard error, and its standard error before
    the fit, in percent, degrees, mm or pixels.
    """
    tables = []
    for channel, found in report.instrument.items():
        rows = []
        for name, one in found.items():
            before = report.instrument_prior[channel][name]
            unit, factor = SHOWN_UNITS[one.unit]
            rows.append(
                {
                    "name": name,
                    "unit": unit,
                    "found": f"{factor * one.value:+.2f}".replace("-", "−"),
                    "se": f"{factor * (one.se or 0.0):.2f}",
                    "before": f"{factor * before:.2g}",
                    "assumed": name in report.assumed or (name.startswith("teeth.") and "teeth" in report.assumed),
                    "fault": name in report.instrument_faults.get(channel, ()),
                }
            )
        tables.append({"channel": channel, "rows": rows})
    return tables


def _tables(report: FitReport) -> dict[str, dict[str, Estimate]]:
    # All parameters by channel: those of the report's own table and, in a jaw, those of each tooth under its number.
    teeth = {
        channel: {
            f"{fdi}.{name}": one
            for fdi, tooth in report.teeth.items()
            for name, one in tooth.parameters.get(channel, {}).items()
        }
        for channel in report.parameters
    }
    return {channel: dict(table) | teeth[channel] for channel, table in report.parameters.items()}


def _share(estimate: Estimate, source: str) -> float:
    return (estimate.se_parts.get(source, 0.0) / estimate.se) ** 2 if estimate.se else 0.0


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if share >= MIN_SHARE else ""
