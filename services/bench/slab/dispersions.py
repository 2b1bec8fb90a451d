"""``dentine bench slab-mie``: the whole measurement of nano-dispersions of known particle size (Gkioulekas et al. 2013,
6.3).

The dispersions are polystyrene spheres in water, whose phase function and scattering cross-section Lorenz-Mie theory
gives, so the truth comes from physics. Each dispersion is diluted to sigma_t w near 2, where a cell's images contain
most information; three are also measured undiluted, at 1 % by weight.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from services.bench.slab.cell import near_beam_folder
from services.bench.slab.recovery import Truth, photographed, recovered
from services.core.errors import InputError
from services.core.slab.folder import SlabFolder

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

DIAMETERS_NM = (200.0, 500.0, 800.0)
COLOURS = {
    "R": (635.0, 1.58782, 1.33170),
    "G": (533.0, 1.59807, 1.33499),
    "B": (488.0, 1.60515, 1.33704),
}
"""For each colour the wavelength in nm, and the refractive indices of polystyrene and water at it."""
VOLUME_FRACTION = 0.01 / 1.05
"""Volume fraction of polystyrene at 1 % by weight, with its density of 1.05 g/cm3."""
BEST_THICKNESS = 2.0
"""Optical thickness sigma_t w to which dispersions are diluted."""
DILUTIONS = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02)
"""Dilutions that a laboratory makes, as fractions of the full strength."""
THICK = (("R", 200.0), ("G", 200.0), ("B", 200.0))
"""Colours and diameters in nm of the dispersions that are also measured undiluted: sigma_t w is 5 to 12."""
PHOTONS, QUICK_PHOTONS = 4_000_000, 200_000
"""Number of photons of each image."""

Keep = Callable[[list[dict[str, Any]]], None]


def mie_truth(diameter_nm: float, colour: str, dilution: float, folder: SlabFolder) -> Truth:
    """Return the medium of spheres of one diameter in water by Lorenz-Mie theory."""
    import miepython

    wavelength_nm, sphere, water = COLOURS[colour]
    size = math.pi * diameter_nm * water / wavelength_nm
    relative = complex(sphere / water, 0.0)
    efficiency = float(np.ravel(miepython.efficiencies_mx(relative, size)[1])[0])
    # Scattering coefficient: the cross-section of a sphere times the number of spheres per volume, which is 3/2 of the
    # efficiency times the volume fraction, divided by the diameter.
    full_per_mm = 1.5 * efficiency * VOLUME_FRACTION / (diameter_nm * 1e-6)

    def phase(angles_rad: Array) -> Array:
        return np.asarray(miepython.i_unpolarized(relative, size, np.cos(angles_rad), norm="one"), dtype=np.float64)

    name = f"{diameter_nm:g} nm {colour}, {100 * dilution:g} % strength"
    return Truth(name, folder, full_per_mm * dilution, 0.0, phase)


def truths() -> list[Truth]:
    """Return all nine dispersions at the dilution nearest to the best thickness, and the undiluted ones."""
    folder = near_beam_folder()
    every = []
    for diameter_nm in DIAMETERS_NM:
        for colour in COLOURS:
            options = [mie_truth(diameter_nm, colour, dilution, folder) for dilution in DILUTIONS]
            every.append(min(options, key=lambda one: abs(math.log(one.thickness / BEST_THICKNESS))))
    return every + [mie_truth(diameter_nm, colour, 1.0, folder) for colour, diameter_nm in THICK]


def run(*, quick: bool, case: str | None = None, keep: Keep = lambda _: None) -> list[dict[str, Any]]:
    """Return one row per dispersion; ``case`` selects those whose name begins with it, such as "500 nm G"."""
    chosen = [one for one in truths() if case is None or one.name.startswith(case)]
    if not chosen:
        raise InputError(f"No dispersion is named {case}; known are {', '.join(one.name for one in truths())}.")
    rows: list[dict[str, Any]] = []
    for number, truth in enumerate(chosen[:1] if quick else chosen):
        images, variances = photographed(truth, QUICK_PHOTONS if quick else PHOTONS, seed=101 + number)
        rows.append(recovered(truth, images, variances, seed=11 + number).model_dump())
        keep(rows)
    return rows


def picture(rows: list[dict[str, Any]]) -> Figure:
    """Draw the errors of sigma_s and of the phase function beside their bounds."""
    from services.bench.plots import grid

    figure, (scattering, phase) = grid(2)
    names = [row["benchmark"] for row in rows]
    places = np.arange(len(rows))
    of_scattering = [row["numbers"]["sigma_s"] for row in rows]
    errors = [100 * abs(one["value"] / one["truth"] - 1) for one in of_scattering]
    bounds = [100 * one["bound"] / one["truth"] for one in of_scattering]
    for axes, found, allowed, title in (
        (scattering, errors, bounds, "σs"),
        (phase, [100 * row["error"] for row in rows], [100 * row["phase_bound"] for row in rows], "phase function, L2"),
    ):
        axes.plot(found, places, "o", label="error")
        axes.plot(allowed, places, "|", markersize=14, color="C1", label="bound")
        axes.set(
            xscale="log", xlabel="per cent", title=title, yticks=places, yticklabels=names if axes is scattering else []
        )
        axes.invert_yaxis()
        axes.grid(visible=True, alpha=0.25)
        axes.legend(fontsize=8)
    return figure
