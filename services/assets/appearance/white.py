"""From a camera's channels to CIE colours, relative to a perfect diffuser in the same light."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.assets.colour import develop
from services.assets.colour.spaces import adaptation
from services.assets.content import RGB
from services.core.calibration.cameras_and_lights import CameraColour
from services.core.colour.cie import D50, D65, lab_from_xyz

Floats = NDArray[np.float64]
ASSUMED = "no colour matrix is known; red, green and blue are taken for linear sRGB"
CALIBRATED = "the calibration's chart"


@dataclass(frozen=True)
class CameraWhite:
    """What a camera's red, green and blue are in XYZ under D50."""

    colour: CameraColour | None
    """The camera's colour; None where none is known, and its channels are taken for linear sRGB."""

    @property
    def source(self) -> str:
        """Where the colours come from, in words."""
        return ASSUMED if self.colour is None else CALIBRATED

    def lab(self, relative: Floats, illuminant: str = "D50") -> Floats:
        """CIELAB (N, 3) under D50 or D65 of radiances (N, 3) relative to a perfect diffuser's."""
        xyz = develop.xyz_d50(relative, self.colour)
        return lab_from_xyz(xyz, D50) if illuminant == "D50" else lab_from_xyz(xyz @ adaptation(D50, D65).T, D65)


def camera_white(asset: Path, camera: str = "") -> CameraWhite | None:
    """The colour of a camera of an asset, by default of its first; None where channels are not red, green and blue, or
    are not told, as in assets of slabs.

    Args:
        asset: folder of the asset, whose ``rig.json`` holds the colours of its cameras where they are known.
    """
    path = asset / "rig.json"
    rig = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    if tuple(rig.get("channels", ())) != RGB:
        return None
    told = rig.get("colour") or {}
    own = told.get("cameras", {}).get(camera or rig["cameras"][0])
    if own is None or own["source"] == develop.ASSUMED:
        return CameraWhite(None)
    return CameraWhite(CameraColour(xyz_from_rgb=own["xyz_d50_from_rgb"], root_polynomial=own["root_polynomial"]))
