"""Line charts as inline SVG that takes its colours from the page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

WIDTH, HEIGHT = 520, 240
LEFT, RIGHT, TOP, BOTTOM = 64, 104, 16, 40
DASHES = ("", "6 4", "2 3")
"""Dash patterns, so that series differ by more than their colour."""


@dataclass(frozen=True)
class Series:
    """One line of a chart: steps and positive values."""

    label: str
    points: tuple[tuple[float, float], ...]


def log_chart(title: str, x_label: str, y_label: str, series: Sequence[Series], percent: bool = False) -> str:
    """Line chart with a logarithmic y axis; an empty string where no series has a positive value."""
    lines = [Series(s.label, tuple((x, y) for x, y in s.points if math.isfinite(y) and y > 0)) for s in series]
    lines = [s for s in lines if s.points]
    if not lines:
        return ""
    xs, ys = [x for s in lines for x, _ in s.points], [y for s in lines for _, y in s.points]
    x_low, x_high = min(xs), max(*xs, min(xs) + 1)
    y_low, y_high = math.log10(min(ys)), math.log10(max(ys))
    pad = max(0.06 * (y_high - y_low), 0.05)
    y_low, y_high = y_low - pad, y_high + pad

    def place(x: float, y: float) -> tuple[float, float]:
        across = LEFT + (x - x_low) / (x_high - x_low) * (WIDTH - LEFT - RIGHT)
        return across, HEIGHT - BOTTOM - (math.log10(y) - y_low) / (y_high - y_low) * (HEIGHT - TOP - BOTTOM)

    parts = [f'<svg class="chart" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)}">']
    for value in _log_ticks(10**y_low, 10**y_high):
        _, y = place(x_low, value)
        label = f"{100 * value:.3g} %" if percent else f"{value:.3g}"
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{label}</text>')
    for value in _step_ticks(x_low, x_high):
        x, _ = place(value, 10**y_low)
        parts.append(f'<text x="{x:.1f}" y="{HEIGHT - BOTTOM + 16}" text-anchor="middle">{value:g}</text>')
    parts.append(
        f'<text x="{(LEFT + WIDTH - RIGHT) / 2:.0f}" y="{HEIGHT - 6}" text-anchor="middle">{escape(x_label)}</text>'
    )
    parts.append(
        f'<text transform="translate(12 {(TOP + HEIGHT - BOTTOM) / 2:.0f}) rotate(-90)"'
        f' text-anchor="middle">{escape(y_label)}</text>'
    )
    heights = _spread([place(*s.points[-1])[1] for s in lines])
    for number, line in enumerate(lines):
        shown = [place(x, y) for x, y in line.points]
        style = f'class="series s{number % 3}" stroke-dasharray="{DASHES[number % 3]}"'
        parts.append(f'<polyline {style} points="{" ".join(f"{x:.1f},{y:.1f}" for x, y in shown)}"/>')
        parts.extend(f'<circle class="dot s{number % 3}" cx="{x:.1f}" cy="{y:.1f}" r="2.5"/>' for x, y in shown)
        parts.append(f'<text x="{WIDTH - RIGHT + 10}" y="{heights[number] + 4:.1f}">{escape(line.label)}</text>')
    return "".join(parts) + "</svg>"


def _log_ticks(low: float, high: float) -> list[float]:
    # Ticks at 1, 2 and 5 of each decade, or at whole decades where these would be too many.
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    fine = [m * 10.0**k for k in decades for m in (1, 2, 5) if low <= m * 10.0**k <= high]
    whole = [10.0**k for k in decades if low <= 10.0**k <= high]
    return whole if len(fine) > 7 else fine


def _step_ticks(low: float, high: float) -> list[float]:
    step = max(1, math.ceil((high - low) / 8))
    return [low + k * step for k in range(int((high - low) / step) + 1)]


def _spread(heights: list[float], gap: float = 14.0) -> list[float]:
    # Heights of the labels at the lines' ends, moved downwards where they would overlap.
    placed = list(heights)
    previous = -math.inf
    for index in sorted(range(len(heights)), key=lambda k: heights[k]):
        placed[index] = max(heights[index], previous + gap)
        previous = placed[index]
    return placed
