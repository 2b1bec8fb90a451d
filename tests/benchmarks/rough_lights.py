"""What images of a rough surface cost under all lights of a dome: connections aimed from inside beside those of walks
alone, and both against stock ``prbvolpath``, which renders light by light.

python -m tests.benchmarks.rough_lights --lights 54,8 --roughness 0.3,0.15,0.05 --json rough.json
python -m tests.benchmarks.rough_lights --lights 54 --roughness 0.3,0.15 --stock-seconds 100 --json rough.json

The scene is the shared micro-CT incisor. Efficiency is 1 / (variance x processor time), with variance = sum of the
pixels' variances / sum of their squares. Pairs are interleaved; a ratio is that of the median times and mean variances.
``jacobian`` is the same for derivatives to all parameters, by the largest relative error among them. Stock Mitsuba
renders some of the lights; only pixels without a highlight count, there is no compensation, and its time is scaled to
all lights. Its images have heavy tails, so that a ratio is uncertain by a factor of two.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.anatomy.dentin_shape import DentinShape
from services.assets.mitsuba.scene import load_scene, nested_scene, render_batches, surface_dict
from services.core.files.meshes import read_teeth, write_mesh
from services.core.geometry import Camera
from services.core.records import FolderCapture
from services.core.store import read_record
from services.phantom.dome_rig import dome_lights
from services.transport.boundary.rough import Rough
from services.transport.engine import Engine
from services.transport.optics.parameters import Medium, Tissue
from services.transport.platform import prepare_device
from services.transport.scene.recipe import SceneRecipe, View, relative_error, single_tooth
from tests.support.shared_data import shared_path

TISSUE = Tissue(Medium(6.0, 0.9965, g1=0.80), Medium(11.0, 0.993, g1=0.70))
INK = Tissue(Medium(1e4, 1e-6), Medium(1e4, 1e-6))
IOR = 1.63
NAMES = ("enamel.sigma", "enamel.alpha", "enamel.g1", "dentin.sigma", "dentin.alpha", "dentin.g1", "roughness")
PEER_LIGHTS = 4
MAX_HIGHLIGHT = 0.01
"""Largest share of a pixel's light that the surface may mirror for the pixel to count."""
HIGHLIGHT_SAMPLES = 64
FIRST_SAMPLES = 64
"""Paths per pixel of the first render of stock Mitsuba, whose time tells how many the stated seconds allow."""


@dataclass(frozen=True)
class Row:
    """One comparison at one number of lights and one roughness."""

    what: str
    lights: int
    roughness: float
    seconds: float
    """Processor time of one call of this engine."""
    variance: float
    """Sum of variances over sum of squares of that call."""
    ratio: float
    """Efficiency over that of the other method."""
    pairs: int
    by_light: tuple[float, ...] = ()
    """The ratio of each of stock Mitsuba's lights alone."""


class FixedEngine(Engine):
    """An engine that aims connections from inside a rough surface always, or never, whatever they cost."""

    def __init__(self, recipe: SceneRecipe, threads: int, *, aims: bool) -> None:
        super().__init__(recipe, threads)
        assert isinstance(self._boundary, Rough)
        self._boundary.aims = lambda lights: aims  # type: ignore[method-assign]  # noqa: ARG005


def scene(lights: int, roughness: float, *, compensated: bool) -> tuple[SceneRecipe, Camera]:
    """The incisor under so many lights of a dome, and its camera."""
    root = shared_path("data/tooth-ur1-truth")
    tooth, camera = read_teeth(root)[0], read_record(root / "capture.json", FolderCapture).cameras[0]
    rig = dome_lights(lights, ("green",), seed=1)
    assert tooth.dentin is not None
    plain = single_tooth(
        tooth.outer, DentinShape.known(tooth.dentin), np.array([light.position_mm for light in rig]),
        np.array([light.intensity[0] for light in rig]), "rough", IOR,
    )  # fmt: skip
    return replace(plain, roughness=roughness, multiple_scattering=compensated), camera


def tooth_view(engine: Engine, camera: Camera) -> View:
    """The pixels that show the tooth."""
    width, height = camera.size
    y, x = np.mgrid[0:height, 0:width]
    everything = View(camera, np.stack([x.ravel(), y.ravel()], axis=1).astype(np.int32))
    return View(camera, everything.pixels[engine.images(TISSUE, everything, samples=16, seed=99).mean.sum(axis=0) > 0])


def against_walks(lights: int, roughness: float, *, samples: int, pairs: int) -> Iterator[Row]:
    """Rows of images and of Jacobians, also where the engine would not aim (``Rough.aims`` follows from these)."""
    recipe, camera = scene(lights, roughness, compensated=True)
    engines = FixedEngine(recipe, 1, aims=True), FixedEngine(recipe, 1, aims=False)
    view = tooth_view(engines[1], camera)
    for what in ("images", "jacobian"):
        seconds, variances = np.zeros((pairs, 2)), np.zeros((pairs, 2))
        for pair in range(-1, pairs):  # the first pair compiles the kernels
            for which in (0, 1) if pair % 2 else (1, 0):
                begun, options = time.process_time(), {"seed": 2 * pair + which + 3, "samples": samples, "batches": 16}
                if what == "images":
                    estimate = engines[which].images(TISSUE, view, **options)
                    found = [relative_error(estimate.mean, estimate.variance)]
                else:
                    slopes = engines[which].jacobian(TISSUE, view, NAMES, **options)
                    both = zip(slopes.jacobian, slopes.jacobian_variance, strict=True)
                    found = [relative_error(*one) for one in both]
                if pair >= 0:
                    seconds[pair, which] = time.process_time() - begun
                    # Noise is part of a derivative's norm, so compare the sums of variances alone there.
                    variances[pair, which] = found[0] ** 2 if what == "images" else _spread(slopes.jacobian_variance)
        times, noise = np.median(seconds, axis=0), variances.mean(axis=0)
        ratio = float(times[1] * noise[1] / (times[0] * noise[0]))
        yield Row(what, lights, roughness, float(times[0]), float(noise[0]), ratio, pairs)


def _spread(variances: NDArray[np.float64]) -> float:
    """Geometric mean over the parameters of the summed variances (F, L, N)."""
    return float(np.exp(np.log(variances.sum(axis=(1, 2))).mean()))


def against_stock(lights: int, roughness: float, *, samples: int, stock_seconds: float, seed: int) -> Iterator[Row]:
    """One row for this engine as it chooses, and one for walks alone."""
    recipe, camera = scene(lights, roughness, compensated=False)
    engines = {"stock": Engine(recipe, 2), "stock, walks alone": FixedEngine(recipe, 2, aims=False)}
    view = tooth_view(engines["stock"], camera)
    chosen = np.linspace(0, lights - 1, PEER_LIGHTS).astype(int)
    theirs = [_stock(recipe, camera, view, int(light), stock_seconds, seed) for light in chosen]
    counts = np.array([~highlight for *_, highlight in theirs])
    spread = np.array([variance for _, variance, _, _ in theirs])
    peers = np.array([float(one[kept].sum()) for one, kept in zip(spread, counts, strict=True)])
    scaled = np.array([seconds for *_, seconds, _ in theirs]) * lights
    for what, engine in engines.items():
        engine.images(TISSUE, view, samples=16, seed=1)
        begun = time.process_time()
        estimate = engine.images(TISSUE, view, samples=samples, seed=1 + seed)
        seconds = time.process_time() - begun
        ours = np.array([estimate.variance[light][kept].sum() for light, kept in zip(chosen, counts, strict=True)])
        squares = sum(
            float((estimate.mean[light][kept] ** 2).sum()) for light, kept in zip(chosen, counts, strict=True)
        )
        by_light = tuple((peers * scaled / (ours * seconds)).tolist())
        ratio = float(peers.sum() * scaled.mean() / (ours.sum() * seconds))
        yield Row(what, lights, roughness, seconds, float(ours.sum()) / squares, ratio, 1, by_light)


def _stock(
    recipe: SceneRecipe, camera: Camera, view: View, light: int, limit_s: float, seed: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], float, NDArray[np.bool_]]:
    """Mean, variance, processor time, and whether the surface's mirror image of the light matters, by pixel."""
    prepare_device()
    (tooth,), (x, y) = recipe.teeth, view.pixels.T
    assert tooth.dentin is not None
    with tempfile.TemporaryDirectory() as folder:
        files = Path(folder) / "outer.ply", Path(folder) / "dentin.ply"
        write_mesh(files[0], tooth.outer)
        write_mesh(files[1], tooth.dentin.base)
        surface = surface_dict(files[0], Rough.mitsuba(IOR, roughness=recipe.roughness))
        scenes: list[Any] = []
        for tissue in (TISSUE, INK):
            plain = nested_scene(
                {"tooth": files}, tissue, (camera,), recipe.light_positions_mm[light].tolist(),
                float(recipe.light_intensities[light]),
            )  # fmt: skip
            plain["outer_tooth"] = surface | {"interior": {"type": "ref", "id": "medium_enamel"}}
            scenes.append(load_scene(plain))
    highlight, _ = render_batches(scenes[1], 0, HIGHLIGHT_SAMPLES, 1)
    render_batches(scenes[0], 0, 16, 2, 1)
    begun = time.process_time()
    render_batches(scenes[0], 0, FIRST_SAMPLES, 3, 1)
    samples = int(FIRST_SAMPLES * limit_s / (time.process_time() - begun)) // 16 * 16
    begun = time.process_time()
    mean, variance = render_batches(scenes[0], 0, max(samples, 64), 3 + seed)
    seconds = time.process_time() - begun
    return mean[y, x], variance[y, x], seconds, highlight[y, x] > MAX_HIGHLIGHT * mean[y, x]


def main() -> None:
    """Measure, and write rows after each case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lights", default="54,8")
    parser.add_argument("--roughness", default="0.3,0.15,0.05")
    parser.add_argument("--samples", type=int, default=256)
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--stock-seconds", type=float, default=0.0, help="processor time for each of stock's lights")
    parser.add_argument("--seed", type=int, default=1, help="of the comparison with stock")
    parser.add_argument("--json", type=Path, required=True)
    options = parser.parse_args()
    rows: list[Row] = []
    for lights in map(int, options.lights.split(",")):
        for roughness in map(float, options.roughness.split(",")):
            if options.stock_seconds:
                found = against_stock(
                    lights, roughness, samples=options.samples, stock_seconds=options.stock_seconds, seed=options.seed
                )
            else:
                found = against_walks(lights, roughness, samples=options.samples, pairs=options.pairs)
            for row in found:
                rows.append(row)
                print(row, flush=True)
                options.json.write_text(json.dumps([asdict(one) for one in rows], indent=1))


if __name__ == "__main__":
    main()
