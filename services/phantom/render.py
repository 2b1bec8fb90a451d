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

NEIGHBOURHOOD = 5
"""Edge in pixels of the square of pixels that a variance is taken from."""
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
    return np.maximum(mean - reflected, 0.0), variance_of_neighbours(variance + noise)


def variance_of_neighbours(variance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Variance (..., H, W) of each pixel as the mean of its neighbours', without its own.

    Where few paths bring most of the light, as behind a rough surface, an estimate that came out dark has a variance
    that came out small. Weighed by it, images of 18 % noise are 6 to 14 % too dark; weighed by its neighbours' they are
    within 1.4 % (three images of a sphere against others of 5 % noise; 2 % is their standard error).
    """
    from scipy.ndimage import convolve

    around = np.ones((1,) * (variance.ndim - 2) + (NEIGHBOURHOOD,) * 2)
    around[..., NEIGHBOURHOOD // 2, NEIGHBOURHOOD // 2] = 0
    known = (variance > 0).astype(np.float64)
    count = convolve(known, around, mode="constant")
    total = convolve(variance, around, mode="constant")
    return np.where((variance > 0) & (count > 0), total / np.maximum(count, 1), variance)
