"""Render the central incisor of ``tests/data/truths`` by stock Mitsuba with its tooth or its dome of lights moved, for
``instrument_coverage``.

python -m tests.benchmarks.render_moves --variant cuda_ad_mono --samples 2048

An H200 takes 100 s for 2,048 samples a pixel. The images of all moves have the same seeds.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.files.meshes import write_mesh
from services.core.geometry import Camera, Mesh
from services.fit.coordinates.instrument_errors import DEFAULT_MOVE_SE
from services.transport.optics.parameters import Medium, Tissue
from services.transport.scene.rigid_moves import rigid
from tests.benchmarks.instrument_errors import SUBJECT
from tests.support.truths import SIDE_LIGHTS, Truth, read

Array = NDArray[np.float64]

STORED = Path(__file__).resolve().parents[1] / "data" / "moves" / f"{SUBJECT}.npz"
SIGMAS = 2.0
"""Standard errors of a stated position by which a move is rendered; its images are then divided by it."""


@dataclass(frozen=True)
class Place:
    """Where tooth and lights stand."""

    name: str
    tooth_move: Array
    """Rigid transform (4, 4) of the tooth in the world."""
    lights_mm: Array
    """Positions (L, 3)."""


def places(truth: Truth) -> Iterator[Place]:
    """The true place, and one for each of the twelve moves."""
    described = truth.description["lights"]
    every_mm = np.array([light["position_mm"] for light in described])
    fitted = every_mm[[light["name"] not in SIDE_LIGHTS for light in described]]
    tooth_centre_mm = truth.meshes["outer"].vertices_mm.mean(axis=0)
    yield Place("none", np.eye(4), fitted)
    for body, errors in DEFAULT_MOVE_SE.items():
        for axis, twist in enumerate(SIGMAS * np.diag(errors)):
            if body == "teeth":
                yield Place(f"{body}.{axis}", rigid(twist, tooth_centre_mm), fitted)
            else:
                yield Place(f"{body}.{axis}", np.eye(4), _moved(rigid(twist, every_mm.mean(axis=0)), fitted))


def _moved(move: Array, points_mm: Array) -> Array:
    return np.asarray(points_mm @ move[:3, :3].T + move[:3, 3])


def render(truth: Truth, place: Place, samples: int, folder: Path) -> dict[str, Array]:
    """Images (L, H, W) under the fitted lights by camera."""
    import mitsuba as mi

    from services.assets.mitsuba.scene import load_scene, nested_scene

    enamel, dentin = (
        Medium(one["sigma"], one["alpha"], beta=one["beta"], g1=one["g1"], g2=one["g2"])
        for one in (truth.medium("enamel"), truth.medium("dentin"))
    )
    files = []
    for part in ("outer", "dentin"):
        mesh = truth.meshes[part]
        files.append(folder / f"{place.name}-{part}.ply")
        write_mesh(files[-1], Mesh(_moved(place.tooth_move, mesh.vertices_mm), mesh.faces))
    cameras = tuple(Camera.model_validate(camera) for camera in truth.description["cameras"])
    lights = [light for light in truth.description["lights"] if light["name"] not in SIDE_LIGHTS]
    surfaces = {truth.fdi: (files[0], files[1])}
    scene: Any = load_scene(nested_scene(surfaces, Tissue(enamel, dentin), cameras, place.lights_mm[0], 1.0))
    params = mi.traverse(scene)
    images: dict[str, list[Array]] = {camera.name: [] for camera in cameras}
    for n, (light, position_mm) in enumerate(zip(lights, place.lights_mm.tolist(), strict=True)):
        params["light.position"] = mi.Point3f(*position_mm)
        params["light.intensity.value"] = mi.Float(light["intensity"][0])
        params.update()
        for c, camera in enumerate(cameras):
            image = mi.render(scene, sensor=c, spp=samples, seed=101 * c + n)
            images[camera.name].append(np.array(image, dtype=np.float64)[..., 0])
    return {name: np.stack(own) for name, own in images.items()}


def main() -> None:
    """Render all places and store the true images and the changes by each move."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--variant", default="llvm_ad_mono", help="of Mitsuba")
    parser.add_argument("--samples", type=int, default=2048, help="paths per pixel and light")
    parser.add_argument("--out", type=Path, default=STORED)
    arguments = parser.parse_args()
    import mitsuba as mi

    mi.set_variant(arguments.variant)
    truth, stored, names = read(SUBJECT), dict[str, Any](), list[str]()
    with tempfile.TemporaryDirectory() as folder:
        for place in places(truth):
            images = render(truth, place, arguments.samples, Path(folder))
            for camera, own in images.items():
                if place.name == "none":
                    stored[f"{camera}_none"] = own.astype(np.float32)
                else:
                    change = (own - stored[f"{camera}_none"]) / SIGMAS
                    stored[f"{camera}_{place.name}"] = change.astype(np.float32)
            names.append(place.name)
            print(place.name, flush=True)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(arguments.out, allow_pickle=False, names=names[1:], samples=arguments.samples, **stored)


if __name__ == "__main__":
    main()
