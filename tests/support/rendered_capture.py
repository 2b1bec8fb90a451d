"""A small tooth as a prepared stage: rendered once with many paths, then photographed any number of times, each time
with new sensor noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.anatomy.dentin_shape import DentinShape
from services.core.files.meshes import write_mesh
from services.core.geometry import Camera, Light
from services.core.records import MaskBit
from services.core.results import PreparedManifest
from services.core.store import StageWriter, create_array
from services.transport.engine import Engine
from services.transport.optics.parameters import Tissue
from services.transport.scene.recipe import SceneRecipe, single_tooth
from tests.support.small_tooth import INTENSITY, LIGHTS_MM, SEMI_AXES_MM, camera_at, ellipsoid, whole_view

Array = NDArray[np.float64]

ENAMEL_MM = 0.7
HELD_OUT_LIGHT_MM = (300.0, 450.0, 250.0)
NOISE_RELATIVE, NOISE_FLOOR = 0.01, 0.002
"""Standard deviation of the sensor's noise as shares of the value and of the image's maximum."""


@dataclass(frozen=True)
class RenderedTooth:
    """An ellipsoid of enamel around dentin with its images under six lights, the last of which is held out."""

    cameras: tuple[Camera, ...]
    recipe: SceneRecipe
    images: tuple[Array, ...]
    """Images (L, H, W) by camera."""
    variances: tuple[Array, ...]
    """Monte Carlo variances of ``images``."""

    def photograph(self, root: Path, seed: int) -> None:
        """Publish ``prepared`` in ``root`` with new sensor noise."""
        rng, writer = np.random.default_rng(seed), StageWriter(root, "prepared", 1)
        lights, (width, height) = len(self.recipe.light_positions_mm), self.cameras[0].size
        shape, axes = (len(self.cameras), lights, height, width), ("camera", "light", "y", "x")
        store = writer.folder / "prepared.zarr"
        radiance, variance = (
            create_array(store, name, (*shape, 1), (1, 1, height, width, 1), "float32", (*axes, "channel"))
            for name in ("radiance", "variance")
        )
        valid = create_array(store, "valid", shape, (1, 1, height, width), "uint16", axes)
        for c, (image, rendered) in enumerate(zip(self.images, self.variances, strict=True)):
            noise = (NOISE_RELATIVE * image) ** 2 + (NOISE_FLOOR * image.max(axis=(1, 2), keepdims=True)) ** 2
            radiance[c] = (image + np.sqrt(noise) * rng.standard_normal(image.shape)).astype(np.float32)[..., None]
            variance[c] = (noise + rendered).astype(np.float32)[..., None]
            outside = np.broadcast_to((image == 0).all(axis=0), image.shape)
            valid[c] = np.where(outside, MaskBit.OUTSIDE, 0).astype(np.uint16)
        (tooth,) = self.recipe.teeth
        write_mesh(writer.folder / "teeth" / "11" / "outer.ply", tooth.outer)
        assert tooth.dentin is not None
        write_mesh(writer.folder / "teeth" / "11" / "dentin.ply", tooth.dentin.base)
        writer.publish(
            PreparedManifest(
                channels=("green",),
                cameras=self.cameras,
                lights=tuple(
                    Light(name=f"l{k}", position_mm=(float(p[0]), float(p[1]), float(p[2])), intensity=(float(i),))
                    for k, (p, i) in enumerate(
                        zip(self.recipe.light_positions_mm, self.recipe.light_intensities, strict=True)
                    )
                ),
                held_out=tuple((camera.name, f"l{lights - 1}") for camera in self.cameras),
                fdi=(11,),
                dentin_known=(11,),
                median_motion_px=None,
                valid_fraction=1.0,
            )
        )


def rendered_tooth(tissue: Tissue, *, samples: int, seed: int, pixels: int = 10, views: int = 1) -> RenderedTooth:
    """Render a tissue with ``samples`` paths per pixel for one or two cameras of ``pixels`` x ``pixels``."""
    directions = ((0.2, 1.0, 0.1), (-1.0, 0.3, 0.2))[:views]
    cameras = tuple(camera_at(d, pixels).model_copy(update={"name": f"c{k}"}) for k, d in enumerate(directions))
    base = ellipsoid(SEMI_AXES_MM - ENAMEL_MM)
    dentin = DentinShape.known(base)
    lights = np.vstack([LIGHTS_MM, HELD_OUT_LIGHT_MM])
    recipe = single_tooth(ellipsoid(SEMI_AXES_MM), dentin, lights, np.full(len(lights), INTENSITY))
    engine = Engine(recipe)
    stacks = [engine.images(tissue, whole_view(camera), samples=samples, seed=seed) for camera in cameras]
    images, variances = (
        [getattr(s, part).reshape(-1, pixels, pixels) for s in stacks] for part in ("mean", "variance")
    )
    return RenderedTooth(cameras, recipe, tuple(images), tuple(variances))
