"""What an instrument with errors makes of an image, and the derivatives of that to its errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from services.fit.execution.blocks import Block

Array = NDArray[np.float64]


def taken(image: Array, block: Block, errors: Mapping[str, float]) -> Array:
    """The photographs (L, N) that the instrument would take of an image (L, N) with these errors."""
    if not errors:
        return image
    change = np.array(list(errors.values())) @ columns(image, block, tuple(errors))
    return image + change.reshape(image.shape)


def columns(image: Array, block: Block, names: Sequence[str]) -> Array:
    """Derivatives (K, L N) of the photographs to each named error: the image, one light's, or the brightest pixel's value everywhere."""
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
