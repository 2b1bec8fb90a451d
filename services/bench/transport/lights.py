"""Benchmark of the cost of lights and pixels: an incisor under 1 to 155 lights of a dome, and one view of it with 1 to
64 times as many pixels.

The cost of a stack of images is variance x time, with variance = sum of the pixels' variances / sum of their squares
over all images. The peer renders one light at a time: six lights are rendered alone, and their mean cost is multiplied
by the number of lights. Rounds are interleaved, and times are medians over rounds of the processor time of all threads,
which other jobs on the machine change less than time by the clock. The scene is built, its light maps are traced and
kernels are compiled before. Lights that a view does not list are in none of its kernels (see ``transport-skip``).
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from services.bench import Row
from services.bench.transport.incisor_stack import TISSUE, incisor_stack
from services.phantom.dome_rig import dome_cameras
from services.transport.engine import Engine
from services.transport.scene.recipe import View

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LIGHTS = (6, 18, 54, 155)
PIXEL_LIGHTS = 54
SHARES = (64, 16, 4, 1)
"""Divisors of the number of pixels: a view has one in so many of the finest view's pixels."""
PEER = "one light at a time"


class LightsRow(Row):
    """A row with the numbers of lights, pixels and paths per pixel of the render."""

    lights: int
    pixels: int
    samples: int
    seconds_per_path: float
    relative_cost: float | None = None
    """Variance x time of the whole stack, divided by that of one light's image."""


@dataclass
class Case:
    """Views that are rendered one after the other for one result, and their times and errors in each round."""

    engine: Engine
    views: list[View]
    samples: int
    seconds: list[float] = field(default_factory=list)
    """Mean time of one view, by round."""
    squared_errors: list[float] = field(default_factory=list)
    """Squared relative errors of all views together, by round."""

    def measure(self, seed: int) -> None:
        """Measure one round."""
        begun = time.process_time()
        estimates = [self.engine.images(TISSUE, view, samples=self.samples, seed=seed) for view in self.views]
        self.seconds.append((time.process_time() - begun) / len(estimates))
        self.squared_errors.append(
            float(sum(e.variance.sum() for e in estimates) / sum(np.sum(e.mean**2) for e in estimates))
        )

    @property
    def cost(self) -> float:
        """Variance x time."""
        return float(np.mean(self.squared_errors) * np.median(self.seconds))

    def row(self, benchmark: str, one: Case | None = None) -> LightsRow:
        """Return the row of the measured rounds; its cost is relative to that of case ``one``."""
        seconds, view = float(np.median(self.seconds)), self.views[0]
        return LightsRow(
            benchmark=benchmark, peer="dentine", seconds=seconds, error=float(np.sqrt(np.mean(self.squared_errors))),
            lights=len(view.lights or ()), pixels=len(view), samples=self.samples,
            seconds_per_path=seconds / len(view) / self.samples,
            relative_cost=None if one is None else self.cost / one.cost,
        )  # fmt: skip


def run(*, quick: bool) -> list[dict[str, Any]]:
    """Return rows by number of lights, with the peer's summary rows, then rows by number of pixels."""
    stack = incisor_stack(LIGHTS[-1])
    engine = Engine(stack.recipe())
    rounds, counts = (2, (32, 64)) if quick else (5, (64, 256))
    rows = light_rows(engine, stack.tooth_view(engine, TISSUE), counts, rounds)
    finer = replace(stack, camera=dome_cameras(1, 0.25 if quick else 0.125, (stack.outer,))[0])
    rows += pixel_rows(engine, finer.tooth_view(engine, TISSUE), 16 if quick else 32, rounds)
    return [row.model_dump() for row in rows]


def light_rows(engine: Engine, view: View, counts: tuple[int, ...], rounds: int) -> list[LightsRow]:
    """Return rows by number of lights for every number of paths per pixel; costs are given for the largest one."""
    alone = [replace(view, lights=(light,)) for light in spread_lights(LIGHTS[0])]
    groups = [alone, *([replace(view, lights=spread_lights(lights))] for lights in LIGHTS)]
    cases = [[Case(engine, views, samples) for samples in counts] for views in groups]
    _measure([case for group in cases for case in group], rounds)

    one = cases[0][-1]
    rows = [case.row("transport-lights", one if case is group[-1] else None) for group in cases for case in group]
    for lights, group in zip(LIGHTS, cases[1:], strict=True):
        theirs = one.row("transport-lights")
        times = {
            "seconds": theirs.seconds * lights,
            "lights": lights,
            "seconds_per_path": theirs.seconds_per_path * lights,
        }
        ratio = lights * one.cost / group[-1].cost
        rows.append(
            theirs.model_copy(update={"peer": PEER, **times, "relative_cost": float(lights), "efficiency_ratio": ratio})
        )
    return rows


def pixel_rows(engine: Engine, view: View, samples: int, rounds: int) -> list[LightsRow]:
    """Return rows by number of pixels at equal paths per pixel. Smaller numbers are random choices of the finest view's
    pixels, so that each covers the whole tooth.
    """
    order = np.random.default_rng(1).permutation(len(view))
    choices = [order[: len(view) // share] for share in SHARES]
    cases = [
        Case(engine, [View(view.camera, view.pixels[chosen], spread_lights(PIXEL_LIGHTS))], samples)
        for chosen in choices
    ]
    _measure(cases, rounds)
    return [case.row("transport-pixels") for case in cases]


def spread_lights(count: int) -> tuple[int, ...]:
    """Return the indices of so many of the dome's lights, evenly spread from its front to its rim."""
    return tuple(((np.arange(count) + 0.5) * LIGHTS[-1] / count).astype(int).tolist())


def picture(rows: list[dict[str, Any]]) -> Figure:
    """Draw error against run time, cost against number of lights, and time against number of pixels."""
    from services.bench.plots import draw_errors, finish, grid

    figure, (errors, by_lights, by_pixels) = grid(3)
    lights = [row for row in rows if row["benchmark"] == "transport-lights" and row["peer"] != PEER]
    draw_errors(
        errors, [{**row, "stack": f"{row['lights']:3d} light{'s'[: row['lights'] - 1]}"} for row in lights], by="stack"
    )
    errors.set_title("all images together")

    full = [row for row in lights if row["relative_cost"] is not None]
    counts = np.array([row["lights"] for row in full])
    by_lights.plot(counts, counts, "--", color="C1", linewidth=1, label=PEER)
    by_lights.plot(counts, [row["relative_cost"] for row in full], "o-", color="C0", label="variance x time")
    by_lights.plot(
        counts, [row["seconds"] / full[0]["seconds"] for row in full], "s-", color="C2", label="time per path"
    )
    by_lights.set_title("all images, relative to one light")
    finish(by_lights, "lights", "relative to one light")

    finest = [row for row in rows if row["benchmark"] == "transport-pixels"]
    pixels, seconds = np.array([(row["pixels"], row["seconds"]) for row in finest]).T
    by_pixels.plot(
        pixels, seconds, "o-", color="C0", label=f"{PIXEL_LIGHTS} lights, {finest[0]['samples']} paths per pixel"
    )
    by_pixels.plot(pixels, seconds[-1] * pixels / pixels[-1], "--", color="C1", linewidth=1, label="in proportion")
    by_pixels.set_title("one view")
    finish(by_pixels, "pixels", "processor time, s")
    return figure


def _measure(cases: list[Case], rounds: int) -> None:
    for case in cases:
        for view in case.views:
            case.engine.images(TISSUE, view, samples=16, seed=0)
    for seed in range(1, rounds + 1):
        for case in cases:
            case.measure(seed)
