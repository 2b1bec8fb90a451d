"""From a camera's channels to CIE colours, relative to a perfect diffuser in the same light."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.assets.colour.develop import xyz_from_assumed
from services.assets.colour.spaces import adaptation
from services.assets.content import RGB
from services.core.colour.cie import D50, D65, lab_from_xyz

Floats = NDArray[np.float64]
ASSUMED = "no colour matrix is known; red, green and blue are taken for linear sRGB"
CALIBRATED = "the matrix of the calibration's chart"


@dataclass(frozen=True)
class CameraWhite:
    """What a camera's red, green and blue are in XYZ under D50."""

    xyz_from_rgb: Floats
    """Matrix (3, 3) from radiance relative to a perfect diffuser's; (1, 1, 1) becomes the white of D50."""
    source: str
    """Where the matrix comes from, in words."""

    def lab(self, relative: Floats, illuminant: str = "D50") -> Floats:
        """CIELAB (N, 3) under D50 or D65 of radiances (N, 3) relative to a perfect diffuser's."""
        xyz = np.asarray(relative) @ self.xyz_from_rgb.T
        return lab_from_xyz(xyz, D50) if illuminant == "D50" else lab_from_xyz(xyz @ adaptation(D50, D65).T, D65)


def camera_white(asset: Path, camera: str = "") -> CameraWhite | None:
    """The colour of a camera of an asset, by default of its first; None where channels are not red, green and blue.

    Args:
        asset: folder of the asset, whose ``rig.json`` holds the colours of its cameras where they are known.
    """
    rig = json.loads((asset / "rig.json").read_text(encoding="utf-8"))
    if tuple(rig.get("channels", ())) != RGB:
        return None
    told = rig.get("colour") or {}
    own = told.get("cameras", {}).get(camera or rig["cameras"][0])
    if own is None:
        return CameraWhite(xyz_from_assumed(), ASSUMED)
    is_assumed = str(own["source"]).startswith("assumed")
    return CameraWhite(np.array(own["xyz_d50_from_rgb"]), ASSUMED if is_assumed else CALIBRATED)
