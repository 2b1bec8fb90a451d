"""``dentine bench slab-novel``: prediction of images of cells and angles that a fit has not seen (Gkioulekas et al.
2013, 6.4).

A dispersion is measured in one cell by images of plain photons. Images of other cells under other beams are then
predicted from the fitted medium and compared with images of the true medium. Both come from the fit's own random walk,
which is compared with independent walks elsewhere, so the images differ only by the medium.
"""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from services.bench import Row
from services.bench.slab.cell import near_beam_folder
from services.bench.slab.dispersions import Keep, mie_truth
from services.bench.slab.recovery import fitted, photographed, squared_share
from services.core.slab.folder import SlabFolder
from services.slab.cell.dictionary import Material
from services.slab.cell.forward import render
from services.slab.cell.rig import rig_of
from services.slab.results.result import SlabFit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

DIAMETER_NM, COLOUR, DILUTION = 500.0, "G", 0.05
"""The dispersion: sigma_t w is 1.6 in the measured cell, and 8 in the widest predicted cell."""
PHOTONS, QUICK_PHOTONS = 1_000_000, 50_000
"""Number of photons of each fitted image."""
ANGLES_DEG = (10.0, 20.0)
"""Angles of the predicted beams; the fitted beams have 5, 15 and 25."""
WIDTHS_MM = (1.0, 2.5, 5.0)
BATCHES, PATHS, QUICK_PATHS = 8, 25_000, 1000


class NovelRow(Row):
    """One cell. ``error`` is the relative L2 difference of its images without their noise, and 0 where its estimated
    square is negative.
    """

    width_mm: float
    lights: str
    squared: float
    """Estimated square of the error, which noise may make negative."""
    squared_se: float
    """Standard error of ``squared``."""


def run(*, quick: bool, keep: Keep = lambda _: None) -> list[dict[str, Any]]:
    """Return a row for the fitted cell, and one for each predicted cell."""
    truth = mie_truth(DIAMETER_NM, COLOUR, DILUTION, near_beam_folder())
    images, variances = photographed(truth, QUICK_PHOTONS if quick else PHOTONS, seed=301)
    begun = time.process_time()
    found = medium_of_fit(fitted(truth, images, variances, seed=41))
    seconds = time.process_time() - begun
    rows: list[dict[str, Any]] = []
    for folder in (truth.folder, *(novel_folder(width_mm) for width_mm in WIDTHS_MM)):
        squared, spread = squared_error(folder, found, truth.material(), QUICK_PATHS if quick else PATHS)
        rows.append(
            NovelRow(
                benchmark="slab-novel",
                peer="dentine",
                seconds=seconds,
                error=math.sqrt(max(squared, 0.0)),
                width_mm=folder.cell.width_mm,
                lights=", ".join(f"{light.angle_deg:g}" for light in folder.lights),
                squared=squared,
                squared_se=spread,
            ).model_dump()
        )
        keep(rows)
    return rows


def picture(rows: list[dict[str, Any]]) -> Figure:
    """Draw the squared error of each cell's images with its standard error, as noise makes some of them negative."""
    from services.bench.plots import grid

    figure, (axes,) = grid(1)
    squared, spread = (100**2 * np.array([row[key] for row in rows]) for key in ("squared", "squared_se"))
    axes.errorbar(range(len(rows)), squared, spread, fmt="o", capsize=3)
    names = [f"{row['width_mm']:g} mm, beams {row['lights']}°" for row in rows]
    axes.set_xticks(range(len(rows)), names, rotation=20, ha="right", fontsize=8)
    axes.axhline(2**2, color="0.5", linestyle=":", label="an error of 2 %")
    axes.legend(fontsize=8)
    axes.set(ylabel="squared error of images, (%)²", title="the fitted cell, then cells it has not seen")
    axes.grid(alpha=0.25)
    return figure


def novel_folder(width_mm: float) -> SlabFolder:
    """Return the benchmarks' cell with another width and other beams."""
    lights = [{"name": f"n{k}", "side": "front", "angle_deg": angle} for k, angle in enumerate(ANGLES_DEG)]
    return near_beam_folder(cell={"width_mm": width_mm, "index": 1.33}, lights=lights)


def medium_of_fit(fit: SlabFit) -> Material:
    """Return the medium of a fit's result."""
    known = fit.parameters
    return Material(known.sigma_s.value * np.array(fit.phase.value_per_sr), known.sigma_a.value)


def squared_error(folder: SlabFolder, found: Material, true: Material, paths: int) -> tuple[float, float]:
    """Return the squared difference of all images divided by the sum of their squares, and its standard error."""
    rig = rig_of(folder, folder.wavelengths_nm[0])
    ours, theirs = (
        render(rig, medium, seed=seed, step=0, batches=BATCHES, paths=paths, scores=False).images.reshape(BATCHES, -1)
        for medium, seed in ((found, 71), (true, 72))
    )
    return squared_share(ours - theirs, float((theirs.mean(axis=0) ** 2).sum()))
