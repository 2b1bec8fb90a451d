"""Benchmark of slab totals and their derivatives: error against run time. No peer renders infinite slabs, so none is
timed.
"""

from __future__ import annotations

import time
from typing import Any

from services.bench import Row
from services.slab.simulate import Layer, simulate_slab

CASES = {
    "slab-clear": (Layer(sigma=2, alpha=0.9, g1=0.75, thickness_mm=1), 1.0),
    "slab-enamel": (Layer(sigma=6, alpha=0.98, g1=0.96, thickness_mm=1), 1.631),
    "slab-dense": (Layer(sigma=10, alpha=0.99, g1=0.8, thickness_mm=1), 1.0),
}


def run(*, quick: bool) -> list[dict[str, Any]]:
    """Return rows of totals and of derivatives for decreasing requested errors; the compilation of kernels does not
    count as run time.
    """
    rows = []
    for name, (layer, ior) in CASES.items():
        for gradient in (False, True):
            options: dict[str, Any] = {"ior": ior, "boundary": "smooth" if ior > 1 else "matched"}
            simulate_slab((layer,), **options, rel_error=0.05)
            for rel_error in (1e-2, 3e-3) if quick else (1e-2, 3e-3, 1e-3, 3e-4):
                if gradient and (quick or rel_error != 1e-2):
                    continue
                begun = time.perf_counter()
                result = simulate_slab((layer,), **options, rel_error=rel_error, gradient=gradient)
                error = max(result.R_se / result.R, result.T_se / max(result.T, 1e-3))
                rows.append(
                    Row(
                        benchmark=f"{name}{'-gradient' if gradient else ''}",
                        peer="dentine",
                        seconds=time.perf_counter() - begun,
                        error=error,
                    )
                )
    return [row.model_dump() for row in rows]
