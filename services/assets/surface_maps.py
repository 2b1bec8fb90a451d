"""The report's maps of a tooth as one camera sees it: the enamel's thickness and stains, with standard errors."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.pages.pictures import data_uri, enlarge, scalar_map
from services.transport.thickness import ThicknessMap

HEIGHT_PIXELS = 240
"""Height to which a map is enlarged."""


def thickness_maps(found: ThicknessMap | None, mean: str, camera: str) -> dict[str, Any] | None:
    """Maps of the enamel's thickness and of its standard error, with their ranges and means.

    Args:
        found: the maps; None where there are none.
        mean: the mean thickness, as a text.
        camera: the camera's name.
    """
    if found is None:
        return None
    high = max(0.5, math.ceil(2 * float(np.nanpercentile(found.image_mm, 99))) / 2)
    maps = [("Distance from the outer surface to dentin", found.image_mm, high, mean)]
    if found.errors_mm is not None:
        most = max(0.05, math.ceil(20 * float(np.nanpercentile(found.errors_mm, 99))) / 20)
        maps.append(("Its standard error", found.errors_mm, most, f"{np.nanmean(found.errors_mm):.2f} mm"))
    drawn = [(what, _drawn(values, (0.0, most)), f"{most:g} mm", told) for what, values, most, told in maps]
    height, width = found.image_mm.shape
    return {"maps": drawn, "camera": camera, "width": str(width), "height": str(height)}


def stain_maps(
    stains: NDArray[np.floating] | None, errors: NDArray[np.floating] | None, channels: tuple[str, ...], camera: str
) -> dict[str, Any] | None:
    """A map of each channel's stain, from the darkest visible texel to a clean surface, and one of its standard error;
    with few channels separate maps are clearer than one in colour.

    Args:
        stains: transmittance (H, W, C), NaN off the tooth; None where there is none.
        errors: its standard error (H, W, C), NaN where it is not known; None where it is known nowhere.
        channels: the names of the C channels.
        camera: the camera's name.
    """
    if stains is None or not np.isfinite(stains).any():
        return None
    low = float(np.floor(10 * np.nanmin(stains)) / 10)
    images = []
    for k, name in enumerate(channels):
        told = f"{np.nanmean(stains[..., k]):.2f}"
        what = f"Channel {name}: the share of light that the surface lets pass"
        images.append((what, _drawn(stains[..., k], (low, 1.0)), f"{low:g}", "1, clean", told))
        own = None if errors is None else errors[..., k]
        if own is not None and np.isfinite(own).any():
            most = max(0.05, math.ceil(20 * float(np.nanpercentile(own, 99))) / 20)
            what = f"Channel {name}: its standard error, with the media as they were fitted"
            images.append((what, _drawn(own, (0.0, most)), "0", f"{most:g}", f"{np.nanmean(own):.2f}"))
    height, width = stains.shape[:2]
    return {"images": images, "camera": camera, "width": str(width), "height": str(height)}


def _drawn(values: NDArray[np.floating], limits: tuple[float, float]) -> str:
    return data_uri(enlarge(scalar_map(values, limits), HEIGHT_PIXELS))
