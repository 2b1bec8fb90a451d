"""Renders the synthetic tabs by stock Mitsuba, and writes the guide that a laboratory would have measured of them:
``python -m tests.benchmarks.shade_guide``, some minutes.

Stock ``prbvolpath`` shares no transport code with the engine. The geometry is built here from its definition alone: a
ring of lights at 45 degrees to the normal, a view along it, and a spot of 3 mm.
"""

from __future__ import annotations

import argparse
import csv
import sys
import tempfile
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from services.assets.appearance.white import CameraWhite
from services.assets.mitsuba.scene import SceneDict, nested_scene
from services.core.files.meshes import write_mesh
from tests.support.shade_tabs import CHANNELS, NAMES, dentin, outer, spot, tissues

OUT = Path(__file__).parents[1] / "data" / "shade" / "guide.csv"
SAMPLES, BATCHES, PIXELS = 96, 6, 8
"""Paths a pixel and batch, batches whose spread gives the standard error, and pixels across the film."""
DISTANCE_MM, APERTURE_MM, LIGHTS = 500.0, 3.0, 8


def scene(folder: Path, name: str, channel: int) -> SceneDict:
    """The tab under the ring of lights, seen along the normal, for one channel."""
    at = spot()
    first = np.cross(at.normal, [0.0, 0.0, 1.0])
    first /= np.linalg.norm(first)
    second = np.cross(at.normal, first)
    files = {"11": (folder / "outer.ply", folder / "dentin.ply")}
    base: SceneDict = nested_scene(files, tissues(name)[channel], (), (0.0, 0.0, 0.0), 1.0)
    base.pop("light")
    for k in range(LIGHTS):
        angle = 2 * np.pi * (k + 0.5) / LIGHTS
        direction = (np.cos(angle) * first + np.sin(angle) * second + at.normal) / np.sqrt(2)
        position = at.point_mm + DISTANCE_MM * direction
        base[f"light_{k}"] = {"type": "point", "position": position.tolist(), "intensity": 1.0}
    eye = at.point_mm + DISTANCE_MM * at.normal
    pose = mi.ScalarTransform4f().look_at(origin=eye.tolist(), target=at.point_mm.tolist(), up=first.tolist())
    base["sensor"] = {
        "type": "perspective", "to_world": pose, "near_clip": 1.0, "far_clip": 1e5,
        "fov": float(np.degrees(2 * np.arctan(APERTURE_MM / 2 / DISTANCE_MM))),
    }  # fmt: skip
    film = {"type": "hdrfilm", "width": PIXELS, "height": PIXELS, "pixel_format": "luminance"}
    base["sensor"]["film"] = film | {"rfilter": {"type": "box"}}
    base["integrator"] = {"type": "prbvolpath", "max_depth": 5000, "rr_depth": 100}
    return base


def relative(folder: Path, name: str, channel: int) -> tuple[float, float]:
    """Mean radiance over the spot relative to a perfect diffuser's, and its standard error."""
    loaded: Any = mi.load_dict(scene(folder, name, channel), optimize=False)
    middles = np.arange(PIXELS) + 0.5 - PIXELS / 2
    inside = np.hypot(*np.meshgrid(middles, middles)) <= PIXELS / 2
    white = LIGHTS * np.cos(np.pi / 4) / (np.pi * DISTANCE_MM**2)
    means = [
        float(np.array(mi.render(loaded, spp=SAMPLES, seed=k))[..., 0][inside].mean()) / white for k in range(BATCHES)
    ]
    return float(np.mean(means)), float(np.std(means, ddof=1) / np.sqrt(BATCHES))


def main() -> None:
    """Render all tabs and write the guide."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    mi.set_variant("llvm_ad_mono")
    white = CameraWhite(None)
    OUT.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as place, OUT.open("w", newline="") as stream:
        folder = Path(place)
        write_mesh(folder / "outer.ply", outer())
        write_mesh(folder / "dentin.ply", dentin())
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(["tab", "geometry", "illuminant", "L", "a", "b", "se"])
        for name in NAMES:
            values = [relative(folder, name, channel) for channel in range(len(CHANNELS))]
            means, errors = (np.array(column) for column in zip(*values, strict=True))
            lab = white.lab(means[None], "D65")[0]
            drawn = white.lab(np.random.default_rng(0).normal(means, errors, (400, 3)), "D65")
            se = float(drawn.std(axis=0).max())
            table.writerow([name, "45/0", "D65", *(f"{value:.3f}" for value in lab), f"{se:.3f}"])
            print(name, means.round(4), lab.round(2), round(se, 3), file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
