"""How often a slab's 95 % intervals contain the truth, over many draws of noise and of media; about ten core-minutes.

python -m tests.benchmarks.slab_coverage --draws 2000 --json slab_coverage.json

The images of a draw are the sum of three: those of one medium, the change that plain photons find for a small change of
the medium, and shot noise. Every draw has its own change of sigma_s, of sigma_a and of the mean cosine, each normal
with the standard deviation in ``SPREADS``. Five draws share one set of the fit's batches, which are noisy images and
derivatives with weights from other batches, as at the end of a fit. They are solved as in the last steps of a fit: the
prior's scale by evidence, then damped steps, the first from the unchanged medium. The ± are those of the fit.

Batches are drawn from a pool without replacement. The combined renders of a fit's last stage are about eight and have
eight times the paths; shot noise is therefore 2.83 times the usual 1 %, so that both have their usual part in the ±.
Their batches are smaller and half as many as a fit's. The variance of 24 batches is itself so uncertain that intervals
of 1.96 standard errors contain the truth in 93.8 % of draws where paths are all of the noise; with 96 in 94.7 %.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.bench.slab.cell import near_beam_folder
from services.bench.slab.plain_photons import plain_images
from services.core.slab.folder import SlabFolder
from services.slab.cell.dictionary import ANGLES_RAD, Material, henyey_greenstein, hg_values
from services.slab.cell.forward import Batches, render
from services.slab.cell.rig import Rig, rig_of
from services.slab.read.images import shot_noise
from services.slab.solve.coordinates import Knots
from services.slab.solve.gauss_newton import DAMPING, quadratic_at
from services.slab.solve.measured_directions import step_matrix
from services.slab.solve.normal import NormalEquations, derivative_rows, normal_equations
from services.slab.solve.prior import precision
from services.slab.solve.solution import Solution
from services.slab.solve.uncertainty import phase_chain, slopes, uncertainty_of
from services.slab.solve.weights import Weights, smoothed_covariance, weights_of

Array = NDArray[np.float64]

SCATTERING_PER_MM, COSINE, ABSORPTION_PER_MM = 0.97, 0.8, 0.03
"""Medium in a cell of 1 mm, so that sigma_t w is 1."""
SPREADS = {"sigma_s": 0.006, "sigma_a": 0.002, "g": 0.002}
"""Standard deviations of the change: of sigma_s as a share of it, of sigma_a per mm, of g in units of 1. Each is about
one of the ±, which is how far the last step of a fit moves."""
DIFFERENCES = {"sigma_s": 0.06, "sigma_a": 0.02, "g": 0.02}
"""Changes from which derivatives are computed, of either sign. With twice those of ``SPREADS`` the photons' noise in
them was up to 0.7 of the ±."""
NOISE = 0.01 * 8**0.5
"""Shot noise of a pixel that has its image's mean, as a share."""
POOL, BATCHES, PATHS = 768, 96, 7_500
"""Number of the fit's batches in the pool and in one set, and paths of a light and batch."""
DRAWS_OF_A_SET = 5
STEPS = 3
"""Number of damped steps; the third moves a value by less than a tenth of its ±."""
PHOTONS = 400_000
"""Photons of each image from which the changes are computed."""
NINETY_FIVE = 1.959964
RANGES_DEG = ((0.0, 7.0), (7.0, 20.0), (20.0, 45.0), (45.0, 90.0), (90.0, 135.0), (135.0, 180.0))
"""Ranges of the scattering angle. The intervals of a range's knots are counted together, and the mean of ln p over it
has its own."""


def changed(share: float = 0.0, absorption_per_mm: float = 0.0, cosine: float = 0.0) -> Material:
    """The medium after a change."""
    return henyey_greenstein(SCATTERING_PER_MM * (1 + share), COSINE + cosine, ABSORPTION_PER_MM + absorption_per_mm)


def columns(folder: SlabFolder, rig: Rig, photons: int) -> Array:
    """Derivatives of the images by each kind of change, from differences of plain photons (3, images, pixels)."""
    found = []
    for number, (name, step) in enumerate(DIFFERENCES.items()):
        both = []
        for sign in (1, -1):
            scattering = SCATTERING_PER_MM * (1 + sign * step if name == "sigma_s" else 1)
            absorption = ABSORPTION_PER_MM + (sign * step if name == "sigma_a" else 0)
            cosine = COSINE + (sign * step if name == "g" else 0)
            images, _ = plain_images(
                folder, scattering + absorption, scattering / (scattering + absorption),
                partial(hg_values, cosine), photons, 401 + number,
            )  # fmt: skip
            if rig.grid.folded:
                images = (images[:, : rig.grid.rows][:, ::-1] + images[:, rig.grid.rows :]) / 2
            both.append(images.reshape(len(images), -1))
        found.append((both[0] - both[1]) / (2 * step))
    return np.stack(found)


@dataclass(frozen=True)
class BatchSet:
    """What a fit has at its end: one set of batches, and weights from another."""

    equations: NormalEquations
    """Normal equations with the unchanged images as measurements."""
    weights: Weights
    derivatives: Array
    """Mean of the whitened derivatives (values, UNKNOWNS)."""

    def gradient(self, difference: Array) -> Array:
        """Gradient with measurements that differ from the unchanged images by ``difference`` (images, pixels)."""
        whitened = self.weights.whitened(difference[None])[0].reshape(-1)
        return np.asarray(self.equations.gradient - self.derivatives.T @ whitened)


def batch_set(rig: Rig, material: Material, pool: Batches, variances: Array, draw: np.random.Generator) -> BatchSet:
    """Draw a set of batches from the pool.

    The unchanged images are half-way between the mean of the pool, to which the set is nearer than to a truth, and the
    mean of the batches outside the set, from which it is farther: the variance of the set's distance from them is
    within 0.5 % of the variance of the set's mean.
    """
    places = draw.permutation(len(pool.images))
    chosen, others, outside = places[:BATCHES], places[BATCHES : 2 * BATCHES], places[BATCHES:]
    unchanged = (pool.images.mean(axis=0) + pool.images[outside].mean(axis=0)) / 2
    images, shape = [views.images for views in rig.lights], (rig.grid.rows, rig.grid.columns)
    noise = [smoothed_covariance(pool.images[others][:, some], shape) for some in images]
    weights = weights_of(images, variances, noise)
    batches = Batches(pool.images[chosen], pool.rows[chosen], pool.single_images, pool.single_rows)
    equations = normal_equations(batches, material, unchanged, weights)
    mean = weights.whitened(derivative_rows(batches.rows.mean(axis=0, dtype=np.float64), material)[None])[0]
    return BatchSet(equations, weights, mean.reshape(-1, mean.shape[-1]))


def solved(at: Material, batch_set: BatchSet, difference: Array) -> tuple[Material, Array]:
    """The material that a fit finds in such images, and the covariance (UNKNOWNS, UNKNOWNS) that it states."""
    knots, equations = Knots(), batch_set.equations
    x = knots.unknowns(at)
    quadratic = quadratic_at(x, replace(equations, gradient=batch_set.gradient(difference)))
    found, scale = at, knots.scale(at, quadratic, sharp=True)
    for step in range(STEPS):
        if step == 1:
            scale = knots.scale(found, quadratic, sharp=True)
        prior = precision(scale)
        matrix = step_matrix(quadratic, prior, DAMPING)
        before = knots.unknowns(found)
        slope = quadratic.linear + (quadratic.matrix + prior) @ before
        found = knots.material_at(knots.minimum(matrix, matrix @ before - slope))
    solution = Solution(
        found, quadratic, equations.gradient_noise, scale, equations.used, STEPS, True, 0, knots, equations.misfit,
        equations.misfit_se, equations.data_noise, equations.matrix_error @ (knots.unknowns(found) - x), 0.0,
    )  # fmt: skip
    return found, uncertainty_of(solution).covariance


def intervals(true: Material, found: Material, covariance: Array) -> dict[str, list[float]]:
    """Errors over their ± by quantity: numbers, ln p at the knots of each range of angles, and its mean over the
    range.
    """
    out: dict[str, list[float]] = {}
    for name, slope in slopes(found).items():
        values = [_number(one, name) for one in (found, true)]
        out[name] = [(values[0] - values[1]) / float(np.sqrt(slope @ covariance @ slope))]
    chain = phase_chain(found)
    apart = np.log(found.phase_per_sr) - np.log(true.phase_per_sr)
    errors = np.sqrt(np.einsum("ij,jk,ik->i", chain, covariance, chain, optimize=True))
    degrees = np.degrees(ANGLES_RAD)
    for low, high in RANGES_DEG:
        inside = (degrees >= low) & (degrees <= high)
        slope = chain[inside].mean(axis=0)
        out[f"p {low:g}-{high:g}, knots"] = list(apart[inside] / errors[inside])
        out[f"p {low:g}-{high:g}, mean"] = [float(apart[inside].mean() / np.sqrt(slope @ covariance @ slope))]
    return out


def _number(material: Material, name: str) -> float:
    return {
        "sigma_t": material.extinction_per_mm,
        "sigma_s": material.scattering_per_mm,
        "sigma_a": material.absorption_per_mm,
        "sigma_s_reduced": material.reduced_scattering_per_mm,
        "g": material.mean_cosine,
    }[name]


def covered(draws: int, pool_size: int, photons: int, seed: int) -> list[dict[str, Any]]:
    """Return a row per quantity: the share of intervals that contain the truth, and the rms of errors over their ±."""
    folder = near_beam_folder()
    rig, material = rig_of(folder, folder.wavelengths_nm[0]), changed()
    ways = columns(folder, rig, photons)
    pool = render(rig, material, seed=seed, step=0, batches=pool_size, paths=PATHS, scores=True)
    variances = np.stack([shot_noise(image, NOISE) for image in pool.mean]) / (2 if rig.grid.folded else 1)
    draw = np.random.default_rng(seed)
    scores_of: dict[str, list[float]] = {}
    for number in range(draws):
        if number % DRAWS_OF_A_SET == 0:
            batches = batch_set(rig, material, pool, variances, draw)
        change = draw.normal(size=len(SPREADS)) * np.array(list(SPREADS.values()))
        noise = np.sqrt(variances) * draw.normal(size=variances.shape)
        found, covariance = solved(material, batches, np.tensordot(change, ways, 1) + noise)
        for name, scores in intervals(changed(*change), found, covariance).items():
            scores_of.setdefault(name, []).extend(scores)
    return [
        {
            "quantity": name,
            "draws": draws,
            "covered": float(np.mean(np.abs(scores) <= NINETY_FIVE)),
            "rms": float(np.sqrt(np.mean(np.square(scores)))),
            "mean": float(np.mean(scores)),
        }
        for name, scores in scores_of.items()
    ]


def main() -> None:
    """Draw, and write the shares."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=2000)
    parser.add_argument("--pool", type=int, default=POOL, help="batches; each takes 2 MB of memory")
    parser.add_argument("--photons", type=int, default=PHOTONS, help="of each image of the columns")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path, required=True)
    arguments = parser.parse_args()
    rows = covered(arguments.draws, arguments.pool, arguments.photons, arguments.seed)
    for row in rows:
        print(f"{row['quantity']:22} {100 * row['covered']:5.1f} %  rms {row['rms']:.2f}  mean {row['mean']:+.2f}")
    arguments.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
