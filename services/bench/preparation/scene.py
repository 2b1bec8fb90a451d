"""Synthetic frames of one camera that show a tooth over most of the image's height; no input file is needed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from services.core.files.meshes import write_mesh
from services.core.geometry import Camera, Light, Mesh, teeth_folder
from services.core.records import FolderCapture
from services.core.results import CaptureManifest, FrameRecord
from services.core.store import StageWriter, create_array, image_pieces

DISTANCE_MM = 300.0
HALF_AXES_MM = (4.5, 5.5, 3.5)
SHARE_OF_HEIGHT = 0.8
BLACK, BITS = 64, 12
CHANNELS = ("red", "green", "blue")
COLOUR = (3000.0, 2700.0, 2200.0)
"""Counts of the channels above black; 0.8 of them are those of a surface that faces the light."""
MOVED_PX = (1.3, 0.7)
"""Movement of the tooth in x and y from the first lit frame to the last."""


@dataclass(frozen=True)
class Scene:
    """A published capture of one camera.

    Attributes:
        root: folder of the job.
        manifest: the published manifest.
        counts: counts (H, W, C) of the last frame.
    """

    root: Path
    manifest: CaptureManifest
    counts: NDArray[np.uint16]


def make_scene(
    root: Path, size: tuple[int, int], lights: int, tracking: int = 4, seed: int = 1, share: float = SHARE_OF_HEIGHT
) -> Scene:
    """Publish a capture with one black frame, tracking frames and one frame per light.

    Args:
        root: folder of the job.
        size: width and height of the frames in pixels.
        lights: number of lights.
        tracking: number of tracking frames.
        seed: seed of the frames' grain.
        share: ratio of the tooth's height to the image's.
    """
    width, height = size
    focal_px = share / 2 * height / HALF_AXES_MM[1] * DISTANCE_MM
    camera = Camera(
        name="c0",
        size=size,
        K=((focal_px, 0, width / 2), (0, focal_px, height / 2), (0, 0, 1)),
        camera_from_world=((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, DISTANCE_MM), (0, 0, 0, 1)),
    )
    lamps = tuple(
        Light(name=f"l{k}", position_mm=(200.0 + 5 * k, -300.0, -700.0), intensity=(1e6,) * 3) for k in range(lights)
    )
    # Put tracking frames at even intervals among the lights, one at either end, so that no motion is extrapolated.
    kinds = ["light"] * lights
    for place in np.linspace(lights, 0, tracking).round().astype(int).tolist():
        kinds.insert(place, "tracking")
    kinds.insert(0, "black")
    names = iter(lamps)
    frames = tuple(
        FrameRecord.model_validate(
            {
                "index": index,
                "kind": kind,
                "light": next(names).name if kind == "light" else None,
                "exposure_s": 0.05,
                "level": 0.0 if kind == "black" else 1.0,
                "time_s": 0.06 * index,
                "readback": (0, 0, 0),
            }
        )
        for index, kind in enumerate(kinds)
    )
    writer = StageWriter(root, "capture", 1)
    shape = (1, len(frames), height, width, 3)
    chunk, shard = image_pieces(height, width)
    pieces = (1, 1, *shard, 3), "uint16", ("camera", "frame", "y", "x", "channel"), (1, 1, *chunk, 3)
    array = create_array(writer.folder, "capture.zarr", shape, *pieces)
    rng = np.random.default_rng(seed)
    grain = rng.normal(scale=20, size=(height, width)).astype(np.float32)
    counts = np.empty((height, width, 3), dtype=np.uint16)
    for frame in frames:
        moved = max(0, frame.index - 1) / (len(frames) - 2)
        _photograph(counts, grain, focal_px, moved, lit=frame.kind != "black")
        array[0, frame.index] = counts
    ball = trimesh.creation.icosphere(subdivisions=5)
    mesh = Mesh(np.asarray(ball.vertices) * HALF_AXES_MM, np.asarray(ball.faces, dtype=np.int32))
    write_mesh(teeth_folder(writer.folder, 11) / "outer.ply", mesh)
    manifest = CaptureManifest(
        description=FolderCapture(units="mm", channels=CHANNELS, cameras=(camera,), lights=lamps),
        frames=frames,
        bits=BITS,
        black_level=BLACK,
        radiance_per_count=1e-5,
        sensor_noise_relative=0.01,
        sensor_noise_floor=0.002,
        fdi=(11,),
    )
    writer.publish(manifest)
    return Scene(root, manifest, counts)


def _photograph(
    counts: NDArray[np.uint16], grain: NDArray[np.float32], focal_px: float, moved: float, *, lit: bool
) -> None:
    # Draw a shaded ellipse in parallel projection, which is similar enough for a measurement of speed, with fixed grain
    # so that all runs have equal frames.
    height, width = grain.shape
    x = (np.arange(width, dtype=np.float32) - width / 2 - moved * MOVED_PX[0]) * (
        DISTANCE_MM / focal_px / HALF_AXES_MM[0]
    )
    y = (np.arange(height, dtype=np.float32) - height / 2 - moved * MOVED_PX[1]) * (
        DISTANCE_MM / focal_px / HALF_AXES_MM[1]
    )
    facing = np.sqrt(np.maximum(1 - x * x - (y * y)[:, None], 0)) if lit else np.zeros_like(grain)
    for c, level in enumerate(COLOUR):
        counts[..., c] = np.clip(BLACK + level * 0.8 * facing + grain, 0, 2**BITS - 1)
