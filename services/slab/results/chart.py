"""The phase function with its band of one standard error, as an inline SVG that takes its colours from the page."""

from __future__ import annotations

import math
from html import escape

from services.slab.results.result import PhaseFunction

WIDTH, HEIGHT = 640, 300
LEFT, RIGHT, TOP, BOTTOM = 64, 16, 16, 40
PICTURE_STYLE = (
    "text{fill:#595e68;font:12px"
    " system-ui,sans-serif}.grid{stroke:#d9d6d0}.series{fill:none;stroke:#0b63a5;stroke-width:2}"
    ".band{fill:#0b63a5;opacity:.25}.prior{fill:#d9d6d0;opacity:.6}"
    "@media(prefers-color-scheme:dark){text{fill:#a9b4b7}.grid{stroke:#3a4549}.series{stroke:#6db5ea}.band{fill:#6db5ea}.prior{fill:#3a4549}}"
    "@media(max-width:450px){text{font-size:17px}}"
)
"""Style sheet of a chart that stands alone; where a phone shows it at half its size, its letters are larger."""
DECADES_BELOW = 4
"""Largest number of decades below the peak that are drawn: lower values are not seen against the peak in any image."""


MAX_DECADES_OF_FINE_TICKS = 3.0
"""Number of decades up to which 2 and 5 are labelled too; more labels would touch on a phone."""


def phase_chart(title: str, phase: PhaseFunction) -> str:
    """Chart of the value per sr against the angle, logarithmic, with a band of one standard error; grey where the
    images do not determine it.
    """
    low, high = _limits(phase)

    def x(theta_deg: float) -> float:
        return LEFT + theta_deg / 180 * (WIDTH - LEFT - RIGHT)

    def y(value: float) -> float:
        share = (math.log10(max(value, 10**low)) - low) / (high - low)
        return HEIGHT - BOTTOM - share * (HEIGHT - TOP - BOTTOM)

    rows = list(zip(phase.theta_deg, phase.value_per_sr, phase.se_per_sr, strict=True))
    band = [(x(t), y(p + s)) for t, p, s in rows] + [(x(t), y(p - s)) for t, p, s in reversed(rows)]
    parts = [f'<svg class="chart" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)}">']
    for first, last in phase.undetermined_bands_deg():
        width = max(x(last) - x(first), 2.0)
        parts.append(
            f'<rect class="prior" x="{x(first):.1f}" y="{TOP}" width="{width:.1f}" height="{HEIGHT - TOP - BOTTOM}"/>'
        )
    for value in _ticks(low, high):
        at = y(value)
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{at:.1f}" y2="{at:.1f}"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{at + 4:.1f}" text-anchor="end">{value:g}</text>')
    under = HEIGHT - BOTTOM + 16
    parts += [
        f'<text x="{x(angle):.1f}" y="{under}" text-anchor="middle">{angle}</text>' for angle in range(0, 181, 30)
    ]
    middle = (LEFT + WIDTH - RIGHT) / 2
    parts.append(f'<text x="{middle:.0f}" y="{HEIGHT - 6}" text-anchor="middle">scattering angle, degrees</text>')
    parts.append(f'<text transform="translate(12 {HEIGHT / 2:.0f}) rotate(-90)" text-anchor="middle">per sr</text>')
    parts.append(f'<polygon class="band" points="{_points(band)}"/>')
    parts.append(f'<polyline class="series s0" points="{_points([(x(t), y(p)) for t, p, _ in rows])}"/>')
    return "".join(parts) + "</svg>"


def phase_picture(title: str, phase: PhaseFunction) -> str:
    """The chart as a file of its own, in the colours of the report, light or dark as the page that shows it."""
    chart = phase_chart(title, phase)
    opening = f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{HEIGHT}" class="chart"'
    return chart.replace('<svg class="chart"', opening, 1).replace(">", f"><style>{PICTURE_STYLE}</style>", 1)


def _limits(phase: PhaseFunction) -> tuple[float, float]:
    # Decimal logarithms of the lowest and highest value that are drawn, with some room.
    high = math.log10(max(p + s for p, s in zip(phase.value_per_sr, phase.se_per_sr, strict=True))) + 0.1
    low = math.log10(max(min(phase.value_per_sr), 1e-300)) - 0.3
    return max(low, high - DECADES_BELOW), high


def _ticks(low: float, high: float) -> list[float]:
    # Powers of ten between two decimal logarithms, with 2 and 5 times these where there are few.
    factors = (1, 2, 5) if high - low < MAX_DECADES_OF_FINE_TICKS else (1,)
    values = [factor * 10.0**decade for decade in range(math.floor(low), math.floor(high) + 1) for factor in factors]
    return [value for value in values if low <= math.log10(value) <= high]


def _points(places: list[tuple[float, float]]) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
