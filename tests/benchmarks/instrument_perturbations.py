"""Photographs of an instrument with errors, made from a written capture: its images are scaled, or light is added to
them, or the stated positions of its lights, scan or dome are wrong.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.files.meshes import read_mesh, write_mesh
from services.core.geometry import Mesh
from services.fit.coordinates.instrument_errors import DEFAULT_MOVE_SE, DEFAULT_SE
from services.transport.scene.rigid_moves import rigid

Array = NDArray[np.float64]

LIGHT = "l0"
FAR_LIGHT = "l1"
EXCHANGED = ("l0", "l3")
"""Two fitted lights whose photographs are exchanged in every camera."""
SCAN_OFF_MM, FAR_SCAN_MM, DOME_OFF_MM, FAR_LIGHT_MM = 0.1, 1.0, 4.0, 30.0
"""Position errors: twice the assumed standard errors of scan and dome (``*_OFF_MM``), and errors far beyond any assumed
standard error (``FAR_*``)."""
LIGHTS_OFF_MM = 4.0
"""Distance of each stated light from its true position, in a random direction; of the dome, 2 mm are assumed."""
ERRORS = (
    "drawn", "gain", "light_gain", "light_gains", "flare", "lights", "dome", "scan", "far_gain", "far_flare",
    "far_light", "far_scan", "exchanged",
)  # fmt: skip
"""Names of the errors that a capture can be given."""


def perturb(folder: Path, error: str, seed: int) -> None:
    """Change a written capture into that of an instrument with an error: ``none`` or one of ``ERRORS``; the errors of
    ``drawn`` follow from the seed.
    """
    description = json.loads((folder / "capture.json").read_text())
    if error == "drawn":
        draw(folder, description, np.random.default_rng([29, seed]))
        return
    if error in ("lights", "dome", "far_light"):
        _move_lights(description["lights"], error)
        (folder / "capture.json").write_text(json.dumps(description))
        return
    if error in ("scan", "far_scan"):
        # Move the scan perpendicular to the first camera's line of sight; the other cameras see it obliquely.
        right = np.array(description["cameras"][0]["camera_from_world"])[0, :3]
        for path in (folder / "teeth").rglob("*.ply"):
            mesh = read_mesh(path)
            moved = mesh.vertices_mm + (FAR_SCAN_MM if error == "far_scan" else SCAN_OFF_MM) * right
            write_mesh(path, Mesh(moved, mesh.faces))
        return
    if error == "exchanged":
        first, second = EXCHANGED
        other = {first: second, second: first}
        for one in description["images"]:
            one["light"] = other.get(one["light"], one["light"])
        (folder / "capture.json").write_text(json.dumps(description))
        return
    images, brightest = photographs(folder, description)
    lights = [light["name"] for light in description["lights"]]
    each = dict(zip(lights, 0.02 * np.random.default_rng(11).standard_normal(len(lights)), strict=True))
    changed: dict[str, Callable[[dict[str, str], Array], Array]] = {
        "none": lambda _, image: image,
        "gain": lambda _, image: 1.02 * image,
        "far_gain": lambda _, image: 1.1 * image,
        "light_gain": lambda one, image: 1.02 * image if one["light"] == LIGHT else image,
        "light_gains": lambda one, image: (1 + each[one["light"]]) * image,
        "flare": lambda one, image: image + 0.006 * brightest[one["camera"]],
        "far_flare": lambda one, image: image + 0.02 * brightest[one["camera"]],
    }
    for one in description["images"]:
        np.save(folder / one["file"], changed[error](one, images[one["file"]]))


def photographs(folder: Path, description: dict[str, Any]) -> tuple[dict[str, Array], dict[str, float]]:
    """The capture's images by their file, and the value of each camera's brightest pixel by its name."""
    images = {one["file"]: np.load(folder / one["file"]) for one in description["images"]}
    brightest = {
        camera["name"]: max(
            float(images[one["file"]].max()) for one in description["images"] if one["camera"] == camera["name"]
        )
        for camera in description["cameras"]
    }
    return images, brightest


def draw(folder: Path, description: dict[str, Any], rng: np.random.Generator) -> None:
    """Change a written capture by errors of gain, lights, flare, scan and dome, drawn from their assumed covariance."""
    images, brightest = photographs(folder, description)
    gain = rng.normal(0, DEFAULT_SE["gain"])
    lights = {light["name"]: rng.normal(0, DEFAULT_SE["light_gain"]) for light in description["lights"]}
    flare = {name: rng.normal(0, DEFAULT_SE["flare"]) * brightest[name] for name in brightest}
    for one in description["images"]:
        photograph = (1 + gain + lights[one["light"]]) * images[one["file"]] + flare[one["camera"]]
        np.save(folder / one["file"], photograph)

    places_mm = np.array([light["position_mm"] for light in description["lights"]])
    move = rigid(rng.normal(0, DEFAULT_MOVE_SE["dome"]), places_mm.mean(axis=0))
    for light, place_mm in zip(description["lights"], places_mm, strict=True):
        light["position_mm"] = (move[:3, :3] @ place_mm + move[:3, 3]).tolist()
    (folder / "capture.json").write_text(json.dumps(description))

    scans = sorted((folder / "teeth").rglob("*.ply"))
    outer_mm = read_mesh(next(path for path in scans if path.stem == "outer")).vertices_mm
    move = rigid(rng.normal(0, DEFAULT_MOVE_SE["teeth"]), outer_mm.mean(axis=0))
    for path in scans:
        mesh = read_mesh(path)
        write_mesh(path, Mesh(mesh.vertices_mm @ move[:3, :3].T + move[:3, 3], mesh.faces))


def _move_lights(lights: list[dict[str, Any]], error: str) -> None:
    if error == "lights":
        ways = np.random.default_rng(7).standard_normal((len(lights), 3))
        ways *= LIGHTS_OFF_MM / np.linalg.norm(ways, axis=1, keepdims=True)
    else:
        # Move the dome to the side, or one light towards the tooth, where its brightness shows the error.
        towards = -np.array([light["position_mm"] for light in lights])
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        chosen = np.array([error == "dome" or light["name"] == FAR_LIGHT for light in lights])
        way = np.array([DOME_OFF_MM, 0.0, 0.0]) if error == "dome" else FAR_LIGHT_MM * towards
        ways = chosen[:, None] * way
    for light, way in zip(lights, ways, strict=True):
        light["position_mm"] = (np.array(light["position_mm"]) + way).tolist()
