"""Exponentials of free flights, in forms that hold in float32."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def one_minus_exp(x: mi.Float) -> mi.Float:
    """1 - exp(-x), without cancellation for small x."""
    return dr.select(x < 0.05, x * (1 - x / 2 * (1 - x / 3 * (1 - x / 4))), 1 - dr.exp(-x))


def minus_log1m(p: mi.Float) -> mi.Float:
    """-log(1 - p), without cancellation for small p."""
    return dr.select(p < 0.02, p * (1 + p * (1 / 2 + p * (1 / 3 + p / 4))), -dr.log(1 - p))
