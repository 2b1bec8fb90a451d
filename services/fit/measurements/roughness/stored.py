"""Photographs of a prepared capture, highlights included, at the resolution at which a roughness is measured."""

from __future__ import annotations

from collections.abc import Sequence
from typing import overload

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Camera
from services.core.records import JobSpec, MaskBit
from services.core.store import StoredArray
from services.fit.measurements.held_out import left_out_lights
from services.fit.measurements.levels import averaged, reduced_camera, whole_squares
from services.fit.measurements.observations import Observations
from services.fit.measurements.roughness.patches import Photograph

PIXEL_MM = 0.08
"""Least edge of a pixel on the subject; finer ones are averaged, because a highlight of roughness 0.02 on a surface of
4 mm radius is twice as wide."""
MARGIN_PX = 4
"""Pixels around the subject's outline that are read too."""
NOT_MEASURED = MaskBit.SATURATED | MaskBit.NOT_FINITE | MaskBit.UNLIT | MaskBit.MOTION | MaskBit.SHADOW | MaskBit.MANUAL
"""Bits of pixels that are left out; those of a highlight are what is looked for."""


class StoredPhotographs(Sequence[Photograph]):
    """The fitted photographs of a capture, those of one camera one after the other; each is read when it is asked for.

    Values are means over the job's channels, each divided by the light's intensity in it.
    """

    def __init__(self, observations: Observations, spec: JobSpec) -> None:
        manifest = observations.manifest
        unused = observations.held_out | left_out_lights(manifest, spec)
        self._numbers = [(int(camera), int(light)) for camera, light in np.argwhere(~unused)]
        self._lights, self._cameras = manifest.lights, manifest.cameras
        channels = spec.channels or manifest.channels
        self._channels = [manifest.channels.index(channel) for channel in channels]
        self._vertices_mm = np.concatenate([tooth.outer.vertices_mm for tooth in observations.teeth])
        self._centre_mm = self._vertices_mm.mean(axis=0)
        store = observations.folder / "prepared.zarr"
        self._radiance, self._variance, self._valid = (
            StoredArray(store / name) for name in ("radiance", "variance", "valid")
        )

    def __len__(self) -> int:
        return len(self._numbers)

    @overload
    def __getitem__(self, index: int) -> Photograph: ...
    @overload
    def __getitem__(self, index: slice) -> list[Photograph]: ...
    def __getitem__(self, index: int | slice) -> Photograph | list[Photograph]:
        """Read a photograph, or several."""
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        number, light_number = self._numbers[index]
        whole, light = self._cameras[number], self._lights[light_number]
        step = max(int(PIXEL_MM / whole.pixel_mm(self._centre_mm)), 1)
        rows, columns = _window(whole, self._vertices_mm)
        place = (number, light_number, rows, columns)
        values, noise = [], []
        for channel in self._channels:
            intensity = light.intensity[channel if len(light.intensity) > 1 else 0]
            values.append(averaged(np.asarray(self._radiance[(*place, channel)]), step) / intensity)
            noise.append(averaged(np.asarray(self._variance[(*place, channel)]), step) / (step * intensity) ** 2)
        bits = np.asarray(self._valid[place], dtype=np.uint16)
        inside = whole_squares(bits & np.uint16(MaskBit.OUTSIDE) == 0, step)
        radiance, variance = np.mean(values, axis=0), np.mean(noise, axis=0) / len(noise)
        is_finite = np.isfinite(radiance) & np.isfinite(variance) & (variance > 0)
        usable = inside & whole_squares(bits & np.uint16(NOT_MEASURED) == 0, step) & is_finite
        clipped = inside & ~whole_squares(bits & np.uint16(MaskBit.SATURATED) == 0, step)
        camera = reduced_camera(whole.cropped(rows, columns), step)
        return Photograph(camera, light, radiance, variance, usable, clipped)


def _window(camera: Camera, vertices_mm: NDArray[np.float64]) -> tuple[slice, slice]:
    """Rows and columns of a camera's image that show a surface."""
    image, _ = camera.project(vertices_mm)
    first = np.clip(np.floor(image.min(axis=0)) - MARGIN_PX, 0, np.array(camera.size) - 1).astype(int)
    last = np.clip(np.ceil(image.max(axis=0)) + MARGIN_PX, first + 1, camera.size).astype(int)
    return slice(int(first[1]), int(last[1])), slice(int(first[0]), int(last[0]))
