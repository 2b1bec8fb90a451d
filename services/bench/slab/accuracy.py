"""``dentine bench slab-map``: attainable accuracy of a cell's measurement over thickness, albedo and phase function
(Gkioulekas et al. 2013, figure 6).

The Cramér-Rao bound is computed on a grid, each point at a fraction of a fit's cost. Real fits of images by plain
photons at twelve points spread over the grid check the map.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from services.bench import Row
from services.bench.slab.cell import near_beam_folder
from services.bench.slab.dispersions import Keep
from services.bench.slab.recovery import FINE_RAD, NOISE, Truth, photographed, recovered
from services.core.errors import InputError
from services.slab.cell.dictionary import ANGLES_RAD, hg_values
from services.slab.cell.rig import rig_of
from services.slab.design.bound import bound_of
from services.slab.solve.uncertainty import slopes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

THICKNESSES = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 20.0)
"""Optical thicknesses sigma_t w of the grid."""
ALBEDOS = (0.1, 0.3, 0.5, 0.7, 0.9, 0.97, 1.0)
"""Albedos of the grid."""
GOLDEN = 0.6180339887498949
"""Fraction of the golden ratio: steps of this fraction of a range fill it evenly with any number of points."""
FITS = 12
"""Number of real fits."""
FITTED_THICKNESSES, FITTED_ALBEDOS = (0.1, 10.0), (0.3, 1.0)
"""Ranges of optical thickness and albedo of the real fits."""
BOUND_PATHS = 2000
PHOTONS = 1_000_000
"""Number of photons of each image."""


PHASES: dict[str, Callable[[Array], Array]] = {
    "isotropic": np.ones_like,
    "HG 0.5": partial(hg_values, 0.5),
    "HG 0.8": partial(hg_values, 0.8),
    "two lobes": lambda angles: 0.7 * hg_values(0.85, angles) + 0.3 * hg_values(-0.3, angles),
}


class BoundRow(Row):
    """One point of the grid. ``error`` is the relative bound of the phase function in L2."""

    thickness: float
    albedo: float
    phase: str
    scattering: float
    """Relative bound of sigma_s."""
    reduced: float
    """Relative bound of sigma_s'."""
    g: float
    """Absolute bound of the mean cosine."""


def bound_row(thickness: float, albedo: float, phase: str, seed: int = 1) -> BoundRow:
    """Compute the bound at one point of the grid."""
    folder = near_beam_folder()
    per_mm = thickness / folder.cell.width_mm
    truth = Truth(phase, folder, albedo * per_mm, (1 - albedo) * per_mm, PHASES[phase])
    material, begun = truth.material(), time.process_time()
    bound = bound_of(rig_of(folder, folder.wavelengths_nm[0]), material, noise=NOISE, seed=seed, paths=BOUND_PATHS)
    slope, true = slopes(material), truth.phase_per_sr()
    of_phase = np.interp(FINE_RAD, ANGLES_RAD, bound.of_phase(material))
    sigma_s = material.scattering_per_mm
    return BoundRow(
        benchmark="slab-bound",
        peer="dentine",
        seconds=time.process_time() - begun,
        error=float(np.sqrt((of_phase**2).sum() / (true**2).sum())),
        thickness=thickness,
        albedo=albedo,
        phase=phase,
        scattering=bound.of(slope["sigma_s"]) / sigma_s,
        reduced=bound.of(slope["sigma_s_reduced"]) / (sigma_s * (1 - material.mean_cosine)),
        g=bound.of(slope["g"]),
    )


def spread_truths() -> list[Truth]:
    """Return the media of the real fits: optical thickness in equal steps of its logarithm, albedo in golden steps, and
    the phase functions in rotation.
    """
    folder, every = near_beam_folder(), []
    (low, high), (least, most) = np.log(FITTED_THICKNESSES), FITTED_ALBEDOS
    for number, phase in zip(range(FITS), list(PHASES) * FITS, strict=False):
        thickness = float(np.exp(low + (high - low) * (number + 0.5) / FITS))
        albedo = least + (most - least) * ((number + 1) * GOLDEN % 1)
        per_mm = thickness / folder.cell.width_mm
        name = f"{phase}, σt·w {thickness:.2g}, albedo {albedo:.2f}"
        every.append(Truth(name, folder, albedo * per_mm, (1 - albedo) * per_mm, PHASES[phase]))
    return every


def run(*, quick: bool, case: str | None = None, keep: Keep = lambda _: None) -> list[dict[str, Any]]:
    """Return the rows of bounds and of fits.

    Args:
        quick: compute a few points only.
        case: "bounds" or "fits" for one kind of rows; both by default.
        keep: called with all rows so far after every few new ones.
    """
    if case not in (None, "bounds", "fits"):
        raise InputError(f"slab-map has no case {case}; known are bounds and fits.")
    rows: list[dict[str, Any]] = []
    if case != "fits":
        for phase in list(PHASES)[:1] if quick else PHASES:
            for thickness in THICKNESSES[3:4] if quick else THICKNESSES:
                rows += [bound_row(thickness, albedo, phase).model_dump() for albedo in ALBEDOS]
                keep(rows)
    if case != "bounds":
        for number, truth in enumerate(spread_truths()[4:5] if quick else spread_truths()):
            images, variances = photographed(truth, PHOTONS // (10 if quick else 1), seed=201 + number)
            rows.append(recovered(truth, images, variances, seed=31 + number).model_dump())
            keep(rows)
    return rows


def picture(rows: list[dict[str, Any]]) -> Figure:
    """Draw the bounds, the largest over the phase functions, as maps over albedo and thickness, and the fits' errors as
    numbers on them.
    """
    from matplotlib.colors import LogNorm

    from services.bench.plots import grid

    figure, panels = grid(3)
    bounds = [row for row in rows if row["benchmark"] == "slab-bound"]
    fits = [row for row in rows if row["benchmark"] != "slab-bound"]
    shown = (("reduced", "σs′, %", 100.0), ("g", "g, hundredths", 100.0), ("error", "phase function, L2 %", 100.0))
    for axes, (name, title, scale) in zip(panels, shown, strict=True):
        worst = np.full((len(THICKNESSES), len(ALBEDOS)), np.nan)
        for row in bounds:
            at = THICKNESSES.index(row["thickness"]), ALBEDOS.index(row["albedo"])
            worst[at] = np.nanmax([worst[at], scale * row[name]])
        if bounds:
            drawn = axes.imshow(worst, origin="lower", cmap="viridis_r", norm=LogNorm(0.1, 100), aspect="auto")
            figure.colorbar(drawn, ax=axes)
        for row in fits:
            x = np.interp(row["albedo"], ALBEDOS, np.arange(len(ALBEDOS)))
            y = np.interp(np.log(row["thickness"]), np.log(THICKNESSES), np.arange(len(THICKNESSES)))
            axes.text(x, y, f"{scale * _error(row, name):.2g}", ha="center", va="center", fontsize=8, color="white",
                      bbox={"facecolor": "black", "alpha": 0.6, "pad": 1.5, "edgecolor": "none"})  # fmt: skip
        axes.set(title=title, xlabel="albedo", ylabel="σt·w")
        axes.set_xticks(np.arange(len(ALBEDOS)), [f"{albedo:g}" for albedo in ALBEDOS])
        axes.set_yticks(np.arange(len(THICKNESSES)), [f"{thickness:g}" for thickness in THICKNESSES])
    kinds = ["bounds (colour)"] * bool(bounds) + ["errors of fits (numbers)"] * bool(fits)
    figure.suptitle(" and ".join(kinds))
    return figure


def _error(row: dict[str, Any], name: str) -> float:
    if name == "error":
        return float(row["error"])
    number = row["numbers"]["g" if name == "g" else "sigma_s_reduced"]
    return float(abs(number["value"] - number["truth"]) / (1 if name == "g" else number["truth"]))
