"""``dentine bench slab-solvers``: error against core-seconds for the default solver and the paper's, from the same
start and with the same random walk.

The paper's projected gradient descent (Gkioulekas et al. 2013, Algorithms 1 and 2, corrected) is run at several rates,
because its text gives none. The paper states 9,600 to 19,200 core-hours for a wavelength of its own measurements; the
picture shows the smaller figure as a line.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from services.bench import Row
from services.bench.slab.accuracy import PHASES
from services.bench.slab.cell import near_beam_folder
from services.bench.slab.dispersions import Keep
from services.bench.slab.recovery import FINE_RAD, NOISE, Truth
from services.core.errors import InputError
from services.slab.cell.dictionary import ANGLES_RAD, Material
from services.slab.cell.forward import render
from services.slab.cell.rig import Rig, rig_of
from services.slab.read.images import Measurements, shot_noise
from services.slab.solve.budget import Budget
from services.slab.solve.coordinates import Knots
from services.slab.solve.gauss_newton import GaussNewton
from services.slab.solve.projected_descent import DescentOptions, descend
from services.slab.solve.start import start

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

SCATTERING_PER_MM, ABSORPTION_PER_MM, PHASE = 1.0, 0.03, "HG 0.8"
TRUTH_PATHS, QUICK_TRUTH_PATHS = 8_000_000, 20_000
"""Number of paths per light of the measured images, all eight batches together. Their noise, which cameras share and
the images do not state, is below a tenth of a pixel's 1 %: with 400,000 paths a fit of full effort lost its way."""
EFFORTS, QUICK_EFFORTS = (0.02, 0.1, 0.3, 1.0), (0.02,)
"""Budgets of paths of the default solver, as fractions of its usual one."""
ITERATIONS, QUICK_ITERATIONS = (20, 80, 320), (5,)
"""Numbers of iterations of the paper's solver."""
RATES = (1e-12, 1e-11, 1e-10)
"""Step sizes of the paper's solver: five steps of the largest make the weights unstable (error 0.11 to 0.70), five of
1e-11 hardly change them (0.115)."""
PAPERS_CORE_SECONDS = 9_600 * 3600.0
"""Smallest time that the paper states for one wavelength."""
PAPER = "projected descent"


class SolverRow(Row):
    """One run of one solver. ``error`` is the relative L2 error of the phase function over equal steps of the angle."""

    setting: str
    scattering_error: float
    """Relative error of sigma_s."""
    reduced_error: float
    """Relative error of sigma_s'."""


def measurements_of(truth: Truth, rig: Rig, paths: int, seed: int) -> Measurements:
    """Return images by the solvers' own walk with shot noise of 1 %."""
    image = render(rig, truth.material(), seed=seed, step=0, batches=8, paths=paths // 8, scores=False).mean
    variances = np.stack([shot_noise(one, NOISE) for one in image]) / (2 if rig.grid.folded else 1)
    values = image + np.sqrt(variances) * np.random.default_rng(seed).normal(size=image.shape)
    places = tuple((entry.camera, entry.light) for entry in truth.folder.images)
    return Measurements(values, variances, np.zeros(len(image), dtype=bool), places, assumed_noise=False)


def run(*, quick: bool, case: str | None = None, keep: Keep = lambda _: None) -> list[dict[str, Any]]:
    """Return the rows of both solvers, or of one where ``case`` is "default" or "paper"."""
    if case not in {None, "default", "paper"}:
        raise InputError(f"slab-solvers has no case {case}; known are default and paper.")
    folder = near_beam_folder()
    truth = Truth(PHASE, folder, SCATTERING_PER_MM, ABSORPTION_PER_MM, PHASES[PHASE])
    rig = rig_of(folder, folder.wavelengths_nm[0])
    measured = measurements_of(truth, rig, QUICK_TRUTH_PATHS if quick else TRUTH_PATHS, seed=51)
    begun = time.process_time()
    guess = start(rig, measured, 1, map)
    start_seconds = time.process_time() - begun
    rows: list[dict[str, Any]] = []

    def add(peer: str, setting: str, found: Material, seconds: float) -> None:
        rows.append(compared(truth, found, peer, setting, start_seconds + seconds).model_dump())
        keep(rows)

    add("start", "HG of three numbers", guess, 0.0)
    for effort in () if case == "paper" else QUICK_EFFORTS if quick else EFFORTS:
        begun = time.process_time()
        found = GaussNewton(rig, measured, 1, Budget().scaled(effort), map, Knots()).solve(lambda: guess).material
        add("dentine", f"effort {effort:g}", found, time.process_time() - begun)
    for rate in () if case == "default" else RATES:
        for iterations in QUICK_ITERATIONS if quick else ITERATIONS:
            begun = time.process_time()
            found = descend(rig, measured, guess, 1, DescentOptions(iterations=iterations, rate=rate))
            add(PAPER, f"rate {rate:g}, {iterations} iterations", found, time.process_time() - begun)
    return rows


def compared(
    truth: Truth, found: Material, peer: str, setting: str, seconds: float, benchmark: str = "slab-solvers"
) -> SolverRow:
    """Return the row of one solution."""
    phase, true = truth.phase_per_sr(), truth.material()
    difference = np.interp(FINE_RAD, ANGLES_RAD, found.phase_per_sr) - phase
    reduced, true_reduced = (one.scattering_per_mm * (1 - one.mean_cosine) for one in (found, true))
    return SolverRow(
        benchmark=benchmark,
        peer=peer,
        seconds=seconds,
        error=float(np.sqrt((difference**2).sum() / (phase**2).sum())),
        setting=setting,
        scattering_error=abs(found.scattering_per_mm / truth.scattering_per_mm - 1),
        reduced_error=abs(reduced / true_reduced - 1),
    )


def picture(rows: list[dict[str, Any]]) -> Figure:
    """Draw the errors of the phase function and of sigma_s against core-seconds, and the time that the paper states for
    one wavelength.
    """
    from services.bench.plots import draw_errors, finish, grid

    figure, panels = grid(2)
    for axes, key, title in zip(panels, ("error", "scattering_error"), ("phase function, L2", "σs"), strict=True):
        draw_errors(axes, [row | {"error": row[key]} for row in rows], lines=False)
        axes.axvline(PAPERS_CORE_SECONDS, color="0.5", linestyle=":", label="the paper's 9,600 core-hours")
        axes.set(title=title, xlim=(axes.get_xlim()[0], 2 * PAPERS_CORE_SECONDS))
        finish(axes, "core-seconds", "relative error")
    return figure
