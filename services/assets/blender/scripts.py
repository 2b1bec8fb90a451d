"""The scripts that build an asset's scene in Blender."""

from __future__ import annotations

from pathlib import Path

from services.core.store import write_atomic

SHIPPED = Path(__file__).parent / "shipped"
FOLDER = "blender"
"""Folder of the scripts in an asset."""
NAMES = ("blender_scene.py", "bodies.py", "materials.py")


def write_scripts(asset: Path) -> tuple[str, ...]:
    """Copy the scripts into an asset's folder; return their paths relative to it."""
    (asset / FOLDER).mkdir(parents=True, exist_ok=True)
    for name in NAMES:
        write_atomic(asset / FOLDER / name, (SHIPPED / name).read_bytes())
    return tuple(f"{FOLDER}/{name}" for name in NAMES)
