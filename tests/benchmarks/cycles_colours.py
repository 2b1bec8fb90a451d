"""Colours of one tooth in Cycles, by the fit's path tracing and in stock Mitsuba: ΔE00 of blocks of 8 by 8 pixels, in
two views under a sky, a wide lamp and a point.

make clients
python -m tests.benchmarks.cycles_colours --json colours.json [--seeds 6] [--paths 512] [--only "view 0, sky" ...]

The incisor of ``shared/data`` has the media of three channels, which are taken as linear sRGB. White is a perfect
diffuser that faces the light. The wide lamp, an environment that is bright within 45 degrees of one direction, shows
the same as the point: light from one side on the same media. Light that has scattered inside meets it by chance, which
no path does with a point: blocks have a standard error of 0.35 % in each program at some 2,300 paths a pixel, where a
point needs 5,500. ``--merge 2`` compares squares of two by two blocks, which need a quarter. Renders are stored by
view, light, program and seed, so that the benchmark goes on where it ended, and rows are of the seeds that both
programs have. A row compares a program with Mitsuba: it states the ΔE00's median and 95 %, and of the squares' relative
standard errors the median and greatest; with noise alone ΔE00 is about the same number of percent.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from services.core.files.meshes import read_mesh
from services.core.store import write_atomic
from services.transport.platform import prepare_device
from tests.benchmarks.cycles import RGB, TRUTH
from tests.support.cycles_scenes import LAMP, Case, cycles_image, engine_image, mitsuba_image, wide_lamp, write_case
from tests.support.small_tooth import camera_at

BLOCK = 8
SIZE = (64, 80)
"""Width and height, pixels."""
DIRECTIONS = ((0.2, 1.0, 0.15), (-0.9, 0.7, -0.2))
Array = NDArray[np.float64]
Renderer = Callable[[Path, Case, int, int], Array]
Light = Literal["sky", "wide lamp", "lamp"]
LIGHTS: tuple[Light, ...] = get_args(Light)
PROGRAMS: dict[str, Renderer] = {"mitsuba": mitsuba_image, "cycles": cycles_image, "engine": engine_image}


def case_of(view: int, light: Light) -> Case:
    """The incisor in one view."""
    outer, dentin = (read_mesh(TRUTH / "teeth" / "11" / f"{name}.ply") for name in ("outer", "dentin"))
    square = camera_at(DIRECTIONS[view], size=SIZE[0], span_mm=11.0)
    (fx, _, cx), (_, fy, _), last = square.K
    camera = square.model_copy(update={"size": SIZE, "K": ((fx, 0.0, cx), (0.0, fy, SIZE[1] / 2), last)})
    case = Case(outer, dentin, RGB, camera)
    return replace(case, lit_by=light)


def blocks(image: Array) -> Array:
    """Means (N, 3) of blocks of pixels, row by row."""
    height, width, channels = image.shape
    parts = image.reshape(height // BLOCK, BLOCK, width // BLOCK, BLOCK, channels)
    return np.asarray(parts.mean(axis=(1, 3)).reshape(-1, channels))


def merged(values: Array, shown: NDArray[np.bool_], edge: int) -> Array:
    """Means (S, M, 3) over the shown blocks in squares of ``edge`` by ``edge``, of which half at least show the tooth.

    Args:
        values: blocks (S, N, 3) of each seed, row by row.
        shown: which blocks (N,) show the tooth alone.
    """
    columns = SIZE[0] // BLOCK
    row, column = np.divmod(np.arange(len(shown)), columns)
    square = row // edge * -(-columns // edge) + column // edge
    count = np.bincount(square, shown)
    kept = np.flatnonzero(count >= edge**2 / 2)
    return np.stack([values[:, shown & (square == one)].mean(axis=1) for one in kept], axis=1)


def differences(ours: Array, theirs: Array, white: float) -> Array:
    """ΔE00 (N,) of linear sRGB colours (N, 3)."""
    import colour

    space = colour.RGB_COLOURSPACES["sRGB"]
    labs = [
        colour.XYZ_to_Lab(colour.RGB_to_XYZ(values / white, space, apply_cctf_decoding=False), space.whitepoint)
        for values in (ours, theirs)
    ]
    return np.asarray(colour.delta_E(*labs, method="CIE 2000"))


def row_of(
    renders: dict[str, list[Any]], program: str, shown: NDArray[np.bool_], white: float, edge: int
) -> dict[str, Any]:
    """The row of blocks (N, 3) that a program and Mitsuba rendered with each seed, merged in squares."""
    seeds = min(len(renders[name]) for name in (program, "mitsuba"))
    ours, theirs = (merged(np.array(renders[name][:seeds]), shown, edge) for name in (program, "mitsuba"))
    found = differences(ours.mean(axis=0), theirs.mean(axis=0), white)
    spread = [each.std(axis=0, ddof=1) / math.sqrt(len(each)) / each.mean(axis=0) for each in (ours, theirs)]
    se = np.hypot(*spread)
    return {
        "squares": ours.shape[1],
        "edge_px": edge * BLOCK,
        "seeds": len(ours),
        "median": round(float(np.median(found)), 3),
        "95 %": round(float(np.quantile(found, 0.95)), 3),
        "se": [round(float(value), 5) for value in (np.median(se), se.max())],
        "ratio": (ours.mean(axis=(0, 1)) / theirs.mean(axis=(0, 1))).round(5).tolist(),
    }


def main() -> None:
    """Add the renders that the file lacks, and the rows of all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--paths", type=int, default=512, help="paths per pixel and seed")
    parser.add_argument("--programs", nargs="+", default=list(PROGRAMS))
    parser.add_argument("--only", nargs="+", help="names of rows")
    parser.add_argument("--merge", type=int, default=1, help="edge of the compared squares, in blocks")
    options = parser.parse_args()
    prepare_device()
    point = float(LAMP.intensity[0] / np.sum(np.square(LAMP.position_mm)) / math.pi)
    whites = {"sky": 1.0, "wide lamp": wide_lamp()[1], "lamp": point}
    stored = json.loads(options.json.read_text()) if options.json.is_file() else {"paths": options.paths}
    if stored["paths"] != options.paths:
        parser.error(f"{options.json} holds renders of {stored['paths']} paths; name another file.")
    for view in range(len(DIRECTIONS)):
        for light in LIGHTS:
            name = f"view {view}, {light}"
            if options.only and name not in options.only:
                continue
            case = case_of(view, light)
            renders = stored.setdefault("renders", {}).setdefault(name, {})
            shown = blocks(case.covered()[..., None].astype(float))[:, 0] == 1
            white = whites[light]
            with TemporaryDirectory() as place:
                write_case(Path(place), case)
                for seed in range(options.seeds):
                    for program in options.programs:
                        image = PROGRAMS[program]
                        if len(renders.setdefault(program, [])) <= seed:
                            found = blocks(image(Path(place), case, options.paths, seed + 1))
                            renders[program].append(found.round(7).tolist())
                            write_atomic(options.json, json.dumps(stored).encode())
            for program in options.programs:
                if program != "mitsuba":
                    row = row_of(renders, program, shown, white, options.merge)
                    stored.setdefault("rows", {})[f"{name}, {program}"] = row
                    print(name, program, row, flush=True)
            write_atomic(options.json, json.dumps(stored).encode())


if __name__ == "__main__":
    main()
