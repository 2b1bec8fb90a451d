"""How bright teeth are against a white surface in their place: what is dark, and what units are wrong."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from services.core.errors import CaptureInputError
from services.core.geometry import Camera, Light
from services.preprocess.projection import Footprint
from services.preprocess.source import LightImage

PLAUSIBLE = (1e-3, 10.0)
"""Radiance of teeth over that of a white diffuser. Real teeth give 0.1 to 1; a unit that is wrong by 1000 moves this by 1e6."""
ODD_LIGHT = 30.0
"""A light this much brighter or dimmer than the others, against what its calibration says, is told."""
CERTAIN = 4.0
"""Standard errors above which an image's light counts as seen."""


@dataclass
class Brightness:
    """Sums over the images of a capture, one light at a time."""

    _sums: dict[str, list[tuple[float, float]]] = field(default_factory=lambda: defaultdict(list))
    dark: list[tuple[str, str]] = field(default_factory=list)
    """(camera, light) of images in which no tooth is above the noise."""

    def add(self, image: LightImage, footprint: Footprint, camera: Camera, light: Light, chosen: NDArray[np.bool_]) -> bool:
        """Count the chosen pixels (H, W) of an image; returns whether any light is seen in them."""
        measured, variance = image.radiance[chosen].astype(np.float64), image.variance[chosen].astype(np.float64)
        if not chosen.any():
            return True
        if measured.sum() <= CERTAIN * np.sqrt(variance.sum()):
            self.dark.append((camera.name, light.name))
            return False
        white = white_irradiance(footprint, camera, light, chosen).sum() / np.pi * sum(light.intensity)
        self._sums[light.name].append((float(measured.sum()), float(white)))
        return True

    def require_plausible(self) -> None:
        """Refuse a capture whose brightness no tooth has.

        Raises:
            CaptureInputError: says by how much.
        """
        measured, white = (sum(pair[k] for pairs in self._sums.values() for pair in pairs) for k in (0, 1))
        if white > 0 and not PLAUSIBLE[0] <= measured / white <= PLAUSIBLE[1]:
            raise CaptureInputError(
                f"Teeth are {measured / white:.2g} times as bright as a white surface in their place would be, where real ones are 0.1 to 1 times; give "
                "positions in mm, intensities per steradian with mm as the length unit, and images in the same radiance unit."
            )

    def notes(self) -> tuple[str, ...]:
        """Sentences on dark images and on lights unlike the others."""
        notes = []
        if self.dark:
            which = ", ".join(f"camera {camera} under light {light}" for camera, light in self.dark[:3])
            more = f" and {len(self.dark) - 3} more" if len(self.dark) > 3 else ""
            notes.append(f"Dark and left out: {which}{more}; check that these lights were on, then capture them again.")
        ratios = _ratios(self._sums)
        typical = float(np.median(list(ratios.values()))) if ratios else 1.0
        for light, ratio in ratios.items():
            factor = ratio / typical
            if not 1 / ODD_LIGHT <= factor <= ODD_LIGHT:
                notes.append(f"Teeth under light {light} are {factor:.2g} times as bright as its position and intensity let expect; check both.")
        return tuple(notes)


def white_irradiance(footprint: Footprint, camera: Camera, light: Light, chosen: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Irradiance (N,) at the chosen pixels' surface, per mm^2, by a light of unit intensity; shadows are not looked for."""
    rows = np.flatnonzero(chosen.any(axis=1))
    band = slice(int(rows[0]), int(rows[-1]) + 1)
    towards = np.asarray(light.position_mm) - footprint.points_mm(camera, band)[chosen[band]].astype(np.float64)
    distance = np.linalg.norm(towards, axis=-1)
    cosine = (towards * footprint.normal[chosen]).sum(axis=-1) / distance
    return np.asarray(np.maximum(cosine, 0) / distance**2, dtype=np.float64)


def _ratios(sums: Mapping[str, list[tuple[float, float]]]) -> dict[str, float]:
    # Only lights from the front: behind a tooth, what shines through has little to do with a white surface.
    totals = {light: (sum(m for m, _ in pairs), sum(w for _, w in pairs)) for light, pairs in sums.items()}
    bright = 0.1 * max((white for _, white in totals.values()), default=0.0)
    return {light: measured / white for light, (measured, white) in totals.items() if white > bright}
