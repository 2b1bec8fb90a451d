"""Images of a rough dielectric ball by stock Mitsuba, stored because they take minutes;
``python -m tests.support.rough_truths`` renders them anew.

Each image is ``prbvolpath``'s, less the image of the same ball filled with black ink: what is left has come out of the
ball, as an engine without highlights shows it.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.assets.mitsuba.scene import lit_scene, load_scene, medium_dict, render_batches, sensor_dict, surface_dict
from services.core.files.meshes import write_mesh
from services.core.geometry import Mesh
from services.transport.boundary.rough import Rough
from services.transport.optics.parameters import Medium, Tissue
from services.transport.platform import prepare_device
from services.transport.scene.recipe import SceneRecipe, View, single_tooth
from tests.support.pictures import BATCHES
from tests.support.small_tooth import INTENSITY, LIGHTS_MM, camera_at, sphere, whole_view

STORED = Path(__file__).parents[1] / "data" / "rough_truths.npz"
MILK = Medium(2.0, 0.995, g1=0.3)
INK = Medium(1e4, 1e-6)
TISSUE = Tissue(MILK, MILK)
CASES = ((0.15, 1.63), (0.3, 1.33))
"""Roughness and index of refraction. Smoother balls have images with rare bright paths."""
LIGHTS = LIGHTS_MM[[1, 3]]
SAMPLES = 2048


def ball() -> Mesh:
    """The ball, of 1,280 flat faces, as both renderers see it."""
    return sphere(2.0)


def scene_recipe(roughness: float, ior: float) -> SceneRecipe:
    """The scene as the engine takes it, without compensation, which stock Mitsuba lacks."""
    plain = single_tooth(ball(), None, LIGHTS, np.full(len(LIGHTS), INTENSITY), "rough", ior)
    return replace(plain, roughness=roughness, multiple_scattering=False)


def view() -> View:
    """The view of both renderers, 8 x 8 pixels across the ball."""
    return whole_view(camera_at((0.2, 1, 0.1), size=8, span_mm=4.4))


def images(roughness: float, ior: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and variance of the mean, (lights, H, W) each, of the light that has come out of the ball."""
    prepare_device()
    found = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "ball.ply"
        write_mesh(path, ball())
        surface = surface_dict(path, Rough.mitsuba(ior, roughness=roughness))
        for number, light in enumerate(LIGHTS):
            parts: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []
            for medium in (MILK, INK):
                scene = lit_scene(light, INTENSITY) | {
                    "medium": medium_dict(medium),
                    "ball": surface | {"interior": {"type": "ref", "id": "medium"}},
                    "camera": sensor_dict(view().camera, 64),
                }
                parts.append(render_batches(load_scene(scene), 0, SAMPLES, 31 + 2 * number + len(parts), BATCHES))
            (whole, noise), (highlight, highlight_noise) = parts
            found.append((whole - highlight, noise + highlight_noise))
    mean, variance = (np.stack(arrays) for arrays in zip(*found, strict=True))
    return mean, variance


if __name__ == "__main__":
    arrays: dict[str, Any] = {}
    for case in CASES:
        mean, variance = images(*case)
        arrays |= {f"mean/{case[0]}": mean.astype(np.float32), f"variance/{case[0]}": variance.astype(np.float32)}
        sys.stderr.write(f"{case}: {np.sqrt(variance.sum()) / mean.sum():.2%}\n")
    np.savez(STORED, **arrays)
