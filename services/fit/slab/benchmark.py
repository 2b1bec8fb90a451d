"""How fast slab totals become certain, with their deviation from published values beside it."""

from __future__ import annotations

import time
from typing import Any

from services.fit.slab.simulate import Layer, simulate_slab

PUBLISHED = {"R": 0.09739, "T": 0.66096}
"""Normal incidence, albedo 0.9, g = 0.75, optical thickness 2: van de Hulst 1980, Table 35."""
LAYERS = (Layer(sigma=2.0, alpha=0.9, g1=0.75, thickness_mm=1.0),)


def run(*, quick: bool) -> dict[str, Any]:
    """Simulate one slab twice, the first time to compile; figures are of the second."""
    rel_error = 1e-3 if quick else 2e-4
    simulate_slab(LAYERS, rel_error=0.1, seed=1)
    started = time.perf_counter()
    result = simulate_slab(LAYERS, rel_error=rel_error, seed=2)
    seconds = time.perf_counter() - started
    figures: dict[str, Any] = {"rel_error": rel_error, "seconds": seconds, "paths": result.paths, "paths_per_second": result.paths / seconds}
    for name, published in PUBLISHED.items():
        value, error = getattr(result, name), getattr(result, f"{name}_se")
        figures[name] = {"value": value, "se": error, "published": published, "deviation_in_se": (value - published) / error}
    return figures
