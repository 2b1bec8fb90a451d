"""A small jaw as a prepared stage: a row of round teeth whose roots are in gums, with a wall behind. Photographs come
from the engine or from a fake engine's formula.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from services.anatomy.dentin_shape import DentinShape
from services.core.files.meshes import write_mesh
from services.core.geometry import Camera, Light, Mesh
from services.core.records import JobSpec, MaskBit
from services.core.results import PreparedManifest
from services.core.store import StageWriter, create_array
from services.transport.optics.parameters import Medium, Mouth, Tissue
from services.transport.rays import RayScene, pixel_rays
from services.transport.scene.recipe import SceneRecipe, ToothSurfaces, View
from tests.support.small_mouth import revolved
from tests.support.small_tooth import camera_at

FDI = (11, 12, 21, 22)
"""FDI numbers in the order of a manifest, which is not that of the arch."""
PLACES_MM = {12: -9.3, 11: -3.1, 21: 3.1, 22: 9.3}
TRUE_TEETH: Mapping[int, Tissue] = {
    11: Tissue(Medium(4.0, 0.995, g1=0.8), Medium(12.0, 0.985, g1=0.8)),
    12: Tissue(Medium(5.5, 0.990, g1=0.8), Medium(15.0, 0.975, g1=0.8)),
    21: Tissue(Medium(3.2, 0.993, g1=0.8), Medium(10.0, 0.990, g1=0.8)),
    22: Tissue(Medium(4.5, 0.992, g1=0.8), Medium(13.0, 0.980, g1=0.8)),
}
TRUE_GUMS, TRUE_REFLECTANCE = Medium(7.0, 0.96, g1=0.8), 0.35
LIGHTS_MM = (
    (0.0, 500.0, 300.0),
    (-450.0, 300.0, 100.0),
    (400.0, 350.0, -50.0),
    (150.0, 480.0, 250.0),
    (-250.0, 450.0, -100.0),
)
HELD_OUT_LIGHT = 3
SIZE, SPAN_MM = 30, 30.0
"""Image size in pixels and field of view in mm, so that pixels are 1 mm wide."""


def cameras() -> tuple[Camera, ...]:
    """Cameras in front of the patient and on the patient's left."""
    views = (camera_at((0.0, 1.0, 0.25), SIZE, SPAN_MM), camera_at((0.6, 1.0, 0.1), SIZE, SPAN_MM))
    return tuple(camera.model_copy(update={"name": f"c{k}"}) for k, camera in enumerate(views))


def recipe(fdi: tuple[int, ...] = FDI, *, dentin: bool = True) -> SceneRecipe:
    """The jaw's scene, with the teeth in the order given."""

    def tooth(number: int) -> ToothSurfaces:
        centre = (PLACES_MM[number], 0.0, 0.0)
        core = revolved((2.3, 3.4), centre)
        known = DentinShape.known(core)
        return ToothSurfaces(revolved((3.0, 4.0), centre), known if dentin else None)

    box = trimesh.creation.box((28.0, 9.0, 5.0)).subdivide_to_size(4.0)
    gums = Mesh(np.asarray(box.vertices) + np.array([0, 0, -5.0]), np.asarray(box.faces, dtype=np.int32))
    corners = np.array([[-14.0, -5.0, -5], [14, -5.0, -5], [14, -5.0, 5], [-14, -5.0, 5]])
    wall = Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32))
    lights = np.array(LIGHTS_MM)
    return SceneRecipe(tuple(map(tooth, fdi)), lights, np.full(len(lights), 1e6), "matched", gums=gums, cavity=wall)


def true_mouth(fdi: tuple[int, ...]) -> Mouth:
    """The optics of the photographs, with the teeth in the order given."""
    return Mouth(tuple(TRUE_TEETH[number] for number in fdi), TRUE_GUMS, TRUE_REFLECTANCE)


def seen(camera: Camera, scene: SceneRecipe) -> NDArray[np.int64]:
    """Labels (H, W) of the surface at each pixel's centre: the tooth's index, then gums, then wall; -1 for none."""
    assert scene.gums is not None
    walls = () if scene.cavity is None else (scene.cavity,)
    rays = RayScene(*(tooth.outer for tooth in scene.teeth), scene.gums, *walls)
    return rays.first_hits(*pixel_rays(camera)).mesh.reshape(SIZE, SIZE)


def write_prepared_jaw(
    root: Path,
    engine: str,
    fdi: tuple[int, ...] = FDI,
    *,
    dentin: bool = True,
    shape: tuple[float, ...] = (),
    hidden: tuple[int, ...] = (),
    dark: tuple[int, ...] = (),
    only: int | None = None,
    samples: int = 1024,
    noise: float = 0.01,
    seed: int = 7,
) -> None:
    """Publish ``prepared`` with two cameras and five lights, one of them held out.

    Args:
        engine: engine that makes the photographs, as ``module:class``.
        dentin: whether teeth have dentin.
        shape: blend weights of every tooth, for an engine whose formula uses them.
        hidden: FDI numbers of teeth that are masked in all images.
        dark: FDI numbers of teeth that are black in all photographs.
        only: FDI number of the only tooth to fit; there is then no wall, and the rest are its surroundings.
        noise: relative standard deviation of the sensor's noise.
    """
    scene, rng = recipe(fdi, dentin=dentin), np.random.default_rng(seed)
    mouth = true_mouth(fdi)
    if only is not None:
        scene, mouth = replace(scene, cavity=None), replace(mouth, reflectance=None)
    truth = replace(mouth, teeth=tuple(replace(tooth, shape=shape) for tooth in mouth.teeth))
    writer = StageWriter(root, "prepared", 1)
    shape = (2, len(LIGHTS_MM), SIZE, SIZE)
    store, axes = writer.folder / "prepared.zarr", ("camera", "light", "y", "x")
    radiance, variance = (
        create_array(store, name, (*shape, 1), (1, 1, SIZE, SIZE, 1), "float32", (*axes, "channel"))
        for name in ("radiance", "variance")
    )
    valid = create_array(store, "valid", shape, (1, 1, SIZE, SIZE), "uint16", axes)
    module, name = engine.split(":")
    renderer = getattr(importlib.import_module(module), name)(scene)
    for c, camera in enumerate(cameras()):
        shown = seen(camera, scene)
        black, masked = (np.isin(shown, [fdi.index(number) for number in numbers]) for numbers in (dark, hidden))
        masked |= only is not None and shown != fdi.index(only)
        pixels = np.argwhere(shown >= 0)[:, ::-1].astype(np.int32)
        estimate = renderer.images(truth, View(camera, pixels), samples=samples, seed=seed + c)
        images = np.zeros(shape[1:])
        images[:, pixels[:, 1], pixels[:, 0]] = estimate.mean
        spread = np.maximum(noise * images, 1e-3 * images.max())
        monte_carlo = np.zeros_like(images)
        monte_carlo[:, pixels[:, 1], pixels[:, 0]] = estimate.variance
        photographs = np.where(black, 0.0, images + spread * rng.standard_normal(images.shape))
        radiance[c] = photographs[..., None].astype(np.float32)
        variance[c] = (spread**2 + monte_carlo)[..., None].astype(np.float32)
        valid[c] = np.broadcast_to(np.where((shown < 0) | masked, MaskBit.OUTSIDE, 0).astype(np.uint16), shape[1:])
    for number, tooth in zip(fdi, scene.teeth, strict=True):
        write_mesh(writer.folder / "teeth" / str(number) / "outer.ply", tooth.outer)
        if tooth.dentin is not None:
            write_mesh(writer.folder / "teeth" / str(number) / "dentin.ply", tooth.dentin.base)
    for part, mesh in (("gums", scene.gums), ("cavity", scene.cavity)):
        if mesh is not None:
            write_mesh(writer.folder / f"{part}.ply", mesh)
    lights = tuple(Light(name=f"l{k}", position_mm=place, intensity=(1e6,)) for k, place in enumerate(LIGHTS_MM))
    manifest = PreparedManifest(
        channels=("green",), cameras=cameras(), lights=lights,
        held_out=tuple((f"c{c}", f"l{HELD_OUT_LIGHT}") for c in range(2)), fdi=fdi if only is None else (only,),
        dentin_known=fdi if dentin else (), median_motion_px=None, valid_fraction=0.9, surroundings=only is not None,
    )  # fmt: skip
    writer.publish(manifest)


def jaw_spec(root: Path, **options: Any) -> JobSpec:
    """The job of a short fit of the jaw."""
    defaults: dict[str, Any] = {
        "kind": "jaw", "boundary": "matched", "dentin": "known", "samples_per_pixel": 32, "max_samples_per_pixel": 256,
        "max_steps": 8, "search_candidates": 2000,
    }  # fmt: skip
    return JobSpec(capture=root, **(defaults | options))
