"""The phase function with its band as an inline SVG that takes its colours from the page."""

from __future__ import annotations

import math
from html import escape

from services.fit.slab.results.result import PhaseFunction

WIDTH, HEIGHT = 640, 300
LEFT, RIGHT, TOP, BOTTOM = 64, 16, 16, 40
DECADES_BELOW = 4
"""Decades below the peak that are drawn at most: what lies lower is not seen against it in any image."""


def phase_chart(title: str, phase: PhaseFunction) -> str:
    """Value per sr against the angle, logarithmic, with a band of one standard error; grey where the images do not tell."""
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
        parts.append(f'<rect class="prior" x="{x(first):.1f}" y="{TOP}" width="{width:.1f}" height="{HEIGHT - TOP - BOTTOM}"/>')
    for decade in range(math.ceil(low), math.floor(high) + 1):
        at = y(10.0**decade)
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{at:.1f}" y2="{at:.1f}"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{at + 4:.1f}" text-anchor="end">{10.0**decade:g}</text>')
    under = HEIGHT - BOTTOM + 16
    parts += [f'<text x="{x(angle):.1f}" y="{under}" text-anchor="middle">{angle}</text>' for angle in range(0, 181, 30)]
    middle = (LEFT + WIDTH - RIGHT) / 2
    parts.append(f'<text x="{middle:.0f}" y="{HEIGHT - 6}" text-anchor="middle">scattering angle, degrees</text>')
    parts.append(f'<text transform="translate(12 {HEIGHT / 2:.0f}) rotate(-90)" text-anchor="middle">per sr</text>')
    parts.append(f'<polygon class="band" points="{_points(band)}"/>')
    parts.append(f'<polyline class="series s0" points="{_points([(x(t), y(p)) for t, p, _ in rows])}"/>')
    return "".join(parts) + "</svg>"


def _limits(phase: PhaseFunction) -> tuple[float, float]:
    # Decimal logarithms of the lowest and highest value that are drawn, with some room.
    high = math.log10(max(p + s for p, s in zip(phase.value_per_sr, phase.se_per_sr, strict=True))) + 0.1
    low = math.log10(max(min(phase.value_per_sr), 1e-300)) - 0.3
    return max(low, high - DECADES_BELOW), high


def _points(places: list[tuple[float, float]]) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
