"""Blender's Cycles against stock Mitsuba: the mean radiance of a tooth or ball, by channel.

make clients
python -m tests.benchmarks.cycles --json cycles.json [--only NAME ...] [--seeds 4]

Every row of the table stands in the file as soon as it is known, and a row that stands there is not rendered again. A
row holds Cycles ÷ Mitsuba by channel, its standard error from the seeds, and the limit of its deviation from 1. The row
``coincident`` renders a script without the gap between touching bodies: it must be off by more than 5 %.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from services.assets.mitsuba.dielectric import ROUGHNESS
from services.core.files.meshes import read_mesh
from services.core.store import write_atomic
from services.transport.optics.parameters import Medium, Tissue
from services.transport.platform import prepare_device
from tests.support.cycles_scenes import Case, ball, cycles_image, empty, mitsuba_image, ratio_of, write_case
from tests.support.processor_times import processor_s
from tests.support.small_tooth import camera_at

ENAMEL, DENTIN = Medium(4.5, 0.997, 0.93, 0.82, -0.1), Medium(12.0, 0.9945, 1.0, 0.75)
"""The incisor's media of ``shared/data/tooth-ur1-truth``."""
RGB = tuple(
    Tissue(replace(ENAMEL, sigma=s, alpha=a), replace(DENTIN, sigma=2 * s, alpha=b))
    for s, a, b in ((4.0, 0.998, 0.997), (4.5, 0.997, 0.993), (5.2, 0.993, 0.982))
)
OWN_COSINES = tuple(
    Tissue(replace(tissue.enamel, g1=g), replace(tissue.dentin, g1=g - 0.08))
    for tissue, g in zip(RGB, (0.84, 0.82, 0.79), strict=True)
)
DIELECTRIC = {"type": "dielectric", "int_ior": 1.631, "ext_ior": 1.0}
TRUTH = Path(__file__).resolve().parents[3] / "shared" / "data" / "tooth-ur1-truth"


def cases() -> dict[str, tuple[Callable[[], Case], int, int, float]]:
    """By name: the case, paths per pixel of Cycles and of Mitsuba for each seed, and the limit."""
    one = (Tissue(Medium(2.5, 0.99, 1.0, 0.6), empty()),)
    two = (Tissue(ENAMEL, DENTIN),)
    view = camera_at((0.3, 1.0, 0.2), size=16, span_mm=7.0)
    tooth_view = camera_at((0.2, 1.0, 0.15), size=16, span_mm=16.0)
    simple, nested = Case(ball(3.0), None, one, view), Case(ball(3.0), ball(2.4), two, view)

    def incisor(**changed: Any) -> Case:
        outer, dentin = (read_mesh(TRUTH / "teeth" / "11" / f"{name}.ply") for name in ("outer", "dentin"))
        return replace(Case(outer, dentin, two, tooth_view), **changed)

    return {
        "ball, sky": (lambda: simple, 1024, 1024, 0.005),
        "ball, lamp": (lambda: replace(simple, lit_by="lamp"), 8192, 8192, 0.005),
        "nested balls, sky": (lambda: nested, 1024, 1024, 0.005),
        "nested balls, lamp": (lambda: replace(nested, lit_by="lamp"), 8192, 8192, 0.01),
        "nested balls, RGB, sky": (lambda: replace(nested, tissues=RGB), 1024, 1024, 0.005),
        "nested balls, RGB, lamp": (lambda: replace(nested, tissues=RGB, lit_by="lamp"), 8192, 4096, 0.01),
        "nested balls, own cosines, sky": (lambda: replace(nested, tissues=OWN_COSINES), 2048, 1024, 0.005),
        "nested balls, thin, sky": (lambda: replace(nested, boundary="thin"), 1024, 1024, 0.005),
        "nested balls, thin, lamp": (lambda: replace(nested, boundary="thin", lit_by="lamp"), 8192, 8192, 0.01),
        "glass ball, sky": (
            lambda: replace(
                simple, boundary="thin", glass=DIELECTRIC, words=("--surface", "glass", "--roughness", "0")
            ),
            2048,
            2048,
            0.01,
        ),
        "rough glass ball, sky": (
            lambda: replace(
                simple,
                boundary="thin",
                glass=DIELECTRIC | {"type": "roughdielectric", "alpha": ROUGHNESS},
                words=("--surface", "glass"),
            ),
            2048,
            2048,
            0.01,
        ),
        "rough ball, sky": (lambda: replace(simple, boundary="rough", roughness=0.3), 2048, 2048, 0.01),
        "rough ball, lamp": (
            lambda: replace(simple, boundary="rough", roughness=0.1, lit_by="lamp"),
            8192,
            8192,
            0.02,
        ),
        "incisor, sky": (incisor, 1024, 1024, 0.01),
        "incisor, lamp": (lambda: incisor(lit_by="lamp"), 2048, 2048, 0.02),
        "incisor, RGB, sky": (lambda: incisor(tissues=RGB), 1024, 1024, 0.01),
        "incisor, RGB, lamp": (lambda: incisor(tissues=RGB, lit_by="lamp"), 2048, 2048, 0.02),
        "incisor, thin, sky": (lambda: incisor(boundary="thin"), 1024, 1024, 0.01),
        "incisor, own cosines, sky": (lambda: incisor(tissues=OWN_COSINES), 1024, 512, 0.01),
        "coincident": (lambda: replace(nested, lit_by="lamp"), 1024, 1024, 0.05),
    }


def row_of(name: str, case: Case, paths: tuple[int, int], seeds: int, limit: float) -> dict[str, Any]:
    """Render one case and compare."""
    with TemporaryDirectory() as place:
        folder = Path(place)
        write_case(folder, case)
        if name == "coincident":
            script = folder / "blender" / "blender_scene.py"
            script.write_text(script.read_text().replace("GAP_MM = 1e-4", "GAP_MM = 0.0"))
        started = processor_s()
        cycles = np.stack([cycles_image(folder, case, paths[0], seed) for seed in range(seeds)])
        between = processor_s()
        mitsuba = np.stack([mitsuba_image(folder, case, paths[1], seed) for seed in range(seeds)])
        ended = processor_s()
    ratio = ratio_of(cycles, mitsuba, case.covered())
    off = float(np.abs(ratio.value - 1).max())
    return {
        "ratio": ratio.value.round(5).tolist(),
        "se": ratio.se.round(5).tolist(),
        "limit": limit,
        "passes": off > limit if name == "coincident" else off <= limit,
        "seeds": seeds,
        "cycles_s": round(between - started, 1),
        "mitsuba_s": round(ended - between, 1),
    }


def main() -> None:
    """Add the rows that the file lacks."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--only", nargs="+", help="names of rows")
    parser.add_argument("--seeds", type=int, default=4)
    options = parser.parse_args()
    prepare_device()
    rows = json.loads(options.json.read_text()) if options.json.is_file() else {}
    for name, (case, *paths, limit) in cases().items():
        if name in rows or (options.only and name not in options.only):
            continue
        started = time.monotonic()
        rows[name] = row_of(name, case(), (paths[0], paths[1]), options.seeds, limit)
        write_atomic(options.json, (json.dumps(rows, indent=1) + "\n").encode())
        print(name, rows[name], f"{time.monotonic() - started:.0f} s", flush=True)


if __name__ == "__main__":
    main()
