"""Benchmark of an incisor's images under all lights of a dome: one walk for all lights against stock ``prbvolpath``
light by light.

Efficiency is 1 / (variance x time) with variance = sum of the pixels' variances / sum of their squares, both measured
in the same run with equal numbers of threads. The peer renders some of the lights, and its time is scaled to all.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.bench import Row
from services.bench.transport.incisor_stack import TISSUE, IncisorStack, incisor_stack
from services.transport.engine import Engine
from services.transport.scene.recipe import View


def run(*, quick: bool) -> list[dict[str, Any]]:
    """Return rows of this engine and of the peer at increasing paths per pixel, and the peer's summary row."""
    stack, peer_lights = incisor_stack(18 if quick else 54), 2 if quick else 6
    engine = Engine(stack.recipe())
    view = stack.tooth_view(engine, TISSUE)

    rows, ours = [], []
    for samples in (64, 256) if quick else (64, 256, 1024):
        begun = time.perf_counter()
        estimate = engine.images(TISSUE, view, samples=samples, seed=samples)
        rows.append(_row("dentine", time.perf_counter() - begun, estimate.mean, estimate.variance))
        ours.append(rows[-1])
    peers: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        counts = (64,) if quick else (64, 256)
        peers.extend(_peer(Path(folder), stack, view, peer_lights, samples) for samples in counts)
    rows += peers
    efficiency = [np.mean([1 / (row.seconds * row.error**2) for row in group]) for group in (ours, peers)]
    rows.append(
        peers[-1].model_copy(
            update={"benchmark": "transport-stack-summary", "efficiency_ratio": float(efficiency[0] / efficiency[1])}
        )
    )
    return [row.model_dump() for row in rows]


def _peer(folder: Path, stack: IncisorStack, view: View, count: int, samples: int) -> Row:
    from services.assets.mitsuba.scene import render_batches

    seconds, mean, variance = 0.0, [], []
    x, y = view.pixels.T
    for light in stack.some_lights(count):
        scene = stack.stock_scene(folder, TISSUE, int(light), samples // 16)
        render_batches(scene, 0, 16, seed=1, batches=2)
        begun = time.perf_counter()
        image, spread = render_batches(scene, 0, samples, seed=2)
        seconds += time.perf_counter() - begun
        mean.append(image[y, x])
        variance.append(spread[y, x])
    return _row(
        "mitsuba-prbvolpath", seconds * len(stack.light_positions_mm) / count, np.array(mean), np.array(variance)
    )


def _row(peer: str, seconds: float, mean: NDArray[np.float64], variance: NDArray[np.float64]) -> Row:
    return Row(
        benchmark="transport-stack",
        peer=peer,
        seconds=seconds,
        error=float(np.sqrt(variance.sum()) / np.linalg.norm(mean)),
    )
