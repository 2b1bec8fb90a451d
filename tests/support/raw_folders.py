"""A small raw folder with known counts, for tests to alter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Tree = dict[str, Any]
SIZE = (24, 16)
BITS = 12


def counts(seed: int, channels: int = 3) -> NDArray[np.uint16]:
    """Random counts (16, 24, C) of a sensor of 12 bits."""
    return np.random.default_rng(seed).integers(64, 3000, (SIZE[1], SIZE[0], channels)).astype(np.uint16)


def write_raw_folder(root: Path) -> Tree:
    """Write a raw folder: two cameras and two lights, a black frame per camera and a frame per camera and light, a
    board, spheres, a chart and a scan. Returns the contents of its ``raw.toml``.
    """
    cameras = [{"name": name, "size": list(SIZE), "bits": BITS} for name in ("left", "right")]
    lights = [
        {"name": name, "address": k, "position_mm": [500.0 * k, 0.0, -300.0]} for k, name in enumerate(("L1", "L2"))
    ]
    frames: list[Tree] = []
    for k, camera in enumerate(cameras):
        np.save(root / f"{camera['name']}_black.npy", np.full((SIZE[1], SIZE[0], 3), 64, dtype=np.uint16))
        frames.append(
            {"camera": camera["name"], "file": f"{camera['name']}_black.npy", "kind": "black", "exposure_s": 0.1}
        )
        for j, light in enumerate(lights):
            file = f"{camera['name']}_{light['name']}.npy"
            np.save(root / file, counts(10 * k + j))
            lit = {"kind": "light", "light": light["name"], "level": 0.5, "time_s": 1.0 + j, "session": "a"}
            frames.append({"camera": camera["name"], "file": file, "exposure_s": 0.1, **lit})
    (root / "chart.csv").write_text("X,Y,Z\n")
    (root / "scan.ply").write_text("ply\n")
    seen = {"exposure_s": 0.1, "camera": "left"}
    frames.append({**seen, "file": "board.npy", "kind": "board", "board": "flat", "place": "p0"})
    frames.append({**seen, "file": "mirror.npy", "kind": "mirror-sphere", "sphere": "ball", "light": "L1"})
    frames.append({**seen, "file": "white.npy", "kind": "white-sphere", "sphere": "egg", "light": "L1"})
    corners = [[1.0, 1.0], [20.0, 1.0], [20.0, 12.0], [1.0, 12.0]]
    frames.append({**seen, "file": "chart.npy", "kind": "chart", "chart": "macbeth", "corners_px": corners})
    for k, name in enumerate(("board", "mirror", "white", "chart")):
        np.save(root / f"{name}.npy", counts(100 + k))
    tree: Tree = {"units": "mm", "camera": cameras, "light": lights, "frame": frames}
    board = {"type": "charuco", "squares": [7, 5], "square_mm": 12.0, "marker_mm": 9.0, "dictionary": "DICT_5X5_100"}
    tree["board"] = [{"name": "flat", **board}]
    tree["sphere"] = [
        {"name": "ball", "kind": "mirror", "radius_mm": 10.0},
        {"name": "egg", "kind": "white", "radius_mm": 12.0, "reflectance": [0.9, 0.9, 0.9]},
    ]
    tree["chart"] = [{"name": "macbeth", "type": "colorchecker-24", "reference": "chart.csv"}]
    tree["scan"] = {"file": "scan.ply", "units": "mm", "labels": "label", "jaw": "upper"}
    pixels = [{"camera": "left", "xy_px": [3.5, 4.5]}]
    tree["landmark"] = [{"tooth": 11, "point": "mesial edge", "xyz_mm": [0.0, 1.0, 2.0], "pixels": pixels}]
    write_toml(root, tree)
    return tree


def write_toml(root: Path, tree: Tree) -> None:
    """Write ``raw.toml``; tables below the first level are written inline."""
    lines = [f"{key} = {inline(value)}" for key, value in tree.items() if not isinstance(value, list | dict)]
    for key, value in tree.items():
        if isinstance(value, dict):
            lines += [f"[{key}]", *(f"{name} = {inline(one)}" for name, one in value.items())]
        elif isinstance(value, list):
            for entry in value:
                lines += [f"[[{key}]]", *(f"{name} = {inline(one)}" for name, one in entry.items())]
    (root / "raw.toml").write_text("\n".join(lines) + "\n")


def inline(value: object) -> str:
    """Format a value as inline TOML."""
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return f'"{escaped}"'
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key} = {inline(one)}" for key, one in value.items()) + "}"
    if isinstance(value, Sequence):
        return "[" + ", ".join(map(inline, value)) + "]"
    return repr(value)
