"""Benchmark of numerical stability: extreme parameter sets as lanes of one kernel, formulas against float64, and
difficult scenes.

Every set is a slab of two layers with its own media, thicknesses, faces and source, traced with all derivatives. Paths
are cut after a largest number of flights; the energy that they still carry is reported.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from services.bench import Row
from services.bench.stability.corners import REGIONS, SMOOTH, Corners, draw
from services.bench.stability.difficult_scenes import check_scene, scenes
from services.bench.stability.formula_errors import FORMULAS, worst_by_region
from services.slab.simulate import specular_share
from services.transport.boundary.smooth import Smooth
from services.transport.optics import fresnel
from services.transport.optics.parameters import MEDIUM_FIELDS
from services.transport.paths.scores import Plan
from services.transport.paths.starts import PathStart, SlabStart, stream
from services.transport.paths.walk import Walk
from services.transport.platform import prepare_device
from services.transport.scene.geometry import SlabGeometry
from services.transport.scene.media import Media, Score

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PATHS = 64
WHITE = "alpha = 1"
"""Name of the sets without any absorption, from which all light must come back; they also belong to other regions."""


class StabilityRow(Row):
    """One region of parameter space, or one scene.

    ``error`` is a formula's largest relative error, else the relative standard error of the result.
    """

    region: str
    quantity: str
    sets: int
    non_finite: int
    """Number of values that are NaN or infinite."""
    bound: float | None = None
    """Largest allowed ``error``."""
    cut: float | None = None
    """Fraction of the entering light that was still on its way when paths were cut."""
    gain: float | None = None
    """R + T + cut minus the entering light, per incident flux; within its error never above zero, and zero in white
    sets."""
    gain_error: float | None = None
    """Standard error of ``gain``."""
    negative: int | None = None
    """Number of lights whose image is significantly below zero."""
    z: float | None = None
    """Difference of a scene from one that must have equal images, in standard errors."""


class LaneFaces(Smooth):
    """Flat faces of all three models in one kernel; an index of 1 makes a lane's faces matched."""

    def __init__(self, corners: Corners) -> None:
        self.ior = mi.Float(corners.ior.astype(np.float32))
        self.bends = mi.Bool(corners.boundary == SMOOTH)

    def reflectance_inside(self, cosine: mi.Float) -> mi.Float:
        """Reflectance of a smooth or of a thin face: the first is, seen from inside, a face of index 1 / n."""
        return fresnel.reflectance(cosine, dr.select(self.bends, dr.rcp(self.ior), self.ior))

    def enter(self, cosine: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Weight and inner cosine of light that enters a smooth or a thin face."""
        weight, inside = super().enter(cosine)
        return weight, dr.select(self.bends, inside, cosine)


class LaneStart(SlabStart):
    """Starts of random walks in slabs whose source and faces differ from lane to lane."""

    def __init__(self, corners: Corners, seed: int) -> None:
        self.rows, self.seed = len(corners), dr.opaque(mi.UInt32, seed)
        self.boundary = LaneFaces(corners)
        self.normal = mi.Bool(~corners.diffuse)

    def begin(self, row: mi.UInt32, sample: mi.UInt32, active: mi.Bool) -> PathStart:  # noqa: ARG002 - views need the mask
        """Begin a walk, as ``SlabStart`` does."""
        rng = stream(self.seed, row, sample)
        cosine = dr.select(self.normal, 1, dr.sqrt(1 - rng.next_float32()))
        weight, inside = self.boundary.enter(cosine)
        omega = mi.Vector3f(dr.sqrt(dr.maximum(1 - dr.square(inside), 0)), 0, inside)
        return PathStart(rng, mi.Point3f(0), omega, mi.UInt32(1), weight)


@dataclass(frozen=True)
class LaneTotals:
    """Results per incident flux: ``totals`` (N, 3) of reflected, transmitted and cut light, and ``derivatives``
    (F, N, 2) of the first two.
    """

    totals: NDArray[np.float64]
    derivatives: NDArray[np.float64]

    def non_finite(self) -> NDArray[np.int64]:
        """Return for each set the number (N,) of values that are NaN or infinite."""
        return np.asarray(
            np.count_nonzero(~np.isfinite(self.totals), axis=1)
            + np.count_nonzero(~np.isfinite(self.derivatives), axis=(0, 2))
        )


def stress_plan(most_steps: int, *, gradient: bool = True) -> Plan:
    """Return the plan with all features of a slab kernel: all scores of both layers, the moving border, faces."""
    scores = tuple(Score(k, field) for k in (1, 2) for field in MEDIUM_FIELDS) if gradient else ()
    return Plan(scores=scores, shape=0 if gradient else None, faces=True, most_steps=most_steps)


def trace(corners: Corners, *, paths: int, most_steps: int, seed: int, gradient: bool = True) -> LaneTotals:
    """Trace all sets at once, one lane each, with at most ``most_steps`` flights per path."""
    geometry = SlabGeometry(tuple(corners.width_mm), moving_border=True)
    start, plan = LaneStart(corners, seed), stress_plan(most_steps, gradient=gradient)
    walk = Walk(geometry, Media(corners.media()), None, start, plan, start.boundary)
    totals, derivatives = walk.run(paths).arrays()
    return LaneTotals(totals / paths, np.array(derivatives).reshape(-1, *totals.shape)[:, :, :2] / paths)


def run(*, quick: bool) -> list[dict[str, Any]]:
    """Return rows of formulas by region, of the walk by region, and of difficult scenes, and print their tables to
    standard error.
    """
    prepare_device()
    corners = draw(2200 if quick else 12_100, seed=1)
    rows = (
        formula_rows(corners)
        + walk_rows(corners, most_steps=256 if quick else 16_384)
        + scene_rows(samples=64 if quick else 4096)
    )
    print(as_table(rows), file=sys.stderr)
    return [row.model_dump() for row in rows]


def picture(rows: list[dict[str, Any]]) -> Figure:
    """Draw every formula's errors in all regions with its bound, and the errors of regions and of scenes against run
    time, without lines because the points are different cases.
    """
    from services.bench.plots import draw_errors, grid

    figure, (formulas, walk, scenes) = grid(3)
    of = {
        part: [row for row in rows if row["benchmark"] == f"stability-{part}"] for part in ("formula", "walk", "scene")
    }
    names = [row["quantity"] for row in of["formula"]]
    formulas.plot(
        names, [row["error"] for row in of["formula"]], "o", color="C0", markersize=5, label="worst of each region"
    )
    formulas.plot(names, [row["bound"] for row in of["formula"]], "_", color="C1", markersize=24, label="bound")
    formulas.set(yscale="log", ylabel="relative error", title="stability-formula")
    formulas.tick_params(axis="x", rotation=90)
    formulas.legend(fontsize=8)
    for axes, part in ((walk, "walk"), (scenes, "scene")):
        draw_errors(axes, of[part], lines=False)
        axes.set_title(f"stability-{part}")
    return figure


def formula_rows(corners: Corners, seed: int = 2) -> list[StabilityRow]:
    """Return the rows of the largest relative error of every formula in every region."""
    begun = time.perf_counter()
    worst, broken = worst_by_region(corners, seed)
    seconds = (time.perf_counter() - begun) / worst.size
    return [
        StabilityRow(
            benchmark="stability-formula", peer="dentine", seconds=seconds, error=worst[row, column],
            bound=formula.bound, region=region, quantity=formula.name,
            sets=int(np.count_nonzero(corners.region == column)), non_finite=int(broken[row, column]),
        )
        for row, formula in enumerate(FORMULAS) for column, region in enumerate(REGIONS)
    ]  # fmt: skip


def walk_rows(corners: Corners, *, most_steps: int, seed: int = 3) -> list[StabilityRow]:
    """Return the rows of energy, cut energy and non-finite values of the walk by region, and in the white sets."""
    begun = time.perf_counter()
    lanes = trace(corners, paths=PATHS, most_steps=most_steps, seed=seed)
    seconds = time.perf_counter() - begun
    entering = 1 - np.where(
        corners.diffuse, specular_share(corners.ior, "diffuse"), specular_share(corners.ior, "normal")
    )
    bad = lanes.non_finite()
    rows = []
    for region, here in _parts(corners):
        totals = lanes.totals[here & (bad == 0)]
        gain = totals.sum(axis=1) - entering[here & (bad == 0)]
        gain_error = float(gain.std(ddof=1) / np.sqrt(len(gain)))
        rows.append(
            StabilityRow(
                benchmark="stability-walk", peer="dentine", seconds=seconds * here.mean(),
                error=gain_error / float(entering[here].mean()), region=region, quantity="R + T", sets=int(here.sum()),
                non_finite=int(bad[here].sum()), cut=float(totals[:, 2].mean() / entering[here].mean()),
                gain=float(gain.mean()), gain_error=gain_error,
            )
        )  # fmt: skip
    return rows


def scene_rows(*, samples: int, seed: int = 4) -> list[StabilityRow]:
    """Return the rows of images and derivatives of difficult scenes.

    Raises:
        NonFiniteError: a value is NaN or infinite.
    """
    rows = []
    for scene in scenes():
        begun = time.perf_counter()
        check = check_scene(scene, samples=samples, seed=seed)
        rows.append(
            StabilityRow(
                benchmark="stability-scene", peer="dentine", seconds=time.perf_counter() - begun, error=check.error,
                region=scene.name, quantity="images and derivatives", sets=check.numbers, non_finite=0,
                negative=check.negative, z=check.z,
            )
        )  # fmt: skip
    return rows


def _parts(corners: Corners) -> list[tuple[str, NDArray[np.bool_]]]:
    white = (corners.absorbed == 0).all(axis=0)
    return [(name, np.asarray(corners.region == k)) for k, name in enumerate(REGIONS)] + [(WHITE, np.asarray(white))]


def as_table(rows: list[StabilityRow]) -> str:
    """Return three tables in Markdown: the largest relative error by region and formula, the walk's results by region,
    and the scenes.
    """
    formulas, walks, views = (
        [row for row in rows if row.benchmark == f"stability-{part}"] for part in ("formula", "walk", "scene")
    )
    names = list(dict.fromkeys(row.quantity for row in formulas))
    errors = {(row.region, row.quantity): row.error for row in formulas}
    return "\n\n".join(
        (
            _table(
                ("region", *names), [(region, *(f"{errors[region, name]:.1e}" for name in names)) for region in REGIONS]
            ),
            _table(
                ("region", "sets", "not finite", "cut short", "R + T + cut - entering"),
                [
                    (r.region, r.sets, r.non_finite, f"{r.cut:.1e}", f"{r.gain:+.1e} ± {r.gain_error:.0e}")
                    for r in walks
                ],
            ),
            _table(
                ("scene", "numbers", "not finite", "negative", "z"),
                [(r.region, r.sets, r.non_finite, r.negative, "" if r.z is None else f"{r.z:.1f}") for r in views],
            ),
        )
    )


def _table(head: tuple[str, ...], body: list[tuple[Any, ...]]) -> str:
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in (head, ("---",) * len(head), *body))
