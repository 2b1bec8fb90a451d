"""A small folder capture with images that tests can predict."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from services.core.files.meshes import write_mesh
from services.core.geometry import Camera, Light, Mesh
from services.core.records import FolderCapture, ImageEntry
from services.core.store import write_record


def write_mouth(
    folder: Path,
    lights: int = 6,
    sizes: tuple[tuple[int, int], ...] = ((24, 18), (20, 16)),
    channels: tuple[str, ...] = ("red", "green", "blue"),
) -> FolderCapture:
    """Write ``capture.json``, smooth images of distinct brightness per light and channel, and one round tooth, FDI
    11.
    """
    cameras = tuple(
        Camera(
            name=f"c{i}",
            size=size,
            K=((100, 0, size[0] / 2), (0, 100, size[1] / 2), (0, 0, 1)),
            camera_from_world=((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 100), (0, 0, 0, 1)),
        )
        for i, size in enumerate(sizes)
    )
    rig = tuple(
        Light(name=f"l{j}", position_mm=(10.0 * j, 0, -1000), intensity=(1e6,) * len(channels)) for j in range(lights)
    )
    images = tuple(
        ImageEntry(camera=f"c{i}", light=f"l{j}", file=f"c{i}_l{j}.npy")
        for i in range(len(sizes))
        for j in range(lights)
    )
    description = FolderCapture(units="mm", channels=channels, cameras=cameras, lights=rig, images=images)
    folder.mkdir(parents=True, exist_ok=True)
    for i, (width, height) in enumerate(sizes):
        for j in range(lights):
            np.save(folder / f"c{i}_l{j}.npy", smooth_image(width, height, len(channels), i, j))
    ball = trimesh.creation.icosphere(subdivisions=1, radius=4.0)
    write_mesh(
        folder / "teeth" / "11" / "outer.ply", Mesh(np.asarray(ball.vertices), np.asarray(ball.faces, dtype=np.int32))
    )
    write_record(folder / "capture.json", description)
    return description


def smooth_image(width: int, height: int, channels: int, camera: int, light: int) -> NDArray[np.float32]:
    """Radiance (height, width, channel) of one camera and light, between 0.1 and 1."""
    y, x = np.mgrid[:height, :width]
    waves = [np.sin(x / 4 + light + k) * np.cos(y / 5 + camera) for k in range(channels)]
    return (0.1 + 0.225 * (1 + light % 2 + np.stack(waves, axis=-1))).astype(np.float32)
