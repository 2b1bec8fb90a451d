"""Benchmark of the lanes' queue: the walk as it is, against the same walk with one row of the tally for each lane.

The scene is an incisor under 41 lights, with the 5 to 128 paths per pixel of a fit's blocks. Images, Jacobians and
their errors are equal to the bit, so the ratio of times is the gain. Times are medians over interleaved pairs of the
processor time of all threads; kernels are compiled before.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from services.bench import Row
from services.bench.transport.incisor_stack import TISSUE, incisor_stack
from services.fit.coordinates.domain import similar_tissue
from services.transport.engine import Engine
from services.transport.lighting.lights import PointLights
from services.transport.optics.parameters import Tissue
from services.transport.paths.scores import Plan
from services.transport.paths.starts import CameraStart
from services.transport.paths.walk import Walk
from services.transport.scene.media import Media
from services.transport.scene.recipe import JacobianEstimate, StackEstimate, View

LIGHTS = 41
SAMPLES = (5, 10, 21, 64, 128)
PAIRS = 6
NAMES = ("enamel.sigma", "enamel.alpha", "dentin.sigma", "dentin.alpha")
SIMILAR_COSINE = 0.5
"""Mean cosine of the similar media in which a fit takes its first steps."""
PEER = "one row for each lane"

Call = Callable[[Engine, View, int, int], StackEstimate | JacobianEstimate]
"""Function (engine, view, samples, seed) -> estimate."""


class LanesRow(Row):
    """A row with the paths of its calls."""

    samples: int
    """Paths per pixel that were traced: those asked for, rounded up to whole batches."""
    seconds_per_path: float
    time_ratio: float | None = None
    """Median over the pairs of the time with one row for each lane, divided by the time with the queue."""


class FixedLanes(Engine):
    """An engine in which every lane walks one row and no more."""

    def _walk(self, media: Media, lights: PointLights, start: CameraStart, plan: Plan) -> Walk:
        start.fixed_lanes = True
        return super()._walk(media, lights, start, plan)


def calls(tissue: Tissue = TISSUE) -> Mapping[str, Call]:
    """Return the calls of a fit's blocks: images in its own and in similar media, and the Jacobian of those."""
    similar = similar_tissue(tissue, SIMILAR_COSINE)
    return MappingProxyType(
        {
            "images": lambda engine, view, samples, seed: engine.images(tissue, view, samples=samples, seed=seed),
            "similar images": lambda engine, view, samples, seed: engine.images(
                similar, view, samples=samples, seed=seed
            ),
            "Jacobian": lambda engine, view, samples, seed: engine.jacobian(
                similar, view, NAMES, samples=samples, seed=seed
            ),
        }
    )


def run(*, quick: bool) -> list[dict[str, Any]]:
    """Return for each call and number of paths a row with the queue, and the peer's row with the ratio."""
    stack = incisor_stack(LIGHTS)
    engines = Engine(stack.recipe()), FixedLanes(stack.recipe())
    view = stack.tooth_view(engines[0], TISSUE)
    rows: list[LanesRow] = []
    for name, call in calls().items():
        for engine in engines:
            call(engine, view, SAMPLES[0], 0)
        for samples in SAMPLES[:2] if quick else SAMPLES:
            rows += _compare(f"transport-lanes {name}", call, engines, view, samples, 2 if quick else PAIRS)
    return [row.model_dump() for row in rows]


def _compare(
    benchmark: str, call: Call, engines: tuple[Engine, Engine], view: View, samples: int, pairs: int
) -> tuple[LanesRow, LanesRow]:
    seconds = np.zeros((pairs, 2))
    for pair in range(pairs):
        estimates = {}
        for which in (0, 1) if pair % 2 else (1, 0):
            begun = time.process_time()
            estimates[which] = call(engines[which], view, samples, pair + 1)
            seconds[pair, which] = time.process_time() - begun
        np.testing.assert_array_equal(estimates[0].mean, estimates[1].mean)
    estimate = estimates[0]
    error = float(np.sqrt(estimate.variance.sum() / np.sum(estimate.mean**2)))
    ours, theirs = (
        LanesRow(
            benchmark=benchmark, peer=peer, seconds=median, error=error, samples=estimate.samples,
            seconds_per_path=median / len(view) / estimate.samples,
        )
        for peer, median in zip(("dentine", PEER), np.median(seconds, axis=0).tolist(), strict=True)
    )  # fmt: skip
    ratio = float(np.median(seconds[:, 1] / seconds[:, 0]))
    return ours, theirs.model_copy(update={"time_ratio": ratio, "efficiency_ratio": ratio})
