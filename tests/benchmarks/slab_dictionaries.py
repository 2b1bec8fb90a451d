"""Results of each dictionary on the slab truths and on one dispersion of spheres, as JSON rows; about 20 core-seconds a
row.

python -m tests.benchmarks.slab_dictionaries --seeds 2 --json dictionaries.json

The truths of ``slab-truth`` were rendered by another program. The dispersion (polystyrene spheres of 800 nm at a
wavelength of 533 nm from the reference table, sigma_t w = 2) is rendered by the forward model with other seeds; its one
size of spheres is none of the dictionary's. Rows that the file holds already are not computed again.
"""

from __future__ import annotations

import argparse
import csv
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from services.core.slab.folder import read_folder
from services.slab.cell.dictionary import ANGLES_RAD, Material, tent_solid_angles
from services.slab.cell.forward import render
from services.slab.cell.rig import rig_of
from services.slab.dictionaries.mie import scattered
from services.slab.fit import fit_slab
from services.slab.options import SlabOptions
from services.slab.solve.weights import smoothed_variance
from tests.pipeline.test_slab_fit import NOISE, errors_of, noisy_truth
from tests.support.shared_data import shared_path

TRUTHS = ("mie-500nm", "two-lobe", "hg-paper-angles", "mie-800nm-dispersion")
DICTIONARIES = ("tents", "hg", "mie")
LIKE = "mie-500nm"
"""Name of the truth whose cell, cameras and lights the dispersion has."""
THICKNESS = 2.0
TRUTH_SEED, TRUTH_BATCHES, TRUTH_PATHS = 4711, 16, 60_000
RELATIVE_INDEX = {"mie-500nm": 1.59807 / 1.33499, "mie-800nm-dispersion": 1.59807 / 1.33499}
"""Refractive index of polystyrene relative to water at 533 nm, from the reference table. The other truths are not
spheres; the dictionary of spheres is tried on them with the index of ``LIKE``."""


def write_dispersion(out: Path, seed: int) -> dict[str, object]:
    """Write the dispersion's folder; returns its true scattering and phase function."""
    with shared_path("reference/mie_dispersions.csv").open() as stream:
        row = next(row for row in csv.DictReader(stream) if (row["diameter_nm"], row["channel"]) == ("800", "G"))
    intensity, _ = scattered(complex(float(row["n_polystyrene"]) / float(row["n_water"])), float(row["size_parameter"]))
    folder = read_folder(shared_path(f"data/slab-truth/{LIKE}"))
    (out / "slab.json").write_bytes((shared_path(f"data/slab-truth/{LIKE}") / "slab.json").read_bytes())
    sigma_s = THICKNESS / folder.cell.width_mm
    material = Material(sigma_s * intensity / float(tent_solid_angles() @ intensity), 0.0)
    rig, noise = rig_of(folder, folder.wavelengths_nm[0]), np.random.default_rng(seed)
    batches = render(rig, material, seed=TRUTH_SEED, step=0, batches=TRUTH_BATCHES, paths=TRUTH_PATHS, scores=False)
    variances = smoothed_variance(batches.images, (rig.grid.rows, rig.grid.columns))
    for entry, image, variance in zip(folder.images, batches.mean, variances, strict=True):
        halves = (one.reshape(rig.grid.rows, rig.grid.columns) for one in (image, variance))
        whole, of_whole = (np.concatenate([half[::-1], half]) for half in halves)
        shot = NOISE**2 * whole * whole.mean()
        np.save(out / entry.file, whole + np.sqrt(shot) * noise.normal(size=whole.shape))
        # Both halves share the walk's noise but are treated as independent, hence the factor 2.
        np.save(out / str(entry.variance_file), shot + 2 * of_whole)
    return {
        "sigma_s": sigma_s,
        "g": material.mean_cosine,
        "theta_deg": np.degrees(ANGLES_RAD).tolist(),
        "phase_per_sr": material.phase_per_sr.tolist(),
    }


def measure(truth: str, dictionary: str, seed: int, effort: float) -> dict[str, Any]:
    """Fit one truth with one dictionary; returns its row."""
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        true = write_dispersion(root, seed) if truth.endswith("dispersion") else noisy_truth(truth, root, seed)
        told: dict[str, Any] = {"seed": seed, "effort": effort, "dictionary": dictionary}
        if dictionary == "mie":
            # The medium has the folder's index; the particles' index follows from the ratio.
            index = read_folder(root).cell.index
            told["particle_index"] = RELATIVE_INDEX.get(truth, RELATIVE_INDEX[LIKE]) * float(index or 0)
        (fit,) = fit_slab(root, SlabOptions.model_validate(told))
    known, sigma_s, g = fit.parameters, float(str(true["sigma_s"])), float(str(true["g"]))
    sigmas = {
        "sigma_s": (known.sigma_s.value - sigma_s) / known.sigma_s.se,
        "sigma_s_reduced": (known.sigma_s_reduced.value - sigma_s * (1 - g)) / known.sigma_s_reduced.se,
    }
    return {
        "truth": truth,
        "dictionary": dictionary,
        "seed": seed,
        "effort": effort,
        "error_percent": {name: round(100 * value, 3) for name, value in errors_of(fit, true).items()},
        "error_by_se": {name: round(value, 2) for name, value in sigmas.items()},
        "core_seconds": round(fit.core_seconds, 1),
        "paths": fit.paths,
        "converged": fit.converged,
        "doubted": any("nearest mix" in note for note in fit.notes),
        "spheres": {
            name: fit.atoms[name].model_dump() for name in ("mean_radius", "volume_fraction") if fit.atoms.get(name)
        },
    }


def main() -> None:
    """Write the rows and print them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--truth", action="append", choices=TRUTHS, help="only this one; may be repeated")
    parser.add_argument("--dictionary", action="append", choices=DICTIONARIES, help="only this one; may be repeated")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--effort", type=float, default=1.0)
    parser.add_argument("--json", type=Path, required=True)
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = json.loads(arguments.json.read_text()) if arguments.json.exists() else []
    done = {(row["truth"], row["dictionary"], row["seed"], row["effort"]) for row in rows}
    for seed in range(12, 12 + arguments.seeds):
        for truth in arguments.truth or TRUTHS:
            for dictionary in arguments.dictionary or DICTIONARIES:
                if (truth, dictionary, seed, arguments.effort) in done:
                    continue
                rows.append(measure(truth, dictionary, seed, arguments.effort))
                arguments.json.write_text(json.dumps(rows, indent=1))
                print(json.dumps(rows[-1]), flush=True)


if __name__ == "__main__":
    main()
