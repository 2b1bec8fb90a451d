"""Photographs of an image by an instrument with errors, and their derivatives with respect to these errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from services.fit.execution.blocks import Block

Array = NDArray[np.float64]


def photographed(image: Array, block: Block, errors: Mapping[str, float]) -> Array:
    """Photographs (L, N) that an instrument with these errors would take of an image (L, N)."""
    acting = block.instrument
    if not errors or acting is None:
        return image
    gains = 1 + errors.get(acting.gain, 0.0) + np.array([errors.get(light, 0.0) for light in acting.lights])[:, None]
    return np.asarray(gains * image + errors.get(acting.flare, 0.0) * acting.brightest)


def columns(image: Array, block: Block, names: Sequence[str]) -> Array:
    """Derivatives (K, L N) of the photographs with respect to each named error: the image for the gain, one light's
    image for a light's gain, and the brightest pixel's value everywhere for a flare.
    """
    found = np.zeros((len(names), *image.shape))
    acting = block.instrument
    if acting is None:
        return found.reshape(len(names), image.size)
    place = {name: k for k, name in enumerate(names)}
    if acting.gain in place:
        found[place[acting.gain]] = image
    for row, light in enumerate(acting.lights):
        if light in place:
            found[place[light], row] = image[row]
    if acting.flare in place:
        found[place[acting.flare]] = acting.brightest
    return found.reshape(len(names), image.size)
