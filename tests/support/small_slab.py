"""A small slab rig: one cell, some lights and cameras, and its folder on disk."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from services.core.slab.folder import SlabFolder
from services.fit.slab.model.rig import Rig, rig_of

WAVELENGTH_NM = 532.0


def description(**changes: Any) -> dict[str, Any]:
    """``slab.json`` of a 1 mm cell with a front and a back light and two cameras; top-level keys may be replaced."""
    lights = [{"name": "l0", "side": "front", "angle_deg": 5.0}, {"name": "l1", "side": "back", "angle_deg": 20.0}]
    cameras = [{"name": "f0", "side": "front", "angle_deg": -15.0}, {"name": "b0", "side": "back", "angle_deg": 8.0}]
    told: dict[str, Any] = {
        "kind": "slab",
        "units": "mm",
        "wavelengths_nm": [WAVELENGTH_NM],
        "cell": {"width_mm": 1.0, "index": 1.33, "index_outside": 1.0, "boundary": "smooth", "glass": None},
        "beam": {"profile": "gaussian", "sigma_mm": 0.25, "power": 1.0},
        "pixels": {"x_mm": [-4.0, 4.0], "y_mm": [-4.0, 4.0], "columns": 8, "rows": 8},
        "lights": lights,
        "cameras": cameras,
    }
    told.update(changes)
    told.setdefault(
        "images",
        [
            {"camera": camera["name"], "light": light["name"], "file": f"{camera['name']}_{light['name']}.npy"}
            for light in told["lights"]
            for camera in told["cameras"]
        ],
    )
    return told


def small_rig(**changes: Any) -> Rig:
    """The rig of ``description``."""
    return rig_of(SlabFolder.model_validate(description(**changes)), WAVELENGTH_NM)


def write_folder(root: Path, told: dict[str, Any], image: np.ndarray | None = None) -> Path:
    """Write a slab folder with the same image in every file."""
    root.mkdir(parents=True, exist_ok=True)
    (root / "slab.json").write_text(json.dumps(told))
    pixels = np.full((8, 8), 0.01) if image is None else image
    for entry in told["images"]:
        np.save(root / entry["file"], pixels)
    return root
