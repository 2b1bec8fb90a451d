"""The slab's fit on truths of another program: its errors, their ± and bounds, over seeds. About half a minute per fit.

python -m tests.benchmarks.slab_truth --seeds 5 --json slab_truth.json

For each seed, new Poisson noise is added to noise-free images (1 % at a pixel of its image's mean), and the fit uses
the same seed. The file keeps the results of an earlier run, and a new run continues after them.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.slab.folder import read_folder
from services.slab.cell.dictionary import ANGLES_RAD, Material, tent_solid_angles
from services.slab.cell.rig import rig_of
from services.slab.design.bound import Bound, bound_of
from services.slab.fit import fit_slab
from services.slab.options import SlabOptions
from services.slab.solve.uncertainty import slopes
from tests.pipeline.test_slab_fit import NOISE, errors_of, noisy_truth
from tests.support.shared_data import shared_path

NAMES = ("mie-500nm", "two-lobe", "hg-paper-angles")
FIRST_SEED = 11
TOLERANCES = {"sigma_s": 0.01, "sigma_s_reduced": 0.01, "phase": 0.02, "phase_by_sine": 0.03}


def material_of(truth: dict[str, Any]) -> Material:
    """A truth as a mixture of the dictionary's tents."""
    shape = np.interp(ANGLES_RAD, np.radians(truth["theta_deg"]), truth["phase_per_sr"])
    return Material(truth["sigma_s"] * shape / float(shape @ tent_solid_angles()), truth["sigma_a"])


def bound_for(name: str, truth: dict[str, Any]) -> Bound:
    """The Cramér-Rao bound from the shot noise and the variance of the truth's own rendering."""
    root = shared_path(f"data/slab-truth/{name}")
    folder = read_folder(root)
    rig = rig_of(folder, folder.wavelengths_nm[0])
    own: NDArray[np.float64] = np.stack([np.load(root / str(entry.variance_file)) for entry in folder.images])
    if rig.grid.folded:
        own = 0.25 * (own[:, : rig.grid.rows][:, ::-1] + own[:, rig.grid.rows :])
    return bound_of(rig, material_of(truth), noise=NOISE, variances=own.reshape(len(own), -1))


def measured(name: str, seed: int, bounds: dict[str, Bound]) -> dict[str, Any]:
    """Fit one truth with one seed; returns its row."""
    with tempfile.TemporaryDirectory() as place:
        truth: dict[str, Any] = noisy_truth(name, Path(place), seed)
        (fit,) = fit_slab(Path(place), SlabOptions(seed=seed))
    if name not in bounds:
        bounds[name] = bound_for(name, truth)
    material = material_of(truth)
    numbers = {}
    for quantity in ("sigma_s", "sigma_s_reduced"):
        told = getattr(fit.parameters, quantity)
        true = truth["sigma_s"] * (1 if quantity == "sigma_s" else 1 - truth["g"])
        numbers[quantity] = {
            "z": (told.value - true) / told.se,
            "share_se": told.se / true,
            "share_bound": bounds[name].of(slopes(material)[quantity]) / true,
            "determined": told.determined,
        }
    return {
        "truth": name,
        "seed": seed,
        **errors_of(fit, truth),
        "numbers": numbers,
        "undetermined_bands_deg": fit.phase.undetermined_bands_deg(),
        "core_seconds": round(fit.core_seconds, 1),
        "million_paths": round(fit.paths / 1e6, 2),
        "converged": fit.converged,
    }


def summary(rows: list[dict[str, Any]]) -> str:
    """Rms of each truth's errors, and median core-seconds of a fit, as text."""
    lines = []
    for name in NAMES:
        if not (own := [row for row in rows if row["truth"] == name]):
            continue
        rms = {key: float(np.sqrt(np.mean([row[key] ** 2 for row in own]))) for key in TOLERANCES}
        told = ", ".join(f"{key} {100 * value:.2f} %" for key, value in rms.items())
        took = np.median([row["core_seconds"] for row in own])
        lines.append(f"{name}, {len(own)} seeds: rms of {told}; {took:.0f} core-seconds")
    return "\n".join(lines)


def main() -> None:
    """Fit every truth with every seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--truths", default=",".join(NAMES), help="which, separated by commas")
    parser.add_argument("--json", type=Path, required=True)
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = json.loads(arguments.json.read_text()) if arguments.json.exists() else []
    bounds: dict[str, Bound] = {}
    for seed in range(FIRST_SEED, FIRST_SEED + arguments.seeds):
        for name in arguments.truths.split(","):
            if any(row["truth"] == name and row["seed"] == seed for row in rows):
                continue
            rows.append(measured(name, seed, bounds))
            print(json.dumps(rows[-1]), flush=True)
            arguments.json.write_text(json.dumps(rows, indent=1) + "\n")
    print(summary(rows))


if __name__ == "__main__":
    main()
