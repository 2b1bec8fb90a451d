"""Images of rough dielectric surfaces by stock Mitsuba, stored because they take minutes;
``python -m tests.support.rough_truths`` renders them anew: three balls, a mouth, and the micro-CT incisor where it is
shared.

Each image is ``prbvolpath``'s, less the image of the same surface around black ink: what is left has come out of the
object, as an engine without highlights shows it. In the mouth it is what the media add to the light of the wall, also
by reflection in other faces.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.anatomy.dentin_shape import DentinShape
from services.assets.mitsuba.scene import load_scene, nested_scene, render_batches, surface_dict
from services.core.files.meshes import read_teeth, write_mesh
from services.core.geometry import Camera
from services.core.records import FolderCapture
from services.core.store import read_record
from services.transport.boundary.rough import Rough
from services.transport.optics.parameters import Medium, Mouth, Tissue
from services.transport.platform import prepare_device
from services.transport.scene.recipe import SceneRecipe, View, single_tooth
from tests.support.pictures import BATCHES
from tests.support.shared_data import shared_path
from tests.support.small_mouth import LIGHTS_MM as MOUTH_LIGHTS_MM
from tests.support.small_mouth import MOUTH, mouth_recipe, stock_mouth
from tests.support.small_tooth import INTENSITY, LIGHTS_MM, camera_at, sphere, whole_view

STORED = Path(__file__).parents[1] / "data" / "rough_truths.npz"
TISSUE = Tissue(Medium(2.0, 0.995, g1=0.3), Medium(2.0, 0.995, g1=0.3))
INCISOR_TISSUE = Tissue(Medium(6.0, 0.99, g1=0.8), Medium(11.0, 0.98, g1=0.7))
INK = Tissue(Medium(1e4, 1e-6), Medium(1e4, 1e-6))
CASES = ((0.15, 1.63), (0.3, 1.33))
"""Roughness and index of refraction of the balls."""
NARROW_CASE = (0.05, 1.63)
"""The same of a ball whose images have rare bright paths in stock Mitsuba, so that they take many more."""
INCISOR_CASE = (0.3, 1.63)
MOUTH_ROUGHNESS = 0.3
MOUTH_INK = Mouth((INK, INK), INK.enamel, MOUTH.reflectance)
"""A mouth of black teeth and gums before the same wall."""
LIGHTS = LIGHTS_MM[[1, 3]]
SAMPLES = 4096
NARROW_SAMPLES = 65_536
INCISOR_SAMPLES = 49_152
MOUTH_SAMPLES = 65_536
COARSER = 4
"""Pixels of the incisor's view in one pixel here, along each edge: 0.5 mm become 2 mm."""


@dataclass(frozen=True)
class RoughTruth:
    """One scene of both renderers."""

    name: str
    recipe: SceneRecipe
    """The scene as the engine takes it, without compensation, which stock Mitsuba lacks."""
    tissue: Tissue
    view: View
    samples: int


def scene_recipe(roughness: float, ior: float) -> SceneRecipe:
    """A ball of 1,280 flat faces under two lights."""
    plain = single_tooth(sphere(2.0), None, LIGHTS, np.full(len(LIGHTS), INTENSITY), "rough", ior)
    return replace(plain, roughness=roughness, multiple_scattering=False)


def view() -> View:
    """The view of the balls, 8 x 8 pixels."""
    return whole_view(camera_at((0.2, 1, 0.1), size=8, span_mm=4.4))


def ball(roughness: float, ior: float) -> RoughTruth:
    """A ball of milk."""
    samples = NARROW_SAMPLES if (roughness, ior) == NARROW_CASE else SAMPLES
    return RoughTruth(f"ball-{roughness}", scene_recipe(roughness, ior), TISSUE, view(), samples)


def incisor() -> RoughTruth:
    """The incisor with its dentin under two lights; skips where it is not shared."""
    root = shared_path("data/tooth-ur1-truth")
    capture, tooth = read_record(root / "capture.json", FolderCapture), read_teeth(root)[0]
    assert tooth.dentin is not None
    lights, fine = (capture.lights[0], capture.lights[-1]), capture.cameras[0]
    matrix = np.array(fine.K)
    matrix[:2] /= COARSER
    rows: Any = tuple(map(tuple, matrix.tolist()))
    width, height = fine.size
    size = (width // COARSER, height // COARSER)
    camera = Camera(name="c0", size=size, K=rows, camera_from_world=fine.camera_from_world)
    positions, intensities = (
        np.array([light.position_mm for light in lights]),
        np.array([light.intensity[0] for light in lights]),
    )
    roughness, ior = INCISOR_CASE
    plain = single_tooth(tooth.outer, DentinShape.known(tooth.dentin), positions, intensities, "rough", ior)
    recipe = replace(plain, roughness=roughness, multiple_scattering=False)
    return RoughTruth("incisor", recipe, INCISOR_TISSUE, whole_view(camera), INCISOR_SAMPLES)


def rough_mouth() -> tuple[SceneRecipe, View]:
    """The small mouth with a rough surface, 16 x 16 pixels."""
    recipe = replace(mouth_recipe("rough"), roughness=MOUTH_ROUGHNESS, multiple_scattering=False)
    return recipe, whole_view(camera_at((0.3, 1, 0.25), size=16, span_mm=13))


def mouth_images() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and variance of the mean, (lights, H, W) each, of the mouth's light less that of black teeth and gums."""
    prepare_device()
    _, view = rough_mouth()
    found = []
    for number in range(len(MOUTH_LIGHTS_MM)):
        parts = []
        for mouth in (MOUTH, MOUTH_INK):
            with tempfile.TemporaryDirectory() as folder:
                scene = load_scene(
                    stock_mouth(
                        Path(folder), view.camera, number, "rough", MOUTH_SAMPLES, mouth=mouth,
                        roughness=MOUTH_ROUGHNESS,
                    )
                )  # fmt: skip
            parts.append(render_batches(scene, 0, MOUTH_SAMPLES, 51 + number, BATCHES))
        (whole, noise), (black, black_noise) = parts
        found.append((whole - black, noise + black_noise))
    mean, variance = (np.stack(arrays) for arrays in zip(*found, strict=True))
    return mean, variance


def images(truth: RoughTruth) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and variance of the mean, (lights, H, W) each, of the light that has come out."""
    prepare_device()
    found, recipe = [], truth.recipe
    (tooth,) = recipe.teeth
    with tempfile.TemporaryDirectory() as folder:
        outer, dentin = Path(folder) / "outer.ply", None
        write_mesh(outer, tooth.outer)
        if tooth.dentin is not None:
            dentin = Path(folder) / "dentin.ply"
            write_mesh(dentin, tooth.dentin.base)
        surface = surface_dict(outer, Rough.mitsuba(recipe.ior, roughness=recipe.roughness))
        for number, (light, intensity) in enumerate(
            zip(recipe.light_positions_mm, recipe.light_intensities, strict=True)
        ):
            parts: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []
            for tissue in (truth.tissue, INK):
                scene = nested_scene(
                    {"11": (outer, dentin)}, tissue, (truth.view.camera,), light.tolist(), float(intensity)
                )
                scene["outer_11"] = surface | {"interior": {"type": "ref", "id": "medium_enamel"}}
                parts.append(render_batches(load_scene(scene), 0, truth.samples, 31 + number, BATCHES))
            (whole, noise), (highlight, highlight_noise) = parts
            found.append((whole - highlight, noise + highlight_noise))
    mean, variance = (np.stack(arrays) for arrays in zip(*found, strict=True))
    return mean, variance


def main() -> None:
    """Render the scenes that are named, or all."""
    truths = {truth.name: truth for truth in (ball(*case) for case in (*CASES, NARROW_CASE))}
    stored = dict(np.load(STORED)) if STORED.is_file() else {}
    for name in sys.argv[1:] or [*truths, "mouth", "incisor"]:
        mean, variance = mouth_images() if name == "mouth" else images(truths[name] if name in truths else incisor())
        stored |= {f"mean/{name}": mean.astype(np.float32), f"variance/{name}": variance.astype(np.float32)}
        sys.stderr.write(f"{name}: {np.sqrt(variance.sum()) / mean.sum():.2%}\n")
        np.savez(STORED, **stored)


if __name__ == "__main__":
    main()
