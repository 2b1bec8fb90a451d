"""Maps of the colour difference ΔE00 between photographs and renders."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.assets.appearance.white import CameraWhite
from services.core.colour.cie import delta_e_2000
from services.core.pages.pictures import Picture

JUST_SEEN, ACCEPTED = 0.8, 1.8
"""Differences that half of observers see, and accept (ISO/TR 28642:2016)."""


@dataclass(frozen=True)
class ColourDifference:
    """ΔE00 between one photograph and its render, noise of both included."""

    camera: str
    light: str
    held_out: bool
    image: NDArray[np.float64]
    """ΔE00 of each pixel (H, W), NaN where it was not compared."""
    median: float
    most: float
    """The difference that 95 % of the compared pixels keep."""


def colour_difference(
    picture: Picture, white_radiance: NDArray[np.float64], white: CameraWhite
) -> ColourDifference | None:
    """Compare a photograph with its render; None where no pixel was compared.

    Args:
        white_radiance: radiance (3,) of a perfect diffuser that faces the light where the teeth are.
        white: the camera's colours.
    """
    valid = picture.valid & np.isfinite(picture.photo).all(axis=-1)
    if not valid.any():
        return None
    labs = [white.lab(np.maximum(image[valid] / white_radiance, 0.0)) for image in (picture.photo, picture.render)]
    found = delta_e_2000(labs[0], labs[1])
    image = np.full(picture.valid.shape, np.nan)
    image[valid] = found
    return ColourDifference(
        picture.camera,
        picture.light,
        picture.held_out,
        image,
        float(np.median(found)),
        float(np.percentile(found, 95)),
    )
