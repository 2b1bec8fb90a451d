"""A small prepared stage whose photographs follow the fake engine's formula."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from services.anatomy.dentin_shape import DentinShape
from services.core.calibration.uncertainty import TWIST, CalibrationUncertainty
from services.core.files.meshes import write_mesh
from services.core.geometry import Camera, Light, Mesh
from services.core.records import MaskBit
from services.core.results import FitReport, PreparedManifest
from services.core.store import StageWriter, create_array
from services.transport.optics.parameters import Medium, Tissue
from services.transport.scene.recipe import View, single_tooth
from tests.support.fake_engine import FakeEngine

FAKE = "tests.support.fake_engine:FakeEngine"
TRUTH = Tissue(Medium(4.0, 0.996, g1=0.75), Medium(12.0, 0.992, g1=0.8))
SIZE = (20, 24)


def sphere(radius_mm: float) -> Mesh:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=radius_mm)
    return Mesh(np.asarray(ball.vertices, dtype=np.float64), np.asarray(ball.faces, dtype=np.int32))


def lights(count: int = 6) -> tuple[Light, ...]:
    return tuple(
        Light(name=f"l{k}", position_mm=(140.0 * k - 300.0, 300.0, -700.0), intensity=(1e6,)) for k in range(count)
    )


def camera(name: str) -> Camera:
    pose = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 500.0), (0.0, 0.0, 0.0, 1.0))
    k = ((1000.0, 0.0, SIZE[0] / 2), (0.0, 1000.0, SIZE[1] / 2), (0.0, 0.0, 1.0))
    return Camera(name=name, size=SIZE, K=k, camera_from_world=pose)


def without_time(report: FitReport) -> dict[str, Any]:
    """What two fits of equal answers have in common: all but how long they took."""
    return report.model_dump(exclude={"seconds", "seconds_by_purpose"})


def write_prepared(
    root: Path,
    *,
    truth: Tissue = TRUTH,
    channels: tuple[str, ...] = ("green",),
    light_count: int = 6,
    noise: float = 0.01,
    held_out: tuple[tuple[str, str], ...] = (("c0", "l4"), ("c1", "l4")),
    masked: bool = False,
    dark: bool = False,
    uneven: float = 0.0,
    shadowed: float = 0.0,
    stain_uv: NDArray[np.float64] | None = None,
    seed: int = 5,
    engine: type[FakeEngine] = FakeEngine,
    notes: tuple[str, ...] = (),
    scan_se: tuple[float, float] | None = None,
    motion_error_px: float | None = None,
) -> PreparedManifest:
    """Publish ``prepared`` with two cameras of 20 x 24 pixels.

    Args:
        truth: parameters of the photographs.
        noise: standard deviation of the sensor's noise, relative to the value.
        held_out: held-out photographs as (camera, light).
        masked: mask every pixel as a highlight.
        dark: make every photograph black, apart from noise.
        uneven: relative excess brightness of every second light's photographs, which no medium explains.
        shadowed: share of every photograph's pixels that lose nine tenths of their light, which no medium explains
            either.
        stain_uv: texture coordinates of the outer surface, for a truth with stains.
        engine: fake engine whose formula the photographs follow.
        motion_error_px: error of every photograph's motion; None where the preparation says nothing of it.
        scan_se: stated standard errors of the scan's pose, rad and mm; None where nothing is stated.
    """
    writer = StageWriter(root, "prepared", 1)
    cameras, all_lights, rng = (camera("c0"), camera("c1")), lights(light_count), np.random.default_rng(seed)
    width, height = SIZE
    shape = (len(cameras), light_count, height, width)
    axes = ("camera", "light", "y", "x")
    store = writer.folder / "prepared.zarr"
    radiance, variance = (
        create_array(
            store, name, (*shape, len(channels)), (1, 1, height, width, len(channels)), "float32", (*axes, "channel")
        )
        for name in ("radiance", "variance")
    )
    valid = create_array(store, "valid", shape, (1, 1, height, width), "uint16", axes)
    y, x = (index.reshape(-1) for index in np.mgrid[:height, :width])
    dentin = DentinShape(sphere(3.0), np.zeros((len(truth.shape), 1, 3)))
    recipe = single_tooth(
        sphere(4.0), dentin, np.array([light.position_mm for light in all_lights]), np.full(light_count, 1e6)
    )
    recipe = replace(recipe, teeth=(replace(recipe.teeth[0], stain_uv=stain_uv),))
    for c, one in enumerate(cameras):
        image = (
            engine(recipe)
            ._formula(truth, View(one, np.stack([x, y], -1).astype(np.int32)))
            .reshape(light_count, height, width, 1)
        )
        image = np.repeat(np.zeros_like(image) if dark else image, len(channels), axis=-1)
        image[::2] *= 1 + uneven
        image = np.where(rng.uniform(size=(*image.shape[:-1], 1)) < shadowed, 0.1 * image, image) if shadowed else image
        spread = np.maximum(noise * image, 1e-4)
        radiance[c] = (image + spread * rng.standard_normal(image.shape)).astype(np.float32)
        variance[c] = (spread**2).astype(np.float32)
        bits = np.zeros((light_count, height, width), dtype=np.uint16)
        bits[:, :2] = MaskBit.OUTSIDE
        valid[c] = np.full_like(bits, MaskBit.HIGHLIGHT) if masked else bits
    for part, radius in (("outer", 4.0), ("dentin", 3.0)):
        write_mesh(writer.folder / "teeth" / "11" / f"{part}.ply", sphere(radius))
    manifest = PreparedManifest(
        channels=channels, cameras=cameras, lights=all_lights, held_out=held_out, fdi=(11,), dentin_known=(11,),
        median_motion_px=None, notes=notes, valid_fraction=0.9,
        uncertainty=None if scan_se is None else _of_the_scan(*scan_se),
    )  # fmt: skip
    if motion_error_px is not None:
        every = [
            {"camera": c.name, "light": k.name, "motion_error_px": motion_error_px} for c in cameras for k in all_lights
        ]
        (writer.folder / "quality.json").write_text(json.dumps({"images": every}))
    writer.publish(manifest)
    return manifest


def _of_the_scan(turn_rad: float, shift_mm: float) -> CalibrationUncertainty:
    rows = np.diag([turn_rad**2] * 3 + [shift_mm**2] * 3).tolist()
    return CalibrationUncertainty(names=tuple(f"teeth.{axis}" for axis in TWIST), covariance=tuple(map(tuple, rows)))
