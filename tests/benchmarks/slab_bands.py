"""Check of the ± of phase functions by ranges of angle: distance from the truth in standard errors, at single angles
and as the images resolve it.

python -m tests.benchmarks.slab_bands --json slab_bands.json
python -m tests.benchmarks.slab_bands --truths "" --spheres 0,1,2,3,4,5,6,7,8 --json slab_bands_of_spheres.json

Truths are the folders of the shared data with 1 % Poisson noise, or spheres at a dilution, photographed by plain
photons as ``dentine bench slab-mie`` does. ``z`` compares with the truth at single angles. ``z_resolved`` compares with
the truth seen through the fit's averaging kernels (Rodgers 2000, Inverse Methods for Atmospheric Sounding, 3.2): rings
that are narrower than the images resolve are in the former alone.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.bench.slab.dispersions import truths
from services.bench.slab.recovery import FINE_RAD, photographed, write_images
from services.core.slab.folder import read_folder
from services.slab.dictionaries.chosen import dictionary_of
from services.slab.fit import fit_images
from services.slab.options import SlabOptions
from services.slab.read.images import read_images
from services.slab.results.result import Wavelength
from tests.pipeline.test_slab_fit import noisy_truth

ENDS_DEG = (0, 7, 20, 45, 90, 135, 181)
PHOTONS = 4_000_000


def fit(root: Path, seed: int) -> Wavelength:
    """Fit the first wavelength of a folder, and keep its averaging kernels."""
    folder, options = read_folder(root), SlabOptions(seed=seed)
    wavelength_nm = folder.wavelengths_nm[0]
    measured = read_images(root, folder, wavelength_nm)
    return fit_images(
        folder, wavelength_nm, measured, options, map, dictionary_of(root, folder, wavelength_nm, options)
    )


def distances(found: Wavelength, true_per_sr: NDArray[np.float64]) -> dict[str, list[float]]:
    """Rms distance from the truth at the fit's knots by ranges of angle, in standard errors."""
    phase, theta = found.fit.phase, np.array(found.fit.phase.theta_deg)
    value, se = np.array(phase.value_per_sr), np.array(phase.se_per_sr)
    assert found.averaging is not None
    resolved = value * (found.averaging @ (1 - true_per_sr / value))
    ranges = [(low <= theta) & (theta < high) for low, high in pairwise(ENDS_DEG)]
    return {
        name: [round(float(np.sqrt(np.mean((error[own] / se[own]) ** 2))), 2) for own in ranges]
        for name, error in (("z", value - true_per_sr), ("z_resolved", resolved))
    } | {"resolution_deg": [round(float(np.median(np.array(phase.resolution_deg)[own])), 1) for own in ranges]}


def main() -> None:
    """Run the fits asked for, write the file after each, and print the rms over all of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--truths", default="mie-500nm,two-lobe,hg-paper-angles")
    parser.add_argument("--spheres", default="", help="numbers of dispersions of slab-mie, from 0")
    parser.add_argument("--seeds", type=int, default=2, help="fits of each truth, with seeds of the noise from 21")
    given = parser.parse_args()
    rows: list[dict[str, Any]] = []

    def keep(name: str, seed: int, root: Path, theta_deg: NDArray[np.float64], true: NDArray[np.float64]) -> None:
        found = fit(root, seed)
        at = np.interp(np.array(found.fit.phase.theta_deg), theta_deg, true)
        rows.append({"truth": name, "seed": seed} | distances(found, at))
        given.json.write_text(json.dumps(rows, indent=1))
        print(json.dumps(rows[-1]), flush=True)

    for name in filter(None, given.truths.split(",")):
        for seed in range(21, 21 + given.seeds):
            with tempfile.TemporaryDirectory() as place:
                told: dict[str, Any] = noisy_truth(name, Path(place), seed)
                keep(name, seed, Path(place), np.array(told["theta_deg"]), np.array(told["phase_per_sr"]))
    for number in map(int, filter(None, given.spheres.split(","))):
        truth = truths()[number]
        with tempfile.TemporaryDirectory() as place:
            write_images(Path(place), truth, *photographed(truth, PHOTONS, seed=301 + number))
            keep(truth.name, 51 + number, Path(place), np.degrees(FINE_RAD), truth.phase_per_sr())
    for name in ("z", "z_resolved"):
        squares = np.square([row[name] for row in rows])
        print(
            name, "by ranges", np.round(np.sqrt(squares.mean(axis=0)), 2), "all", round(float(squares.mean() ** 0.5), 2)
        )


if __name__ == "__main__":
    main()
