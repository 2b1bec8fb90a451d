"""``dentine bench slab-stock``: an index-matched cell measured by the default solver and by stock Mitsuba.

Stock Mitsuba cannot light a cell through smooth glass, so the boundary is matched (``stock_cell``). The images are
those of plain photons, and both solvers begin at the same medium. With gradients of Mitsuba, Adam changes the
logarithms of the absorption and of the weights of HG lobes, which form one ``tabphase`` with values D w. This smooth
dictionary contains the true lobes or close neighbours of them, so it does not need the prior that the default's 200
knots need.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from services.bench.slab.accuracy import PHASES
from services.bench.slab.dispersions import Keep
from services.bench.slab.recovery import Truth, photographed
from services.bench.slab.solvers import ABSORPTION_PER_MM, EFFORTS, QUICK_EFFORTS, SCATTERING_PER_MM, compared
from services.bench.slab.stock_cell import matched_folder, medium_of, node_angles, scenes, turned
from services.slab.cell.dictionary import Material, hg_values
from services.slab.cell.rig import rig_of
from services.slab.dictionaries.hg import COSINES
from services.slab.read.images import Measurements, folded
from services.slab.solve.budget import Budget
from services.slab.solve.coordinates import Knots
from services.slab.solve.gauss_newton import GaussNewton
from services.slab.solve.mixture import Mixtures, unit_atoms
from services.slab.solve.start import start

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

PHASE = "two lobes"
"""Phase function of the truth; it differs from the single lobe of the start."""
PHOTONS, QUICK_PHOTONS = 500_000, 20_000
"""Number of photons of each image."""
RATES, QUICK_RATES = (0.05, 0.2), (0.2,)
"""Learning rates of Adam for the logarithms."""
ITERATIONS, QUICK_ITERATIONS = (5, 10, 20), (1,)
"""Numbers of iterations after which the medium is reported."""
SAMPLES = 64
"""Paths per pixel of a render and of its gradient."""
MEAN_DECAY, SQUARE_DECAY, SMALL = 0.9, 0.999, 1e-8
"""Adam's beta1, beta2 and epsilon (Kingma and Ba 2015)."""
SMALLEST_PER_MM = 1e-4
"""Smallest absorption of the start, because its logarithm is taken."""
STOCK = "stock Mitsuba"
EXTINCTION, ALBEDO, VALUES = (
    f"cell.interior_medium.{name}" for name in ("sigma_t.value.value", "albedo.value.value", "phase_function.values")
)


def run(*, quick: bool, keep: Keep = lambda _: None) -> list[dict[str, Any]]:
    """Return the rows of both solvers."""
    folder = matched_folder()
    truth = Truth(PHASE, folder, SCATTERING_PER_MM, ABSORPTION_PER_MM, PHASES[PHASE])
    images, variances = photographed(truth, QUICK_PHOTONS if quick else PHOTONS, seed=61)
    rig = rig_of(folder, folder.wavelengths_nm[0])
    halves = [folded(image, variance, rig.grid) for image, variance in zip(images, variances, strict=True)]
    places = tuple((entry.camera, entry.light) for entry in folder.images)
    values, of_values = (np.stack(each) for each in zip(*halves, strict=True))
    measured = Measurements(values, of_values, np.zeros(len(values), dtype=bool), places, assumed_noise=False)
    begun = time.process_time()
    guess = start(rig, measured, 1, map)
    start_seconds = time.process_time() - begun
    rows: list[dict[str, Any]] = []

    def add(peer: str, setting: str, found: Material, seconds: float) -> None:
        rows.append(compared(truth, found, peer, setting, start_seconds + seconds, "slab-stock").model_dump())
        keep(rows)

    add("start", "HG of three numbers", guess, 0.0)
    for effort in QUICK_EFFORTS if quick else EFFORTS:
        begun = time.process_time()
        found = GaussNewton(rig, measured, 1, Budget().scaled(effort), map, Knots()).solve(lambda: guess).material
        add("dentine", f"effort {effort:g}", found, time.process_time() - begun)
    for rate in QUICK_RATES if quick else RATES:
        for iterations, found, seconds in descend(truth, guess, images, variances, rate, quick=quick):
            add(STOCK, f"rate {rate:g}, {iterations} iterations", found, seconds)
    return rows


def descend(
    truth: Truth, guess: Material, images: Array, variances: Array, rate: float, *, quick: bool
) -> Iterator[tuple[int, Material, float]]:
    """Fit the medium by Adam on gradients of stock Mitsuba.

    Args:
        truth: the true medium in its cell.
        guess: medium at the start.
        images: measured images (images, rows, columns).
        variances: variances of the images (images, rows, columns).
        rate: learning rate.
        quick: stop after one iteration.

    Yields:
        Number of iterations, the medium after them and processor seconds so far.
    """
    from services.transport.platform import prepare_device

    prepare_device()
    import mitsuba as mi

    atoms = Mixtures(unit_atoms(np.stack([hg_values(g) for g in COSINES], axis=1)))
    tables = np.stack([hg_values(g, node_angles()) for g in COSINES], axis=1)
    begun = atoms.initial_medium(guess)
    x = np.log(np.append(begun.atom_weights, max(begun.absorption_per_mm, SMALLEST_PER_MM)))
    medium = medium_of(1.0, 0.5, PHASES[PHASE])
    views = [
        (scene, mi.traverse(scene), turned(image, front=front), turned(variance, front=front))
        for (scene, front), image, variance in zip(
            scenes(truth.folder, medium, "prbvolpath"), images, variances, strict=True
        )
    ]
    mean, square, reported = np.zeros_like(x), np.zeros_like(x), QUICK_ITERATIONS if quick else ITERATIONS
    seconds = 0.0
    for iteration in range(1, max(reported) + 1):
        clock = time.process_time()
        slope = np.zeros_like(x)
        for number, view in enumerate(views):
            slope += _slope(*view, np.exp(x), tables, seed=2 * (iteration * len(views) + number))
        mean, square = (
            MEAN_DECAY * mean + (1 - MEAN_DECAY) * slope,
            SQUARE_DECAY * square + (1 - SQUARE_DECAY) * slope**2,
        )
        unbiased = np.sqrt(square / (1 - SQUARE_DECAY**iteration)) + SMALL
        x = x - rate * mean / (1 - MEAN_DECAY**iteration) / unbiased
        seconds += time.process_time() - clock
        if iteration in reported:
            yield iteration, atoms.material_at(np.exp(x)), seconds


def _slope(scene: Any, params: Any, image: Array, variance: Array, known: Array, tables: Array, *, seed: int) -> Array:
    """Return the derivative of half the squared, weighted residuals of one image with respect to the logarithms of the
    weights and the absorption; ``known`` are the weights and, last, the absorption themselves.
    """
    import drjit as dr
    import mitsuba as mi

    extinction, albedo, values = medium_numbers(known, tables)
    params[EXTINCTION], params[ALBEDO], params[VALUES] = mi.Float(extinction), mi.Float(albedo), mi.Float(values)
    for name in (EXTINCTION, ALBEDO, VALUES):
        dr.enable_grad(params[name])
    params.update()
    # The image and its derivative have independent random numbers, so that their product is unbiased.
    rendered = mi.render(scene, params, spp=SAMPLES, seed=seed, seed_grad=seed + 1)
    measured, own = (mi.TensorXf(np.ascontiguousarray(one[..., None], dtype=np.float32)) for one in (image, variance))
    dr.backward(0.5 * dr.sum(dr.square(rendered - measured) / own, axis=None))
    by_extinction, by_albedo = (float(dr.grad(params[name])[0]) for name in (EXTINCTION, ALBEDO))
    return chained(by_extinction, by_albedo, np.array(dr.grad(params[VALUES]), dtype=np.float64), known, tables)


def medium_numbers(known: Array, tables: Array) -> tuple[float, float, Array]:
    """Return extinction, albedo and the table of the phase function from the weights and, last, the absorption."""
    extinction = float(known.sum())
    return extinction, float(known[:-1].sum()) / extinction, tables @ known[:-1]


def chained(by_extinction: float, by_albedo: float, by_values: Array, known: Array, tables: Array) -> Array:
    """Return the derivative with respect to the logarithms of ``known`` by the chain rule, from the derivatives with
    respect to the results of ``medium_numbers``.
    """
    extinction = float(known.sum())
    by_weights = by_extinction + by_albedo * known[-1] / extinction**2 + tables.T @ by_values
    by_absorption = by_extinction - by_albedo * (extinction - known[-1]) / extinction**2
    return np.asarray(np.append(by_weights, by_absorption) * known)


def times_faster(rows: list[dict[str, Any]]) -> float | None:
    """Return the ratio of stock Mitsuba's time to its best medium to the default's time to one at least as good.

    The best medium has the smallest error of the phase function; the default's must have no larger error of the phase
    function nor of sigma_s. None where the default has no such medium.
    """
    nearest = min((row for row in rows if row["peer"] == STOCK), key=lambda row: row["error"])
    as_near = [
        row["seconds"]
        for row in rows
        if row["peer"] == "dentine" and all(row[key] <= nearest[key] for key in ("error", "scattering_error"))
    ]
    return nearest["seconds"] / min(as_near) if as_near else None


def picture(rows: list[dict[str, Any]]) -> Figure:
    """Draw the errors of the phase function and of sigma_s against core-seconds."""
    from services.bench.plots import draw_errors, finish, grid

    figure, panels = grid(2)
    for axes, key, title in zip(panels, ("error", "scattering_error"), ("phase function, L2", "σs"), strict=True):
        draw_errors(axes, [row | {"error": row[key]} for row in rows], lines=False)
        finish(axes, "core-seconds", "relative error")
        axes.set_title(title)
    if ratio := times_faster(rows):
        figure.suptitle(f"stock Mitsuba took {ratio:.0f} times as long to its nearest medium")
    return figure
