"""An incisor under all lights of a dome: one walk for all of them against stock ``prbvolpath`` light by light.

Efficiency is 1 / (variance x time) with variance = sum of the pixels' variances / sum of their squares, both measured in this
run on this machine with the same threads. The peer renders a few of the lights and its time is scaled to all.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.meshfiles import write_mesh
from services.fit.anatomy.incisor import build_incisor
from services.fit.anatomy.rig import dome_cameras, dome_lights
from services.fit.bench import Row
from services.fit.optics.parameters import Medium, Tissue
from services.fit.transport.engine import Engine
from services.fit.transport.recipe import DentinShape, SceneRecipe, View

TISSUE = Tissue(Medium(4.5, 0.997, 0.93, 0.82, -0.1), Medium(12.0, 0.9945, 1.0, 0.75))
PIXEL_MM = 0.5


def run(*, quick: bool) -> list[dict[str, Any]]:
    """Rows of this engine and of the peer at growing sample counts, and the peer's summary row."""
    lights = 18 if quick else 54
    peer_lights = 2 if quick else 6
    incisor = build_incisor()
    (camera,) = dome_cameras(1, PIXEL_MM, (incisor.outer,))
    rig = dome_lights(lights, ("green",), seed=1)
    positions = np.array([light.position_mm for light in rig])
    intensities = np.array([light.intensity[0] for light in rig])
    known = DentinShape(incisor.dentin, np.zeros((0, len(incisor.dentin.vertices_mm), 3)))
    engine = Engine(SceneRecipe(incisor.outer, known, positions, intensities))
    width, height = camera.size
    y, x = np.mgrid[0:height, 0:width]
    everything = View(camera, np.stack([x.ravel(), y.ravel()], axis=1).astype(np.int32))
    seen = engine.images(TISSUE, everything, samples=16, seed=99).mean.sum(axis=0) > 0
    view = View(camera, everything.pixels[seen])

    rows, ours = [], []
    for samples in (64, 256) if quick else (64, 256, 1024):
        begun = time.perf_counter()
        estimate = engine.images(TISSUE, view, samples=samples, seed=samples)
        rows.append(_row("dentine", time.perf_counter() - begun, estimate.mean, estimate.variance))
        ours.append(rows[-1])
    peers: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        counts = (64,) if quick else (64, 256)
        peers.extend(_peer(Path(folder), incisor, camera, view, positions, intensities, peer_lights, samples) for samples in counts)
    rows += peers
    efficiency = [np.mean([1 / (row.seconds * row.error**2) for row in group]) for group in (ours, peers)]
    rows.append(peers[-1].model_copy(update={"benchmark": "transport-stack-summary", "efficiency_ratio": float(efficiency[0] / efficiency[1])}))
    return [row.model_dump() for row in rows]


def _peer(
    folder: Path, incisor: Any, camera: Any, view: View, positions: NDArray[np.float64], intensities: NDArray[np.float64], count: int, samples: int
) -> Row:
    from services.fit.export.mitsuba_scene import load_scene, nested_scene, render_batches

    write_mesh(folder / "outer.ply", incisor.outer)
    write_mesh(folder / "dentin.ply", incisor.dentin)
    chosen = np.linspace(0, len(positions) - 1, count).astype(int)
    seconds, mean, variance = 0.0, [], []
    x, y = view.pixels.T
    for light in chosen:
        scene = load_scene(
            nested_scene(
                {"tooth": (folder / "outer.ply", folder / "dentin.ply")},
                TISSUE, (camera,), positions[light], float(intensities[light]), boundary="matched", ior=1.0, samples=samples // 16,
            )
        )  # fmt: skip
        render_batches(scene, 0, 16, seed=1, batches=2)
        begun = time.perf_counter()
        image, spread = render_batches(scene, 0, samples, seed=2)
        seconds += time.perf_counter() - begun
        mean.append(image[y, x])
        variance.append(spread[y, x])
    return _row("mitsuba-prbvolpath", seconds * len(positions) / count, np.array(mean), np.array(variance))


def _row(peer: str, seconds: float, mean: NDArray[np.float64], variance: NDArray[np.float64]) -> Row:
    return Row(benchmark="transport-stack", peer=peer, seconds=seconds, error=float(np.sqrt(variance.sum()) / np.linalg.norm(mean)))
