"""Captures of single teeth with known optics, rendered by stock Mitsuba; ``tests/benchmarks/render_truths.py`` made
them.

A file holds one tooth: meshes, rig, optics, and per camera the images (L, H, W) with the standard error of each pixel.
Sensor noise is added when a capture is written.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.bench.fits.tooth_capture import photograph
from services.core.files.meshes import read_mesh, write_mesh
from services.core.geometry import Mesh, teeth_folder

FOLDER = Path(__file__).resolve().parents[1] / "data" / "truths"
SIDE_LIGHTS = ("l2", "l4", "l6")
"""Lights to hold out, at 54, 75 and 94 degrees from the front; the last one grazes the tooth from the side. Five lights
between them remain for the fit."""


@dataclass(frozen=True)
class Truth:
    """One tooth as stock Mitsuba renders it, without sensor noise."""

    description: dict[str, Any]
    """Contents of ``capture.json``."""
    optics: dict[str, Any]
    """Contents of ``truth.json``."""
    fdi: str
    meshes: dict[str, Mesh]
    """Surfaces: ``outer`` and, where the tooth has dentin, ``dentin``."""
    mean: dict[str, NDArray[np.float64]]
    """Images (L, H, W) by camera."""
    standard_error: dict[str, NDArray[np.float64]]

    def medium(self, part: str) -> dict[str, float]:
        """Optics of ``enamel`` or ``dentin`` in the green channel, including the reduced quantities."""
        values: dict[str, float] = self.optics["channels"]["green"][part]
        return values


def names() -> tuple[str, ...]:
    """Names of the stored truths."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.npz")))


def pack(capture: Path, stored: Path) -> None:
    """Store a folder capture of one tooth and one channel."""
    description = json.loads((capture / "capture.json").read_text())
    optics = json.loads((capture / "truth.json").read_text())
    (tooth,) = (capture / "teeth").iterdir()
    arrays: dict[str, NDArray[Any]] = {}
    for path in tooth.glob("*.ply"):
        mesh = read_mesh(path)
        arrays[f"{path.stem}_vertices"], arrays[f"{path.stem}_faces"] = (
            mesh.vertices_mm.astype(np.float32),
            mesh.faces.astype(np.uint16),
        )
    for camera in description["cameras"]:
        images = [image for image in description["images"] if image["camera"] == camera["name"]]
        mean, variance = (
            np.stack([np.load(capture / image[key])[..., 0] for image in images]) for key in ("file", "variance_file")
        )
        arrays[f"{camera['name']}_mean"] = mean.astype(np.float32)
        arrays[f"{camera['name']}_standard_error"] = np.sqrt(variance).astype(np.float16)
    text = json.dumps({"capture": description, "truth": optics, "fdi": tooth.name})
    np.savez_compressed(stored, allow_pickle=False, text=np.array(text), **arrays)


def read(name: str, folder: Path = FOLDER) -> Truth:
    """Read a stored truth."""
    with np.load(folder / f"{name}.npz") as stored:
        text = json.loads(str(stored["text"]))
        parts = [key.removesuffix("_faces") for key in stored if key.endswith("_faces")]
        meshes = {
            part: Mesh(stored[f"{part}_vertices"].astype(float), stored[f"{part}_faces"].astype(np.int32))
            for part in parts
        }
        cameras = [camera["name"] for camera in text["capture"]["cameras"]]
        images = [
            {camera: stored[f"{camera}_{kind}"].astype(float) for camera in cameras}
            for kind in ("mean", "standard_error")
        ]
    return Truth(text["capture"], text["truth"], text["fdi"], meshes, images[0], images[1])


def write_capture(
    name: str, target: Path, seed: int, *, tested_camera: str | None = None, dentin: bool = True
) -> Truth:
    """Write a truth as a folder capture with sensor noise.

    Args:
        tested_camera: mark its images as held out, and no others.
        dentin: whether to write the surface of dentin, where the tooth has one.
    """
    truth, random = read(name), np.random.default_rng(seed)
    description = truth.description
    images = description["images"]
    if tested_camera is not None:
        images = [image | {"held_out": image["camera"] == tested_camera} for image in images]
    lights = [light["name"] for light in description["lights"]]
    target.mkdir(parents=True)
    for image in images:
        light = lights.index(image["light"])
        mean, variance = truth.mean[image["camera"]][light], truth.standard_error[image["camera"]][light] ** 2
        noisy, spread = photograph(mean, variance, random)
        np.save(target / image["file"], noisy[..., None])
        np.save(target / image["variance_file"], spread[..., None])
    (target / "capture.json").write_text(json.dumps(description | {"images": images}))
    folder = teeth_folder(target, int(truth.fdi))
    for part, mesh in truth.meshes.items():
        if part == "outer" or dentin:
            folder.mkdir(parents=True, exist_ok=True)
            write_mesh(folder / f"{part}.ply", mesh)
    return truth
