"""From a camera's channels to CIE colours, relative to a perfect diffuser in the same light."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.assets.content import RGB
from services.core.colour.cie import D50, D65, lab_from_xyz
from services.core.geometry import Light, Vector3

Floats = NDArray[np.float64]
BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
"""Cone responses from XYZ of the Bradford adaptation (ICC.1:2022, annex E.3)."""
D65_FROM_D50 = np.linalg.inv(BRADFORD) @ np.diag((BRADFORD @ D65) / (BRADFORD @ D50)) @ BRADFORD
"""XYZ under D65 from XYZ under D50, so that white stays white."""
SRGB_PRIMARIES = np.array([[0.64, 0.30, 0.15], [0.33, 0.60, 0.06], [0.03, 0.10, 0.79]])
"""x, y, z of red, green and blue as columns (IEC 61966-2-1)."""
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
        return lab_from_xyz(xyz, D50) if illuminant == "D50" else lab_from_xyz(xyz @ D65_FROM_D50.T, D65)


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
        return CameraWhite(xyz_from_srgb(), ASSUMED)
    return CameraWhite(np.array(own["xyz_from_rgb"]), ASSUMED if "none" in str(told.get("matrix")) else CALIBRATED)


def xyz_from_srgb() -> Floats:
    """Matrix (3, 3) from linear sRGB to XYZ under D50, by the Bradford adaptation."""
    primaries = SRGB_PRIMARIES / SRGB_PRIMARIES[1]
    xyz_d65 = primaries * np.linalg.solve(primaries, D65)
    return np.asarray(np.linalg.inv(D65_FROM_D50) @ xyz_d65)


def diffuser_radiance(light: Light, at_mm: Vector3) -> Floats:
    """Radiance (C,) of a perfect diffuser that faces a light at a point: intensity / (pi d^2)."""
    squared = float(np.sum((np.array(light.position_mm) - np.array(at_mm)) ** 2))
    return np.array(light.intensity) / (np.pi * squared)
