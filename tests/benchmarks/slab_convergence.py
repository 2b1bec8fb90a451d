"""Default fits of nine slabs that a plain photon simulation made: errors, convergence and core-seconds, as JSON.

python -m tests.benchmarks.slab_convergence --seed 2 --json slab_convergence.json      about six minutes on one core

Spheres, two lobes and Henyey-Greenstein media at optical thicknesses 0.5, 1.5 and 3, with parameters drawn by the seed,
images of 1 % noise (``services.bench.slab.plain_photons``, which shares no code with the fit), and default options. The
file keeps the results of an earlier run, and a new run continues after them.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.bench.slab.cell import near_beam_folder
from services.bench.slab.dispersions import mie_truth
from services.bench.slab.recovery import Truth, photographed, recovered
from services.core.store import write_atomic
from services.slab.cell.dictionary import hg_values

THICKNESSES = (0.5, 1.5, 3.0)
PHOTONS = 1_000_000
"""Number of photons of each image."""


def truths(seed: int) -> Iterator[Truth]:
    """Nine media with drawn parameters, in a cell of 1 mm."""
    random, folder = np.random.default_rng([64, seed]), near_beam_folder()
    for thickness in THICKNESSES:
        diameter_nm, colour = random.uniform(250, 900), str(random.choice(["R", "G", "B"]))
        spheres = mie_truth(diameter_nm, colour, 1.0, folder)
        yield replace(spheres, name=f"{diameter_nm:.0f} nm {colour}, {thickness:g}", scattering_per_mm=thickness)

        forward, backward, share = random.uniform(0.6, 0.85), random.uniform(-0.5, -0.2), random.uniform(0.6, 0.9)

        def two_lobes(
            angles: NDArray[np.float64], lobes: tuple[float, float, float] = (forward, backward, share)
        ) -> NDArray[np.float64]:
            return np.asarray(lobes[2] * hg_values(lobes[0], angles) + (1 - lobes[2]) * hg_values(lobes[1], angles))

        albedo = random.uniform(0.8, 0.99)
        name = f"lobes {forward:.2f} {backward:.2f}, {thickness:g}"
        yield Truth(name, folder, albedo * thickness, (1 - albedo) * thickness, two_lobes)

        g, albedo = random.uniform(0.3, 0.8), random.uniform(0.8, 0.99)

        def one_lobe(angles: NDArray[np.float64], g: float = g) -> NDArray[np.float64]:
            return np.asarray(hg_values(g, angles))

        name = f"HG {g:.2f}, {thickness:g}"
        yield Truth(name, folder, albedo * thickness, (1 - albedo) * thickness, one_lobe)


def measured(truth: Truth, seed: int) -> dict[str, Any]:
    """Fit one slab; its row."""
    images, variances = photographed(truth, PHOTONS, seed)
    row = recovered(truth, images, variances, seed)
    sigma_s = row.numbers["sigma_s"]
    return {
        "slab": truth.name,
        "seed": seed,
        "converged": row.converged,
        "core_seconds": round(row.seconds, 1),
        "sigma_s_off_percent": round(100 * (sigma_s.value / sigma_s.truth - 1), 2),
        "sigma_s_bound_percent": round(100 * sigma_s.bound / sigma_s.truth, 2),
        "phase_off_percent": round(100 * row.error, 2),
        "phase_bound_percent": round(100 * row.phase_bound, 2),
        "off_over_se": {name: round((one.value - one.truth) / one.se, 2) for name, one in row.numbers.items()},
    }


def main() -> None:
    """Fit the slabs, write the file after each, and print the rows and their summary."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path, required=True)
    given = parser.parse_args()
    rows: list[dict[str, Any]] = json.loads(given.json.read_text()) if given.json.exists() else []
    for truth in truths(given.seed):
        if any((row["slab"], row["seed"]) == (truth.name, given.seed) for row in rows):
            continue
        rows.append(measured(truth, given.seed))
        write_atomic(given.json, json.dumps(rows, indent=1).encode())
        print(json.dumps(rows[-1]), flush=True)
    seconds = np.median([row["core_seconds"] for row in rows])
    print(f"{sum(row['converged'] for row in rows)} of {len(rows)} converged; median {seconds:.0f} core-seconds")


if __name__ == "__main__":
    main()
