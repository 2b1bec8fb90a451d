"""Shares of the shadowed pixels that preparation finds and of the lit pixels that it flags, on a virtual jaw with lips.

dentine phantom --out JAW --jaw --lips --renderer mitsuba --subject 7
    --pixel-mm 0.5 --cameras 2 --lights 12 --samples 64
python -m tests.benchmarks.shadows JAW --json shadows.json

Noise of a sensor is added to the images, which are then prepared with the option ``shadows``. The truth follows from
rays from 16 points of each pixel towards each light: a pixel is shadowed where lips and retractor, which are in no file
that the preparation reads, hold back more than half of the direct light that passes all scanned surfaces. Counted are
pixels that show only teeth and meet the light at less than 84 degrees; those that scanned surfaces shade are neither.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from services.assets.mitsuba.scene import load_scene, surface_dict
from services.core.files.meshes import read_mesh, read_teeth
from services.core.geometry import Camera, Light
from services.core.records import FolderCapture, JobSpec, MaskBit
from services.core.stage import LocalContext
from services.core.store import read_record, write_atomic
from services.preprocess import stage
from services.preprocess.views.projection import project
from services.transport.platform import prepare_device

NOISE_RELATIVE, NOISE_FLOOR = 0.01, 0.002
"""Standard deviation of the sensor's noise as shares of the pixel's value and of the image's maximum."""
FINER = 4
"""Number of points along each side of a pixel from which rays start."""
MIN_COSINE = 0.1
"""Smallest cosine between normal and light of the pixels that are counted, 84 degrees."""
CLEARANCE_MM = 0.02
"""Distance from the surface at which a ray starts, more than float32 loses at these coordinates."""
LIPS = "truth_lips.ply"
Bools = NDArray[np.bool_]


def main() -> None:
    """Prepare the capture and write its row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    prepare_device()
    description = read_record(options.capture / "capture.json", FolderCapture)
    with tempfile.TemporaryDirectory() as folder:
        flags = flags_of(options.capture, Path(folder), description, np.random.default_rng(options.seed))
    rows = {
        camera.name: row_of(*truth(options.capture, camera, description.lights), flags[number])
        for number, camera in enumerate(description.cameras)
    }
    write_atomic(options.json, json.dumps(rows, indent=1).encode())
    for name, row in rows.items():
        print(name, ", ".join(f"{key} {value:.4g}" for key, value in row.items()))


def flags_of(capture: Path, folder: Path, description: FolderCapture, random: np.random.Generator) -> Bools:
    """Prepare noisy photographs of a capture; returns the flagged pixels (cameras, L, H, W)."""
    noisy = folder / "capture"
    shutil.copytree(capture, noisy, ignore=shutil.ignore_patterns(LIPS, "truth.json"))
    for image in description.images:
        clean = np.load(capture / image.file).astype(np.float64)
        deviation = np.hypot(NOISE_RELATIVE * clean, NOISE_FLOOR * clean.max())
        np.save(noisy / image.file, (clean + deviation * random.standard_normal(clean.shape)).astype(np.float32))
        if image.variance_file is not None:
            rendered = np.load(capture / image.variance_file)
            np.save(noisy / image.variance_file, (rendered + deviation**2).astype(np.float32))
    stage.run(JobSpec(capture=noisy, kind="jaw", shadows=True), LocalContext(folder))
    valid = np.asarray(zarr.open_array(folder / "prepared" / "prepared.zarr" / "valid", mode="r")[:])
    return np.asarray(valid & np.uint16(MaskBit.SHADOW) > 0)


def truth(capture: Path, camera: Camera, lights: tuple[Light, ...]) -> tuple[Bools, Bools]:
    """Pixels that are counted, and those of them that lie in the shadow of lips or retractor, each (L, H, W)."""
    teeth = [tooth.outer for tooth in read_teeth(capture)]
    scanned = [*sorted((capture / "teeth").glob("*/outer.ply")), capture / "gums.ply", capture / "cavity.ply"]
    known, lips = (
        load_scene({"type": "scene"} | {f"s{k}": surface_dict(path, {"type": "diffuse"}) for k, path in enumerate(own)})
        for own in (scanned, [capture / LIPS])
    )
    width, height = camera.size
    covered = project(camera, teeth, [read_mesh(capture / "gums.ply"), read_mesh(capture / LIPS)]).covered
    fine = camera.model_copy(
        update={
            "size": (FINER * width, FINER * height),
            "K": (*(tuple(FINER * value for value in row) for row in camera.K[:2]), camera.K[2]),
        }
    )
    view = project(fine, teeth)
    y, x = np.nonzero(view.mesh >= 0)
    points, normals = view.points_at(fine, y, x), view.normal[y, x].astype(np.float64)
    counted, shadowed = (np.zeros((len(lights), height, width), dtype=bool) for _ in range(2))
    for k, light in enumerate(lights):
        way = np.asarray(light.position_mm) - points
        cosine = (way * normals).sum(axis=-1) / np.linalg.norm(way, axis=-1)
        starts = points + CLEARANCE_MM * normals
        direct = np.maximum(cosine, 0) * ~_blocked(known, starts, light)
        past_lips = direct * ~_blocked(lips, starts, light)
        sums = np.zeros((3, height, width))
        for total, values in zip(sums, (np.maximum(cosine, 0), direct, past_lips), strict=True):
            np.add.at(total, (y // FINER, x // FINER), values)
        counted[k] = covered & (sums[0] > MIN_COSINE * FINER**2) & (sums[1] > sums[0] / 2)
        shadowed[k] = counted[k] & (sums[2] < sums[1] / 2)
    return counted, shadowed


def _blocked(scene: Any, starts_mm: NDArray[np.float64], light: Light) -> Bools:
    """Whether a surface of the scene lies between each point (N, 3) and the light."""
    import mitsuba as mi

    way = np.asarray(light.position_mm) - starts_mm
    distance = np.linalg.norm(way, axis=-1)
    ray = mi.Ray3f(mi.Point3f(starts_mm.T), mi.Vector3f((way / distance[:, None]).T), mi.Float(distance), 0.0, [])
    return np.asarray(scene.ray_test(ray)).astype(bool)


def row_of(counted: Bools, shadowed: Bools, flagged: Bools) -> dict[str, float]:
    """Shares of found shadows and of false flags, over all lights of a camera."""
    found = flagged[:, : counted.shape[1], : counted.shape[2]]
    lit = counted & ~shadowed
    return {
        "found": float(found[shadowed].mean()),
        "false": float(found[lit].mean()),
        "shadowed_pixels": int(shadowed.sum()),
        "lit_pixels": int(lit.sum()),
    }


if __name__ == "__main__":
    main()
