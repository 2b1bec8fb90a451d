"""How bright teeth are against a white surface in their place: what is dark, and what units are wrong."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from services.core.errors import CaptureInputError
from services.core.geometry import Camera, Light, Record
from services.preprocess.projection import Footprint
from services.preprocess.source import LightImage, View

PLAUSIBLE = (1e-3, 10.0)
"""Radiance of teeth over that of a white diffuser. Real teeth give 0.1 to 1; a unit that is wrong by 1000 moves this by
1e6."""
ODD_LIGHT = 30.0
"""A light this much brighter or dimmer than the others, against what its calibration says, is told."""
NAMED = 3
"""Dark images that are named."""
COMPARED_PIXELS = 50_000
CERTAIN = 4.0
"""Standard errors above which an image's light counts as seen."""


class ImageLight(Record):
    """How much light one image shows: sums over its pixels, or over an even share of them."""

    measured: float = Field(description="radiance over all channels")
    white: float = Field(description="the same of a white diffuser in the teeth's place")
    cosine: float = Field(description="of the angle at which light falls in")
    dark: bool = Field(default=False, description="no tooth is above the noise; the sums are then zero")


def light_of(image: LightImage, view: View, light: Light, chosen: NDArray[np.bool_]) -> ImageLight | None:
    """What the chosen pixels (H, W) of an image show; None where there are none."""
    import cv2

    mask = chosen.astype(np.uint8)
    count = int(np.count_nonzero(chosen))
    if not count:
        return None
    measured, variance = (
        count * sum(cv2.mean(values[..., c], mask)[0] for c in range(values.shape[-1]))
        for values in (image.radiance, image.variance)
    )
    if measured <= CERTAIN * np.sqrt(variance):
        return ImageLight(measured=0.0, white=0.0, cosine=0.0, dark=True)
    # A plausibility needs no more than every n-th pixel in x and y
    step = max(1, int(np.sqrt(count / COMPARED_PIXELS)))
    cosine, distance_mm = _incidence(view.footprint, view.camera, light, chosen, step)
    if not len(cosine):
        return None
    share = len(cosine) / count
    white = float((cosine / distance_mm**2).sum()) / np.pi * sum(light.intensity)
    return ImageLight(measured=measured * share, white=white, cosine=float(cosine.sum()))


@dataclass
class _Sums:
    # Over one light's pixels: radiance measured, that of a white diffuser, and the cosine at which light falls on it.
    measured: float = 0.0
    white: float = 0.0
    cosine: float = 0.0

    @property
    def ratio(self) -> float:
        return self.measured / self.white


@dataclass
class Brightness:
    """Sums over the images of a capture."""

    dark: list[tuple[str, str]] = field(default_factory=list)
    """(camera, light) of images in which no tooth is above the noise."""
    _lights: dict[str, _Sums] = field(default_factory=lambda: defaultdict(_Sums))

    def add(self, camera: str, light: str, shown: ImageLight | None) -> None:
        """Count what an image shows."""
        if shown is None:
            return
        if shown.dark:
            self.dark.append((camera, light))
            return
        sums = self._lights[light]
        sums.measured += shown.measured
        sums.white += shown.white
        sums.cosine += shown.cosine

    def require_plausible(self) -> None:
        """Refuse a capture whose brightness no tooth has.

        Raises:
            CaptureInputError: says by how much.
        """
        measured, white = (
            sum(sums.measured for sums in self._lights.values()),
            sum(sums.white for sums in self._lights.values()),
        )
        if white > 0 and not PLAUSIBLE[0] <= measured / white <= PLAUSIBLE[1]:
            raise CaptureInputError(
                f"Teeth are {measured / white:.2g} times as bright as a white surface in their place would be, where"
                " real ones are 0.1 to 1 times; give positions in mm, intensities per steradian with mm as the length"
                " unit, and images in the same radiance unit."
            )

    def notes(self) -> tuple[str, ...]:
        """Sentences on dark images and on lights unlike the others."""
        notes = []
        if self.dark:
            which = ", ".join(f"camera {camera} under light {light}" for camera, light in self.dark[:NAMED])
            more = f" and {len(self.dark) - NAMED} more" if len(self.dark) > NAMED else ""
            notes.append(f"Dark and left out: {which}{more}; check that these lights were on, then capture them again.")
        # Only lights from the front: behind a tooth, what shines through has little to do with a white surface.
        front = 0.1 * max((sums.cosine for sums in self._lights.values()), default=0.0)
        ratios = {light: sums.ratio for light, sums in self._lights.items() if sums.cosine > front}
        typical = float(np.median(list(ratios.values()))) if ratios else 1.0
        for light, ratio in ratios.items():
            if not 1 / ODD_LIGHT <= ratio / typical <= ODD_LIGHT:
                notes.append(
                    f"Teeth under light {light} are {ratio / typical:.2g} times as bright as its position and intensity"
                    " let expect; check both."
                )
        return tuple(notes)


def _incidence(
    footprint: Footprint, camera: Camera, light: Light, chosen: NDArray[np.bool_], step: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    # Cosine (N,) at which a light falls on the chosen pixels' surface, 0 from behind, and its distance in mm; shadows
    # are not looked for.
    y, x = np.nonzero(chosen[::step, ::step])
    y, x = y * step, x * step
    towards = np.asarray(light.position_mm) - footprint.points_at(camera, y, x)
    distance_mm = np.linalg.norm(towards, axis=-1)
    return np.maximum((towards * footprint.normal[y, x]).sum(axis=-1) / distance_mm, 0), distance_mm
