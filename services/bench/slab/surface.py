"""``dentine bench slab-surface``: the error of images over all mixtures of three phase functions (Gkioulekas et al.
2013, figure 5).

The problem is not convex, so the paper examines the surface of the error: if it has a single minimum, at the truth, a
descent cannot end in another one. Images of every mixture are compared with those of the true mixture. Products of
different, independent batches keep the noise of the mixture's images from biasing the squared error.
"""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from services.bench import Row
from services.bench.slab.cell import near_beam_folder
from services.bench.slab.dispersions import Keep
from services.bench.slab.recovery import squared_share
from services.slab.cell.dictionary import Material, hg_values
from services.slab.cell.forward import render
from services.slab.cell.rig import Rig, rig_of
from services.slab.solve.mixture import unit_atoms

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

COSINES = (0.8, 0.0, -0.5)
"""Mean cosines of the three HG phase functions: forward, isotropic and backward scattering."""
EXTINCTIONS_PER_MM = (0.5, 2.0, 8.0)
ALBEDO = 0.98
TRUTHS = ((6, 2, 2), (2, 4, 4))
"""Weights of the true mixtures, in tenths."""
STEPS, QUICK_STEPS = 10, 5
"""Number of steps of the grid along each edge of the triangle of weights."""
BATCHES, PATHS = 8, 1000
"""Number of batches of each mixture, and paths of each; the truth's images have sixteen times as many paths."""


class SurfaceRow(Row):
    """One mixture.

    ``error`` is the relative L2 difference of its images without the walk's noise, and 0 where its estimated square is
    negative.
    """

    extinction_per_mm: float
    truth: tuple[float, ...]
    weights: tuple[float, ...]
    squared: float
    """Estimated square of the error, which noise may make negative."""
    squared_se: float
    """Standard error of ``squared``."""


def mixture_of(weights: tuple[float, ...], extinction_per_mm: float) -> Material:
    """Return the medium of weights that add up to one."""
    phase = unit_atoms(np.stack([hg_values(g) for g in COSINES], axis=1)) @ np.array(weights)
    return Material(ALBEDO * extinction_per_mm * phase, (1 - ALBEDO) * extinction_per_mm)


def mixtures(steps: int) -> list[tuple[int, int, int]]:
    """Return all points of the grid on the simplex, as numbers of steps that add up to ``steps``."""
    return [
        (first, second, steps - first - second) for first in range(steps + 1) for second in range(steps + 1 - first)
    ]


def run(*, quick: bool, keep: Keep = lambda _: None) -> list[dict[str, Any]]:
    """Return one row per truth, extinction and mixture."""
    folder, steps = near_beam_folder(), QUICK_STEPS if quick else STEPS
    rig = rig_of(folder, folder.wavelengths_nm[0])
    rows: list[dict[str, Any]] = []
    for extinction in EXTINCTIONS_PER_MM[1:2] if quick else EXTINCTIONS_PER_MM:
        for truth in TRUTHS[:1] if quick else TRUTHS:
            weights = tuple(part / STEPS for part in truth)
            images = _render(rig, mixture_of(weights, extinction), step=0, paths=16 * PATHS).mean(axis=0)
            for number, point in enumerate(mixtures(steps)):
                begun = time.process_time()
                mixed = tuple(part / steps for part in point)
                batches = _render(rig, mixture_of(mixed, extinction), step=number + 1, paths=PATHS)
                residuals = (batches - images).reshape(len(batches), -1)
                squared, spread = squared_share(residuals, float((images**2).sum()))
                rows.append(
                    SurfaceRow(
                        benchmark="slab-surface",
                        peer="dentine",
                        seconds=time.process_time() - begun,
                        error=math.sqrt(max(squared, 0.0)),
                        extinction_per_mm=extinction,
                        truth=weights,
                        weights=mixed,
                        squared=squared,
                        squared_se=spread,
                    ).model_dump()
                )
            keep(rows)
    return rows


def _render(rig: Rig, material: Material, *, step: int, paths: int) -> Array:
    return render(rig, material, seed=17, step=step, batches=BATCHES, paths=paths, scores=False).images


def other_minima(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the mixtures of one surface, except the lowest one, whose neighbours are all higher by more than three
    standard errors.
    """
    at = {row["weights"]: row for row in rows}
    lowest = min(rows, key=lambda row: row["squared"])
    step = min(weight for row in rows for weight in row["weights"] if weight > 0)
    found = []
    for weights, row in at.items():
        near = [
            other
            for place, other in at.items()
            if 0 < sum(abs(a - b) for a, b in zip(place, weights, strict=True)) < 2.5 * step
        ]
        if row is not lowest and all(
            other["squared"] > row["squared"] + 3 * math.hypot(row["squared_se"], other["squared_se"]) for other in near
        ):
            found.append(row)
    return found


def picture(rows: list[dict[str, Any]]) -> Figure:
    """Draw a triangle for each truth and extinction, with contours of the error and a cross at the truth."""
    from services.bench.plots import grid

    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((tuple(row["truth"]), row["extinction_per_mm"]), []).append(row)
    figure, panels = grid(len(groups))
    for axes, ((truth, extinction), points) in zip(panels, groups.items(), strict=True):
        x, y = (np.array([row["weights"][axis] for row in points]) for axis in (0, 1))
        drawn = axes.tricontourf(x, y, [100 * row["error"] for row in points], levels=12, cmap="viridis")
        figure.colorbar(drawn, ax=axes, label="error of images, %")
        axes.plot(*truth[:2], "x", color="white", markersize=10, markeredgewidth=2)
        axes.set(
            title=f"σt = {extinction:g} per mm, {len(other_minima(points))} other minima",
            xlabel=f"weight of HG {COSINES[0]:g}",
            ylabel=f"weight of HG {COSINES[1]:g}",
        )
    return figure
