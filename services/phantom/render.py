"""Images of a scene under each of its lights, by the project's engine or by stock Mitsuba, for phantoms."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Camera, Light
from services.transport.optics.parameters import Mouth, Tissue
from services.transport.scene.recipe import View

if TYPE_CHECKING:
    from services.assets.mitsuba.scene import SceneDict
    from services.transport.engine import Engine

Stack = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Radiance (L, H, W) and the variance (L, H, W) of its estimate."""


def render_engine(
    engine: Engine, tissue: Tissue | Mouth, camera: Camera, seen: NDArray[np.bool_], samples: int, seed: int
) -> Stack:
    """Render by the project's engine, all lights with the same paths; pixels that are not ``seen`` (H, W) stay dark."""
    pixels = np.argwhere(seen)[:, ::-1].astype(np.int32)
    estimate = engine.images(tissue, View(camera, pixels), samples=samples, seed=seed)
    images = np.zeros((2, len(engine.recipe.light_positions_mm), *seen.shape))
    # Clip at zero: estimates of very little light may be negative, the values of a photograph cannot.
    images[:, :, pixels[:, 1], pixels[:, 0]] = np.maximum(estimate.mean, 0.0), estimate.variance
    return images[0], images[1]


def render_mitsuba(
    scene: SceneDict, lights: tuple[Light, ...], channel: int, samples: int, seed: int, dark: SceneDict | None = None
) -> Stack:
    """Render a scene with one camera by stock Mitsuba; its point light ``light`` becomes each light in turn.

    Args:
        dark: the same scene with media that give no light back, whose image is subtracted: what is left was inside.
    """
    import mitsuba as mi

    from services.assets.mitsuba.scene import load_scene, render_batches

    def stacked(scene: SceneDict) -> Stack:
        loaded = load_scene(scene)
        params = mi.traverse(loaded)
        images = []
        for n, light in enumerate(lights):
            params["light.position"] = mi.Point3f(*light.position_mm)
            params["light.intensity.value"] = mi.Float(light.intensity[channel])
            params.update()
            images.append(render_batches(loaded, 0, samples, seed + n))
        return np.stack([image[0] for image in images]), np.stack([image[1] for image in images])

    mean, variance = stacked(scene)
    if dark is None:
        return mean, variance
    reflected, noise = stacked(dark)
    # Clip at zero, as in ``render_engine``.
    return np.maximum(mean - reflected, 0.0), variance + noise
