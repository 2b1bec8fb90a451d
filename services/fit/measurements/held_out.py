"""Images that are held out of a fit to test it, and lights that the job leaves out altogether."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from services.core.errors import CaptureInputError, SettingsError
from services.core.records import JobSpec
from services.core.results import PreparedManifest


def held_out_images(manifest: PreparedManifest, spec: JobSpec) -> NDArray[np.bool_]:
    """Mask (camera, light) of the held-out images: the job's choice, else the capture's, else every fourth light, at
    least one. An object may be fitted to images under one light alone; then none of them is held out by default.

    Raises:
        SettingsError: a light or camera is unknown, or no image is left to fit.
        CaptureInputError: fewer than two lights.
    """
    cameras, lights = [c.name for c in manifest.cameras], [light.name for light in manifest.lights]
    if len(lights) < 2 and spec.kind != "object":
        raise CaptureInputError(
            f"The capture has {len(lights)} light; a fit needs at least two, one of them to test with, so capture more"
            " lights."
        )
    chosen = np.zeros((len(cameras), len(lights)), dtype=bool)
    if spec.held_out_lights is not None:
        chosen |= _named("held_out_lights", spec.held_out_lights, lights)
    elif spec.held_out_cameras:
        pass
    elif manifest.held_out:
        for camera, light in manifest.held_out:
            chosen[cameras.index(camera), lights.index(light)] = True
    elif len(lights) > 1:
        chosen[:, 3::4] = True
        chosen[:, -1] |= not chosen.any()
    chosen |= _named("held_out_cameras", spec.held_out_cameras, cameras)[:, None]
    if chosen.all():
        raise SettingsError(
            "Every image is held out and none is left to fit; name fewer in held_out_lights or held_out_cameras."
        )
    return chosen


def left_out_lights(manifest: PreparedManifest, spec: JobSpec) -> NDArray[np.bool_]:
    """Mask (L,) of the lights whose images are neither fitted nor used as a test.

    Raises:
        SettingsError: a light is unknown, or no light is left to fit.
    """
    chosen = _named("left_out_lights", spec.left_out_lights, [light.name for light in manifest.lights])
    if (chosen | held_out_images(manifest, spec).all(axis=0)).all():
        raise SettingsError("No light is left to fit; name fewer in left_out_lights.")
    return chosen


def _named(option: str, chosen: Sequence[str], names: Sequence[str]) -> NDArray[np.bool_]:
    for name in chosen:
        if name not in names:
            raise SettingsError(
                f"Option {option} names '{name}', which the capture does not have; it has {', '.join(names)}."
            )
    return np.isin(names, chosen)
