"""The cell of all slab benchmarks, as the description of a slab folder without its files."""

from __future__ import annotations

from typing import Any

from services.core.slab.folder import SlabFolder


def near_beam_folder(**changes: Any) -> SlabFolder:
    """Return a cell of 1 mm without glass, with three lights and three cameras per side, one of which looks 3 degrees
    beside a beam.

    Args:
        changes: top-level keys of ``slab.json`` to replace. Images cannot be replaced: there is one of every camera
            under every light.
    """
    angles = {"f": (-5, -15, -25), "b": (8, 18, -15)}
    sides = {"f": "front", "b": "back"}
    description: dict[str, Any] = {
        "kind": "slab",
        "units": "mm",
        "wavelengths_nm": [532.0],
        "cell": {"width_mm": 1.0, "index": 1.33},
        "beam": {"profile": "gaussian", "sigma_mm": 0.25},
        "pixels": {"x_mm": [-4.0, 4.0], "y_mm": [-4.0, 4.0], "columns": 16, "rows": 16},
        "lights": [
            {"name": f"l{k}", "side": "front", "angle_deg": float(angle)} for k, angle in enumerate((5, 15, 25))
        ],
        "cameras": [
            {"name": f"{letter}{k}", "side": sides[letter], "angle_deg": float(angle)}
            for letter, own in angles.items()
            for k, angle in enumerate(own)
        ],
    }
    description.update(changes)
    description["images"] = [
        {
            "camera": camera["name"],
            "light": light["name"],
            "file": f"{camera['name']}_{light['name']}.npy",
            "variance_file": f"{camera['name']}_{light['name']}_var.npy",
        }
        for light in description["lights"]
        for camera in description["cameras"]
    ]
    return SlabFolder.model_validate(description)
