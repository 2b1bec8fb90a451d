"""Render the jaw of ``tests/data/truths-jaw`` by stock Mitsuba in independent passes over all images; an interrupted
run continues with the next pass.

python -m tests.benchmarks.render_jaw_truth --work FOLDER
python -m tests.benchmarks.render_jaw_truth --work FOLDER --passes 4     stores the mean of four passes
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.assets.mitsuba.mouth_scene import mouth_scene, write_mouth_surfaces
from services.assets.mitsuba.scene import load_scene
from services.phantom.jaw import jaw_surfaces, known_mouth
from services.transport.platform import prepare_device
from tests.support.jaw_truth import CHANNEL, STORED, SUBJECT, cameras, lights, pack

PASSES, SAMPLES = 100, 64
"""Number of independent passes, and paths per pixel in each; a pass of 21 images takes 70 s of processor time."""


def load(folder: Path) -> Any:
    """Load the jaw's scene with all cameras in Mitsuba."""
    jaw = jaw_surfaces(SUBJECT)
    files = write_mouth_surfaces(folder, jaw.teeth, jaw.gums, jaw.cavity)
    fdi = tuple(tooth.fdi for tooth in jaw.teeth)
    return load_scene(
        mouth_scene(files, fdi, known_mouth(jaw, CHANNEL, SUBJECT), cameras(jaw), lights()[0].position_mm, 1.0)
    )


def render_pass(scene: Any, number: int) -> list[NDArray[np.float32]]:
    """Render one pass; returns the images (L, H, W) of every camera."""
    import mitsuba as mi

    params, images = mi.traverse(scene), []
    for n, light in enumerate(lights()):
        params["light.position"] = mi.Point3f(*light.position_mm)
        params["light.intensity.value"] = mi.Float(light.intensity[0])
        params.update()
        count = len(scene.sensors())
        images.append(
            [
                np.array(mi.render(scene, sensor=k, spp=SAMPLES, seed=(number * 64 + n) * 8 + k), dtype=np.float32)[
                    ..., 0
                ]
                for k in range(count)
            ]
        )
    return [np.stack(of_camera) for of_camera in zip(*images, strict=True)]


def main() -> None:
    """Render the passes that are missing, then store the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, help="folder of the passes")
    parser.add_argument("--passes", type=int, default=PASSES, help="how many to have, two at least")
    parser.add_argument("--out", type=Path, default=STORED)
    arguments = parser.parse_args()
    arguments.work.mkdir(parents=True, exist_ok=True)
    missing = [number for number in range(arguments.passes) if not (arguments.work / f"{number}.npz").exists()]
    if missing:
        prepare_device()
        with tempfile.TemporaryDirectory() as folder:
            scene = load(Path(folder))
            for number in missing:
                np.savez(arguments.work / f"{number}.npz", *render_pass(scene, number))
                print("pass", number, flush=True)
    with_passes = [np.load(arguments.work / f"{number}.npz") for number in range(arguments.passes)]
    images = [
        np.stack([one[f"arr_{k}"] for one in with_passes]).astype(np.float64)
        for k in range(len(cameras(jaw_surfaces(SUBJECT))))
    ]
    pack(arguments.out, images, arguments.passes * SAMPLES)
    print(arguments.out, arguments.out.stat().st_size)


if __name__ == "__main__":
    main()
