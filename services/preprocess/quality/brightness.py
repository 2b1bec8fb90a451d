"""Brightness of the teeth relative to a white surface in their place; finds dark images and wrong units."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from services.core.errors import CaptureInputError
from services.core.geometry import Camera, Light, Record
from services.preprocess.views.projection import Footprint
from services.preprocess.views.source import LightImage, View

PLAUSIBLE = (1e-3, 10.0)
"""Smallest and largest plausible ratio of the teeth's radiance to that of a white diffuser in their place. Real teeth
give 0.1 to 1; a length unit that is wrong by a factor of 1000 changes the ratio by 1e6."""
MAX_DEVIATION_FACTOR = 30.0
"""A light is reported if the teeth's brightness ratio under it differs by more than this factor from the median over
all lights."""
NAMES_SHOWN = 3
"""Largest number of dark images that a note lists by name."""
COMPARED_PIXELS = 50_000
"""Approximate number of an image's pixels at which the white diffuser is evaluated."""
MIN_SIGMAS = 4.0
"""Number of standard errors by which an image's summed radiance must exceed zero; otherwise the image is dark."""


class ImageLight(Record):
    """Light that one image shows, as sums over its chosen pixels or over a regular subset of them."""

    measured: float = Field(description="radiance over all channels")
    white: float = Field(description="the same of a white diffuser in the teeth's place")
    cosine: float = Field(description="of the angle at which light falls in")
    dark: bool = Field(default=False, description="no tooth is above the noise; the sums are then zero")


def measure_light(image: LightImage, view: View, light: Light, chosen: NDArray[np.bool_]) -> ImageLight | None:
    """Sum radiance and incident light over the chosen pixels (H, W) of an image; None if no pixel is chosen."""
    import cv2

    mask = chosen.astype(np.uint8)
    count = int(np.count_nonzero(chosen))
    if not count:
        return None
    measured, variance = (
        count * sum(cv2.mean(values[..., c], mask)[0] for c in range(values.shape[-1]))
        for values in (image.radiance, image.variance)
    )
    if measured <= MIN_SIGMAS * np.sqrt(variance):
        return ImageLight(measured=0.0, white=0.0, cosine=0.0, dark=True)
    # Take every n-th pixel in x and y, which is enough for a test of plausibility
    step = max(1, int(np.sqrt(count / COMPARED_PIXELS)))
    cosine, distance_mm = _incidence(view.footprint, view.camera, light, chosen, step)
    if not len(cosine):
        return None
    share = len(cosine) / count
    white = float((cosine / distance_mm**2).sum()) / np.pi * sum(light.intensity)
    return ImageLight(measured=measured * share, white=white, cosine=float(cosine.sum()))


@dataclass
class _Sums:
    # Sums over all pixels under one light: measured radiance, radiance of a white diffuser, and cosine of incidence.
    measured: float = 0.0
    white: float = 0.0
    cosine: float = 0.0

    @property
    def ratio(self) -> float:
        return self.measured / self.white


@dataclass
class Brightness:
    """Measured and expected light of a capture, summed by light over its images."""

    dark: list[tuple[str, str]] = field(default_factory=list)
    """(camera, light) of images in which no tooth is above the noise."""
    _lights: dict[str, _Sums] = field(default_factory=lambda: defaultdict(_Sums))

    def add(self, camera: str, light: str, image_light: ImageLight | None) -> None:
        """Add the sums of one image, or note that it is dark; None adds nothing."""
        if image_light is None:
            return
        if image_light.dark:
            self.dark.append((camera, light))
            return
        sums = self._lights[light]
        sums.measured += image_light.measured
        sums.white += image_light.white
        sums.cosine += image_light.cosine

    def require_plausible(self) -> None:
        """Refuse a capture whose teeth are implausibly bright or dark.

        Raises:
            CaptureInputError: the ratio to a white surface is outside ``PLAUSIBLE``; the message gives the ratio.
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
        """Sentences about dark images and about lights whose brightness ratio differs from the others'."""
        notes = []
        if self.dark:
            which = ", ".join(f"camera {camera} under light {light}" for camera, light in self.dark[:NAMES_SHOWN])
            more = f" and {len(self.dark) - NAMES_SHOWN} more" if len(self.dark) > NAMES_SHOWN else ""
            notes.append(f"Dark and left out: {which}{more}; check that these lights were on, then capture them again.")
        # Compare only lights from the front, because light that shines through a tooth from behind says little about
        # the brightness of a white surface.
        front = 0.1 * max((sums.cosine for sums in self._lights.values()), default=0.0)
        ratios = {light: sums.ratio for light, sums in self._lights.items() if sums.cosine > front}
        typical = float(np.median(list(ratios.values()))) if ratios else 1.0
        for light, ratio in ratios.items():
            if not 1 / MAX_DEVIATION_FACTOR <= ratio / typical <= MAX_DEVIATION_FACTOR:
                notes.append(
                    f"Teeth under light {light} are {ratio / typical:.2g} times as bright as its position and intensity"
                    " let expect; check both."
                )
        return tuple(notes)


def _incidence(
    footprint: Footprint, camera: Camera, light: Light, chosen: NDArray[np.bool_], step: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    # Cosine of incidence (N,) at the chosen pixels' surface points, 0 for light from behind, and the light's distance
    # (N,) in mm; shadows are ignored.
    y, x = np.nonzero(chosen[::step, ::step])
    y, x = y * step, x * step
    towards = np.asarray(light.position_mm) - footprint.points_at(camera, y, x)
    distance_mm = np.linalg.norm(towards, axis=-1)
    return np.maximum((towards * footprint.normal[y, x]).sum(axis=-1) / distance_mm, 0), distance_mm
