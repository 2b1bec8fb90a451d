"""Render the photographs of a full-size tooth with little noise, resumable: one channel, 3 views under 54 lights at
0.064 mm, about 24,000 pixels a view, to judge the speed of a fit by.

python -m tests.benchmarks.render_clean_tooth --passes 90
python -m tests.benchmarks.render_clean_tooth --pack tests/data/clean-tooth.npz
python -m tests.benchmarks.render_clean_tooth --unpack FOLDER

The photographs of ``dentine bench tooth --case scale`` have 64 paths a pixel and 41 % noise a value, more than any real
sensor, so what a fit gains on them says little of a real capture. A pass adds 64 paths a pixel, from seeds of its own,
in some two minutes of one core; the sums lie in ``.cache/clean-tooth``. The file holds means in half precision and the
relative standard error of each value in steps of 1/256.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.anatomy.dentin_shape import DentinShape
from services.anatomy.templates.incisor import build_incisor
from services.bench.fits.tooth_scale import CAMERAS, LIGHTS, PIXEL_MM
from services.core.files.meshes import write_mesh
from services.core.geometry import Camera, Tooth, teeth_folder
from services.phantom.dome_rig import dome_cameras, dome_lights
from services.phantom.files import held_out_lights, medium_truth, write_description, write_images
from services.phantom.reflection import reflect
from services.phantom.subjects import subject_tissues
from services.phantom.surface import IOR
from services.phantom.tooth import FDI
from services.transport.engine import Engine
from services.transport.platform import prepare_device
from services.transport.scene.recipe import View, single_tooth

SUMS = Path(".cache") / "clean-tooth"
PACKED = Path("tests") / "data" / "clean-tooth.npz"
"""The photographs of 56 passes, 5.0 % noise a value."""
SAMPLES, SUBJECT, SEED, CHANNEL = 64, 1, 1, "green"
STEPS_PER_ERROR = 256
"""Steps of a stored relative standard error per unit."""


@dataclass(frozen=True)
class Rig:
    """The scene, its cameras, and the pixels (N, 2) of each camera that show the tooth."""

    engine: Engine
    cameras: tuple[Camera, ...]
    pixels: dict[str, NDArray[np.int32]]


def rig() -> Rig:
    """The tooth of the benchmark ``tooth --case scale``."""
    prepare_device()
    incisor, lights = build_incisor(), dome_lights(LIGHTS, (CHANNEL,), SEED)
    cameras = dome_cameras(CAMERAS, PIXEL_MM, (incisor.outer,))
    seen = {
        camera.name: reflect(incisor.outer, None, camera, lights, (CHANNEL,), IOR).enamel_pixels for camera in cameras
    }
    recipe = single_tooth(
        outer=incisor.outer,
        dentin=DentinShape.known(incisor.dentin),
        light_positions_mm=np.array([light.position_mm for light in lights]),
        light_intensities=np.array([light.intensity[0] for light in lights]),
        boundary="matched",
        ior=IOR,
    )
    pixels = {name: np.argwhere(mask)[:, ::-1].astype(np.int32) for name, mask in seen.items()}
    return Rig(Engine(recipe), cameras, pixels)


def render(passes: int) -> None:
    """Add passes until every camera has so many."""
    scene, tissue = rig(), subject_tissues(SUBJECT, (CHANNEL,))[CHANNEL]
    SUMS.mkdir(parents=True, exist_ok=True)
    for number in range(passes):
        for k, camera in enumerate(scene.cameras):
            stored = SUMS / f"{camera.name}.npz"
            pixels = scene.pixels[camera.name]
            sums, count = _sums(stored, (2, LIGHTS, len(pixels)))
            if count > number:
                continue
            seed = SEED + 7919 * k + 104729 * (number + 1)
            mean = scene.engine.images(tissue, View(camera, pixels), samples=SAMPLES, seed=seed, batches=1).mean
            sums += np.stack([mean, mean**2])
            part = stored.with_suffix(".part.npz")
            np.savez(part, sums=sums, count=count + 1)
            part.replace(stored)
            if count > 0:
                mean, error = _estimate(sums, count + 1)
                noise = float(np.sqrt((error**2).sum() / (mean**2).sum()))
                print(f"{camera.name}: {count + 1} passes, {100 * noise:.1f} % noise a value", flush=True)


def _sums(stored: Path, shape: tuple[int, ...]) -> tuple[NDArray[np.float64], int]:
    if not stored.is_file():
        return np.zeros(shape), 0
    with np.load(stored) as known:
        return known["sums"], int(known["count"])


def _estimate(sums: NDArray[np.float64], count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    # Mean and its standard error (L, N) from the spread of the passes.
    mean = sums[0] / count
    return mean, np.sqrt(np.maximum(sums[1] / count - mean**2, 0.0) / (count - 1))


def pack(target: Path) -> None:
    """Store the photographs rendered so far."""
    arrays: dict[str, NDArray[np.generic]] = {}
    for stored in sorted(SUMS.glob("c?.npz")):
        with np.load(stored) as known:
            mean, error = _estimate(known["sums"], int(known["count"]))
        scale = float(mean.max())
        share = np.divide(error, mean, out=np.ones_like(mean), where=mean > error)
        arrays[f"{stored.stem}_mean"] = (np.maximum(mean, 0.0) / scale).astype(np.float16)
        arrays[f"{stored.stem}_scale"] = np.array(scale)
        arrays[f"{stored.stem}_error"] = np.clip(np.ceil(STEPS_PER_ERROR * share), 1, 255).astype(np.uint8)
    np.savez_compressed(target, allow_pickle=False, **arrays)
    print(f"{target}: {target.stat().st_size / 2**20:.1f} MiB")


def unpack(source: Path, folder: Path) -> None:
    """Write the stored photographs as a folder capture."""
    scene, lights = rig(), dome_lights(LIGHTS, (CHANNEL,), SEED)
    tissue, entries = subject_tissues(SUBJECT, (CHANNEL,))[CHANNEL], []
    with np.load(source) as stored:
        for camera in scene.cameras:
            width, height = camera.size
            x, y = scene.pixels[camera.name].T
            mean = stored[f"{camera.name}_mean"].astype(np.float64) * float(stored[f"{camera.name}_scale"])
            images = np.zeros((2, LIGHTS, height, width, 1))
            images[:, :, y, x, 0] = mean, (mean * stored[f"{camera.name}_error"] / STEPS_PER_ERROR) ** 2
            entries += write_images(folder, camera, lights, images[0], images[1], held_out_lights(LIGHTS, None))
    incisor = build_incisor()
    tooth = Tooth(FDI, incisor.outer, incisor.dentin)
    for name, mesh in (("outer", tooth.outer), ("dentin", incisor.dentin)):
        write_mesh(teeth_folder(folder, FDI) / f"{name}.ply", mesh)
    media = {"enamel": medium_truth(tissue.enamel), "dentin": medium_truth(tissue.dentin)}
    truth = {"boundary": "matched", "ior": 1.0, "channels": {CHANNEL: media}, "renderer": "engine", "seed": SEED}
    write_description(folder, (CHANNEL,), scene.cameras, lights, entries, truth)
    print(json.dumps({"capture": str(folder), "images": len(entries)}))


def main() -> None:
    """Render, pack or unpack."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--passes", type=int, default=0, help="render until each camera has so many passes")
    parser.add_argument("--pack", type=Path, help="store what was rendered in this file")
    parser.add_argument("--unpack", type=Path, help="folder to write the capture to")
    parser.add_argument("--file", type=Path, default=PACKED, help="file to unpack")
    arguments = parser.parse_args()
    if arguments.passes:
        render(arguments.passes)
    if arguments.pack:
        pack(arguments.pack)
    if arguments.unpack:
        unpack(arguments.file, arguments.unpack)


if __name__ == "__main__":
    main()
