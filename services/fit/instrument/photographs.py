"""Photographs of an image by an instrument with errors, and their derivatives with respect to these errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from services.fit.execution.blocks import Block

Array = NDArray[np.float64]


def photographed(image: Array, block: Block, errors: Mapping[str, float]) -> Array:
    """Photographs (L, N) that an instrument with these errors would take of an image (L, N)."""
    instrument = block.instrument
    if not errors or instrument is None:
        return image
    gains = (
        1
        + errors.get(instrument.gain, 0.0)
        + np.array([errors.get(light, 0.0) for light in instrument.lights])[:, None]
    )
    return np.asarray(gains * image + errors.get(instrument.flare, 0.0) * instrument.brightest)


def error_derivatives(image: Array, block: Block, names: Sequence[str]) -> Array:
    """Derivatives (K, L N) of the photographs with respect to each named error: the image for the gain, one light's
    image for a light's gain, and the brightest pixel's value everywhere for a flare.
    """
    found = np.zeros((len(names), *image.shape))
    instrument = block.instrument
    if instrument is None:
        return found.reshape(len(names), image.size)
    index = {name: k for k, name in enumerate(names)}
    if instrument.gain in index:
        found[index[instrument.gain]] = image
    for row, light in enumerate(instrument.lights):
        if light in index:
            found[index[light], row] = image[row]
    if instrument.flare in index:
        found[index[instrument.flare]] = instrument.brightest
    return found.reshape(len(names), image.size)
