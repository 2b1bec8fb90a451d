"""A published capture made from rendered frames, without the capture service: counts, noise and frame table as the
records specify.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from services.core.files.meshes import write_mesh
from services.core.geometry import Camera, Light, Mesh, teeth_folder
from services.core.records import FolderCapture
from services.core.results import CaptureManifest, FrameRecord
from services.core.store import StageWriter, create_array

LEVEL, EXPOSURE_S = 0.5, 0.05


@dataclass(frozen=True)
class Rendered:
    """Frames of a moving tooth.

    Attributes:
        frames: (light index, or -1 for all lights on; time) of each frame.
        radiance: (camera, frame, y, x, channel).
    """

    frames: tuple[tuple[int, float], ...]
    radiance: NDArray[np.float32]
    cameras: tuple[Camera, ...]
    lights: tuple[Light, ...]
    mesh: Mesh
    channels: tuple[str, ...] = ("red", "green", "blue")


def write_capture(
    root: Path,
    rendered: Rendered,
    *,
    seed: int = 5,
    bits: int = 12,
    black: int = 64,
    relative: float = 0.01,
    floor: float = 0.002,
    peak: float | None = None,
) -> CaptureManifest:
    """Publish ``root/capture``. Radiance ``peak`` (by default the brightest under one light) gets 0.7 of the counts
    between black and full scale.
    """
    rng = np.random.default_rng(seed)
    full_scale, count_of = 2**bits - 1, len(rendered.lights)
    brightest = max(float(rendered.radiance[:, k].max()) for k, (light, _) in enumerate(rendered.frames) if light >= 0)
    per_count = (brightest if peak is None else peak) * LEVEL * EXPOSURE_S / (0.7 * (full_scale - black))
    writer = StageWriter(root, "capture", 1)
    cameras, _, height, width, channels = rendered.radiance.shape
    kinds: list[tuple[int, float] | None] = [None, None, *rendered.frames]
    array = create_array(
        writer.folder,
        "capture.zarr",
        (cameras, len(kinds), height, width, channels),
        (1, 1, height, width, channels),
        "uint16",
        ("camera", "frame", "y", "x", "channel"),
    )
    table = []
    for index, what in enumerate(kinds):
        kind: Literal["black", "tracking", "light"] = (
            "black" if what is None else "tracking" if what[0] < 0 else "light"
        )
        level = {"black": 0.0, "tracking": LEVEL / count_of, "light": LEVEL}[kind]
        for camera in range(cameras):
            signal = 0 if what is None else rendered.radiance[camera, index - 2] * (level * EXPOSURE_S / per_count)
            deviation = np.hypot(relative * signal, floor * full_scale)
            noisy = black + signal + deviation * rng.standard_normal((height, width, channels))
            array[camera, index] = np.clip(np.rint(noisy), 0, full_scale).astype(np.uint16)
        light = rendered.lights[what[0]].name if what is not None and what[0] >= 0 else None
        table.append(
            FrameRecord(
                index=index,
                kind=kind,
                light=light,
                exposure_s=EXPOSURE_S,
                level=level,
                time_s=index * 0.06,
                readback=(round(level * 65535),) * 3,
            )
        )
    write_mesh(teeth_folder(writer.folder, 11) / "outer.ply", rendered.mesh)
    manifest = CaptureManifest(
        description=FolderCapture(
            units="mm", channels=rendered.channels, cameras=rendered.cameras, lights=rendered.lights
        ),
        frames=tuple(table),
        bits=bits,
        black_level=black,
        radiance_per_count=per_count,
        sensor_noise_relative=relative,
        sensor_noise_floor=floor,
        fdi=(11,),
    )
    writer.publish(manifest)
    return manifest
