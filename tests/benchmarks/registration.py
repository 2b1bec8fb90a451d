"""Detection rate of the registration check for teeth 1 mm beside their mesh, and false-alarm rate for teeth in place.

python -m tests.benchmarks.registration --json registration.json      some 4 core-minutes

No fit is run. The 200 cases in place are 20 phantoms (``tests.support.registered_phantoms``, each with its own size,
pose, camera, pixels of 0.5 to 0.8 mm, optics and gums) x 10 draws of noise. The 200 cases of teeth 1 mm beside their
mesh, perpendicular to the line of sight, are the same phantoms x 2 directions x 5 draws. As after a fit, the check
receives a camera's brightest image and a held-out one from a grazing light, with renders of 32, 128 or 512 paths per
pixel whose media differ from the truth. Noise is drawn from 1 to 10 %, of the value or, in every second draw, of the
brightest pixel everywhere. The capture states it or, in every second pair of draws, the check assumes the default of
1 %. In a third row of 200 cases in place, the check receives the held-out image alone.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from services.fit.checks.alignment import TESTED_ERROR, Offset, reported_offset
from services.transport.platform import prepare_device
from tests.support.registered_phantoms import Noise, Phantom, Place, rendered_phantom

PHANTOMS, IN_PLACE_DRAWS, BESIDE_DRAWS = 20, 10, 5
SEED = 2027
"""Seed of the phantoms, which differs from those with which the check's thresholds were chosen."""
OFFSET_MM = 1.0
NOISE = (0.01, 0.1)


def told(phantom: Phantom, place: Place, draw: int, seed: Sequence[int], *, dim_alone: bool = False) -> Offset | None:
    """Run the check on one draw of noise; returns the offset that it reports, or None."""
    rng = np.random.default_rng([*seed, draw])
    noise = Noise(rng.uniform(*NOISE), is_constant=draw % 2 == 1, is_stated=draw // 2 % 2 == 0)
    photographed = phantom.photographed(place, noise, rng)
    if photographed.error <= TESTED_ERROR:
        return None
    seen = photographed.comparisons[1:] if dim_alone else photographed.comparisons
    return reported_offset("c0", seen, phantom.pixels, phantom.pixel_mm)


def row(offsets: Sequence[Offset | None]) -> dict[str, Any]:
    """Number of reported offsets, with mean and standard deviation of their lengths and median standard error, mm."""
    lengths = np.array([offset.length_mm for offset in offsets if offset is not None])
    errors = np.array([offset.length_se_mm for offset in offsets if offset is not None])
    told = {"n": len(offsets), "told": len(lengths)}
    if not len(lengths):
        return told
    figures = {"mean_mm": lengths.mean(), "sd_mm": lengths.std(), "median_se_mm": np.median(errors)}
    return told | {name: round(float(value), 4) for name, value in figures.items()}


def rates(drawn: Iterable[Phantom], seed: int) -> dict[str, Any]:
    """Counts of detections and false alarms over some phantoms."""
    in_place: list[Offset | None] = []
    dim: list[Offset | None] = []
    beside: list[Offset | None] = []
    for number, phantom in enumerate(drawn):
        for draw in range(IN_PLACE_DRAWS):
            in_place.append(told(phantom, phantom.in_place, draw, (seed, number, 0)))
            dim.append(told(phantom, phantom.in_place, draw, (seed, number, 0), dim_alone=True))
        for side, place in enumerate(phantom.beside):
            beside += [told(phantom, place, draw, (seed, number, 1 + side)) for draw in range(BESIDE_DRAWS)]
        accused, found = row(in_place), row(beside)
        print(
            f"{number + 1}: false {accused['told']} of {accused['n']}, found {found['told']} of {found['n']}",
            flush=True,
        )
    return {"in_place": row(in_place), "in_place_dim_image_alone": row(dim), "beside": row(beside)}


def main() -> None:
    """Measure and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True, help="where the figures go")
    options = parser.parse_args()
    prepare_device()
    begun_s, begun_core_s = time.monotonic(), time.process_time()
    figures = {"phantoms": PHANTOMS, "offset_mm": OFFSET_MM, "noise": NOISE, "seed": SEED}
    figures |= rates((rendered_phantom(SEED, number, OFFSET_MM) for number in range(PHANTOMS)), SEED)
    figures["minutes"] = round((time.monotonic() - begun_s) / 60, 1)
    figures["core_minutes"] = round((time.process_time() - begun_core_s) / 60, 1)
    options.json.write_text(json.dumps(figures, indent=1) + "\n")
    print(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
