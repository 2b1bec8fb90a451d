"""Which light a photograph of a white sphere shows, by the shading on the sphere alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from services.calibrate.lights.intensity import MIN_PIXELS, WhitePhoto, WhiteSphere, shading
from services.calibrate.lights.mirror import PosedCamera

Floats = NDArray[np.float64]
MAX_MISFIT = 0.05
"""Largest relative rms misfit of the shading by the stated light at which no other light is tried: noise and a sphere
that is not quite diffuse leave a few per cent."""
FAR_BETTER = 3.0
"""Factor by which another light's misfit must be smaller. In simulated sessions the right light leaves 0.5 %, and one
11° beside it 9 to 12 %."""


def seem_lit_by_others(
    photos: Sequence[WhitePhoto], cameras: Sequence[PosedCamera], spheres: Sequence[WhiteSphere], lights_mm: Floats
) -> dict[int, int]:
    """Return the light whose position explains the shading far better than that of the stated light, by the number of
    the photograph.

    Args:
        photos: photographs of white spheres, each under one light.
        cameras: calibrated cameras.
        spheres: white spheres by place.
        lights_mm: positions of the lights (L, 3), NaN where unknown.
    """
    found = {}
    known = [number for number, where in enumerate(lights_mm) if np.isfinite(where).all()]
    for number, photo in enumerate(photos):
        camera, sphere = cameras[photo.camera], spheres[photo.place]
        own, count = _misfit(photo, camera, sphere, lights_mm[photo.light])
        if count < MIN_PIXELS or own <= MAX_MISFIT:
            continue
        tried = {light: _misfit(photo, camera, sphere, lights_mm[light]) for light in known if light != photo.light}
        others = {light: misfit for light, (misfit, lit) in tried.items() if 4 * lit > count}
        best = min(others, key=lambda light: others[light], default=photo.light)
        if best != photo.light and others[best] <= MAX_MISFIT and FAR_BETTER * others[best] < own:
            found[number] = best
    return found


def _misfit(photo: WhitePhoto, camera: PosedCamera, sphere: WhiteSphere, light_mm: Floats) -> tuple[float, int]:
    """Return the relative rms difference of a photograph from the shading by a light over the pixels that the light
    reaches, infinite where these are few or dark, and their number.
    """
    factor, usable = shading(camera, sphere, light_mm, photo.pixels)
    count = int(np.count_nonzero(usable))
    if count < MIN_PIXELS:
        return float("inf"), count
    values, drawn = photo.values[usable].mean(axis=1), factor[usable]
    if values.mean() <= 0:
        return float("inf"), count
    drawn = drawn * (values.sum() / drawn.sum())
    return float(np.sqrt(((values - drawn) ** 2).mean()) / values.mean()), count
