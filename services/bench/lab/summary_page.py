"""Report of a virtual laboratory: its results, the requirements on them, and links to the reports of its steps."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from services.core.pages.page import page_template
from services.core.store import write_atomic

SUMMARY, PAGE = "summary.json", "summary.html"
TEMPLATE = Path(__file__).with_name("summary.html.j2")
STEPS = {
    "teeth_mm": "teeth, mm",
    "teeth_deg": "teeth, °",
    "lights_mm": "lights, mm",
    "lights_deg": "lights, ° from the teeth",
    "intensity": "intensity of the lights, relative",
    "radiance": "radiance per count, relative",
}


def write_summary(root: Path, summary: Mapping[str, Any]) -> None:
    """Write ``summary.json`` and ``summary.html`` into a laboratory's folder."""
    write_atomic(root / SUMMARY, (json.dumps(summary, indent=1) + "\n").encode())
    rows = [_row("found calibration and pose", summary["chain"])]
    rows += [_row(name, one) for name, one in summary["variants"].items()]
    asked = [
        {
            "what": what,
            "value": f"{one['value']:.2f}",
            "limit": f"{one['limit']:g}",
            "kept": "yes" if one["kept"] else "no",
        }
        for what, one in summary.get("asked", {}).items()
    ]
    steps = [{"what": name, "value": f"{summary['steps'][key]:.3g}"} for key, name in STEPS.items()]
    names = list(summary["chain"]["media"])
    page = page_template(TEMPLATE).render(rows=rows, asked=asked, steps=steps, names=names)
    write_atomic(root / PAGE, page.encode())


def lines(summary: Mapping[str, Any]) -> list[str]:
    """Return the summary as a few lines for a terminal."""
    found = []
    for name, one in {"chain": summary["chain"], **summary["variants"]}.items():
        row = _row(name, one)
        found.append(f"{name}: held-out error {row['held_out']}, on fitted images {row['fit']}{row['note']}")
        found += [f"  {key}: {value}" for key, value in zip(one["media"], row["media"], strict=True)]
    found.append("off the truth: " + ", ".join(f"{name} {summary['steps'][key]:.3g}" for key, name in STEPS.items()))
    for what, one in summary.get("asked", {}).items():
        kept = "" if one["kept"] else ", NOT KEPT"
        found.append(f"{what}: {one['value']:.2f} (limit {one['limit']:g}){kept}")
    return found


def _row(name: str, one: Mapping[str, Any]) -> dict[str, Any]:
    media = [
        f"{own['value']:.4g} ± {own['se']:.2g}, truth {own['truth']:.4g} ({own['z']:+.1f} standard errors)"
        for own in one["media"].values()
    ]
    return {
        "name": name,
        "held_out": f"{100 * one['held_out_error']:.2f} %",
        "fit": f"{100 * one['fit_error']:.2f} %",
        "note": "" if one["converged"] else ", not converged",
        "media": media,
    }
