"""Gradients of a ball with a rough surface: this engine beside the integrator ``prb_path_volume`` of Weier et al.,
Practical inverse rendering of textured and translucent appearance (2025), and stock ``prbvolpath`` as a second opinion.

git clone https://github.com/google/practical-inverse-rendering-of-textured-and-translucent-appearance FOLDER
python -m tests.benchmarks.rough_gradient_peer --peer FOLDER --json rough_gradient.json

The gradient is that of 1/2 sum (C - reference)^2 with respect to the medium's sigma, alpha and g, for images of each
light alone or of all lights together. The residual C - reference comes from long renders of this engine and is the same
for all, so that only the derivatives are noisy. Efficiency is 1 / (variance x processor time); variances come from
independent calls. Each round calls all three methods, one after the other, each with one thread; a ratio is the median
over rounds, given with its range.

The peer runs unchanged with this project's Mitsuba. Its albedo is that of single scattering, its parameters are
textures at the point of entry (constant ones here), and its limits of depth, by default 2 surfaces and 256 scatterings,
are lifted, for they would bias it. Its roulette starts as late as that of stock Mitsuba, and it is not guided; both
suited it best in short trials. It does not run in one channel, and so it has three, in a process of its own.
"""

from __future__ import annotations

import argparse
import importlib
import json
import multiprocessing
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
import trimesh
from numpy.typing import NDArray

from services.assets.mitsuba.scene import MAX_DEPTH, ROULETTE_DEPTH, boundary_dict, load_scene, nested_scene
from services.bench.transport.gradient_rows import Estimate, of_parts
from services.core.files.meshes import write_mesh
from services.core.geometry import Mesh
from services.phantom.dome_rig import dome_cameras, dome_lights
from services.transport.engine import Engine
from services.transport.optics.parameters import Medium, Tissue
from services.transport.platform import prepare_device
from services.transport.scene.recipe import SceneRecipe, View, single_tooth

Array = NDArray[np.float64]
Other = Literal["peer", "stock"]

IOR, RADIUS_MM, PIXEL_MM = 1.63, 2.0, 0.25
NONE = Medium(1.0, 0.5)
"""The ball has no dentin."""
TISSUE = Tissue(Medium(6.0, 0.9965, g1=0.80), NONE)
OTHER_TISSUE = Tissue(Medium(5.0, 0.9955, g1=0.82), NONE)
"""Medium of the reference images."""
NAMES = ("enamel.sigma", "enamel.alpha", "enamel.g1")
KEYS: dict[Other, tuple[str, ...]] = {
    "peer": tuple(
        f"outer_ball.bsdf.{leaf}.value"
        for leaf in ("extinction_coefficient", "single_scattering_albedo", "hg_coefficient")
    ),
    "stock": tuple(
        f"medium_enamel.{leaf}" for leaf in ("sigma_t.value.value", "albedo.value.value", "phase_function.g")
    ),
}
RESIDUAL_SAMPLES = 1024
OUR_CALLS = 4
"""Calls of this engine in a round. Its pixels have independent random numbers, so that few calls tell its variance."""


@dataclass(frozen=True)
class Case:
    """One comparison."""

    lights: int
    together: bool
    """Whether all lights are on in one image, else each has its own."""
    roughness: float


@dataclass(frozen=True)
class Row:
    """This engine against one other method in one case; tuples are in the order of ``NAMES``."""

    case: Case
    against: Other
    seconds: tuple[float, float]
    """Processor time of one gradient of this engine and of the other."""
    errors: tuple[tuple[float, ...], tuple[float, ...]]
    """Standard deviation of one gradient over its size."""
    gradient: tuple[float, ...]
    z: tuple[float, ...]
    """The other's gradient minus this engine's, in standard errors."""
    ratio: tuple[float, ...]
    """This engine's efficiency over the other's, the median over rounds."""
    lowest: tuple[float, ...]
    highest: tuple[float, ...]
    mean_ratio: tuple[float, float, float]
    """Lowest, median and highest geometric mean over the parameters."""


def ball() -> Mesh:
    """Flat triangles, the same for all."""
    found = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS_MM)
    return Mesh(np.asarray(found.vertices), np.asarray(found.faces, dtype=np.int32))


def lamps(lights: int) -> tuple[Array, Array]:
    """Positions (L, 3) in mm and intensities (L,)."""
    rig = dome_lights(lights, ("green",), seed=1)
    return np.array([light.position_mm for light in rig]), np.array([light.intensity[0] for light in rig])


def recipe(case: Case) -> SceneRecipe:
    """The scene for this engine, without compensation, which the others lack."""
    parts = single_tooth(ball(), None, *lamps(case.lights), "rough", IOR)
    return replace(parts, roughness=case.roughness, multiple_scattering=False)


class Backward:
    """One backward pass of a Mitsuba integrator under each light, or under all together."""

    def __init__(self, case: Case, other: Other, pixels: NDArray[np.int32]) -> None:
        import drjit as dr
        import mitsuba as mi

        where, strength = lamps(case.lights)
        (camera,) = dome_cameras(1, PIXEL_MM, (ball(),))
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "ball.ply"
            write_mesh(file, ball())
            scenes = [
                nested_scene(
                    {"ball": (file, None)}, TISSUE, (camera,), position, float(intensity), boundary="rough", ior=IOR,
                    roughness=case.roughness,
                )
                for position, intensity in zip(where.tolist(), strength, strict=True)
            ]  # fmt: skip
            if case.together:
                scenes = [scenes[0] | {f"light_{n}": one["light"] for n, one in enumerate(scenes[1:])}]
            if other == "peer":
                scenes = [_for_peer(one, case) for one in scenes]
            self._scenes = [load_scene(one) for one in scenes]
        self._params = [mi.traverse(one) for one in self._scenes]
        self._keys, self._size, (self._x, self._y) = KEYS[other], camera.size, pixels.T
        for params, key in product(self._params, self._keys):
            dr.enable_grad(params[key])

    def __call__(self, residual: Array, *, samples: int, seed: int) -> tuple[Array, float]:
        """Gradient (F, images), and the processor time.

        Args:
            residual: weights (images, N) of the pixels.
            samples: paths per pixel.
            seed: of the first image; the others have the next ones.
        """
        begun = time.process_time()
        pairs = zip(self._scenes, self._params, residual, strict=True)
        parts = [self._one(*pair, samples, seed * len(residual) + n) for n, pair in enumerate(pairs)]
        return np.array(parts).T, time.process_time() - begun

    def _one(self, scene: Any, params: Any, residual: Array, samples: int, seed: int) -> list[float]:
        import drjit as dr
        import mitsuba as mi

        weights = np.zeros((*self._size[::-1], 1), dtype=np.float32)
        weights[self._y, self._x, 0] = residual
        for key in self._keys:
            dr.set_grad(params[key], 0)
        scene.integrator().render_backward(scene, params, mi.TensorXf(weights), seed=seed, spp=samples)
        return [float(np.sum(np.array(dr.grad(params[key])))) for key in self._keys]


def _for_peer(scene: dict[str, Any], case: Case) -> dict[str, Any]:
    """The scene with the medium in the surface's BSDF."""

    def constant(value: float) -> dict[str, Any]:
        return {"type": "srgb", "color": [value] * 3, "unbounded": True}

    medium = TISSUE.enamel
    bsdf = {
        "type": "sss_bsdf",
        "nested_bsdf": boundary_dict("rough", IOR, roughness=case.roughness),
        "single_scattering_albedo": constant(medium.alpha),
        "extinction_coefficient": constant(medium.sigma),
        "hg_coefficient": constant(medium.g1),
    }
    shape = {key: value for key, value in scene["outer_ball"].items() if key != "interior"} | {"bsdf": bsdf}
    integrator = {
        "type": "prb_path_volume",
        "max_path_depth": MAX_DEPTH,
        "max_sss_depth": MAX_DEPTH,
        "rr_depth": ROULETTE_DEPTH,
        "sss_rr_depth": ROULETTE_DEPTH,
    }
    kept = {key: value for key, value in scene.items() if key != "medium_enamel"}
    return kept | {"outer_ball": shape, "integrator": integrator}


def start_peer(folder: Path) -> None:
    """Make the peer's plug-ins known to the process, which runs them alone."""
    prepare_device(1, colours="rgb")
    sys.path.insert(0, str(folder / "python"))
    for plug_ins in ("core.integrators", "core.bsdfs"):
        importlib.import_module(plug_ins).register()


@cache
def _built(case: Case, other: Other, pixels: bytes) -> Backward:
    return Backward(case, other, np.frombuffer(pixels, dtype=np.int32).reshape(-1, 2))


def backward(case: Case, other: Other, view: View, residual: Array, samples: int, seed: int) -> tuple[Array, float]:
    """One gradient, in any process; its scene is built once."""
    return _built(case, other, view.pixels.tobytes())(residual, samples=samples, seed=seed)


def compare(case: Case, peer: ProcessPoolExecutor, options: argparse.Namespace) -> list[Row]:
    """Rows against the peer and against stock Mitsuba."""
    engine = Engine(recipe(case), 1)
    (camera,) = dome_cameras(1, PIXEL_MM, (ball(),))
    y, x = np.mgrid[0 : camera.size[1], 0 : camera.size[0]]
    everything = View(camera, np.stack([x.ravel(), y.ravel()], axis=1).astype(np.int32))
    seen = engine.images(TISSUE, everything, samples=16, seed=99).mean.sum(axis=0) > 0
    view = View(camera, everything.pixels[seen])
    here, there = (
        engine.images(tissue, view, samples=RESIDUAL_SAMPLES, seed=98).mean for tissue in (TISSUE, OTHER_TISSUE)
    )
    residual = (here - there).sum(axis=0, keepdims=True) if case.together else here - there

    def ours(seed: int) -> tuple[Array, float]:
        begun = time.process_time()
        found = engine.jacobian(TISSUE, view, NAMES, samples=options.samples, seed=seed, batches=1).jacobian
        # With one residual for all lights this is the sum over lights of the derivatives times that residual.
        return (found * residual).sum(axis=1), time.process_time() - begun

    def theirs(seed: int) -> tuple[Array, float]:
        return peer.submit(backward, case, "peer", view, residual, options.peer_samples, seed).result()

    def stock(seed: int) -> tuple[Array, float]:
        return backward(case, "stock", view, residual, options.peer_samples, seed)

    calls = options.calls // len(residual)
    methods = ((ours, OUR_CALLS), (theirs, max(calls, 2)), (stock, max(calls // 2, 2)))
    for call, _ in methods:
        call(0)  # compile
    rounds: list[tuple[Estimate, ...]] = []
    for turn in range(options.rounds):
        found = {}
        for which in np.roll(range(3), turn).tolist():
            call, count = methods[which]
            parts, seconds = zip(*(call(1 + turn * count + n) for n in range(count)), strict=True)
            found[which] = of_parts(np.stack(parts), float(np.mean(seconds)))
        rounds.append(tuple(found[which] for which in range(3)))
    mine, *rest = zip(*rounds, strict=True)
    return [_row(case, against, mine, one) for against, one in zip(("peer", "stock"), rest, strict=True)]


def _row(case: Case, against: Any, ours: tuple[Estimate, ...], theirs: tuple[Estimate, ...]) -> Row:
    gradient, known = (np.mean([one.mean for one in all_], axis=0) for all_ in (theirs, ours))
    of_mean = sum(one.mean_variance for one in (*ours, *theirs)) / len(ours) ** 2
    z = (gradient - known) / np.sqrt(of_mean)
    ratios = np.array(
        [b.variance * b.seconds / (a.variance * a.seconds) for a, b in zip(ours, theirs, strict=True)]
    )  # (rounds, F)
    means = np.exp(np.log(ratios).mean(axis=1))
    noise = [np.sqrt(np.mean([one.variance for one in all_], axis=0)) / np.abs(known) for all_ in (ours, theirs)]
    times = [float(np.median([one.seconds for one in all_])) for all_ in (ours, theirs)]
    return Row(
        case, against, (times[0], times[1]), (tuple(noise[0].tolist()), tuple(noise[1].tolist())),
        tuple(known.tolist()), tuple(z.tolist()), tuple(np.median(ratios, axis=0).tolist()),
        tuple(ratios.min(axis=0).tolist()), tuple(ratios.max(axis=0).tolist()),
        (float(means.min()), float(np.median(means)), float(means.max())),
    )  # fmt: skip


def main() -> None:
    """Measure, and write rows after each case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peer", type=Path, required=True, help="checkout of the peer's repository")
    parser.add_argument("--lights", default="1,8")
    parser.add_argument("--roughness", default="0.3,0.15")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--calls", type=int, default=20, help="the peer's backward passes in a round, of all images")
    parser.add_argument("--samples", type=int, default=512)
    parser.add_argument("--peer-samples", type=int, default=64)
    parser.add_argument("--json", type=Path, required=True)
    options = parser.parse_args()
    prepare_device(1)
    rows: list[Row] = []
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawn, initializer=start_peer, initargs=(options.peer,)) as peer:
        for lights, roughness in product(map(int, options.lights.split(",")), map(float, options.roughness.split(","))):
            for together in (False, True) if lights > 1 else (False,):
                for row in compare(Case(lights, together, roughness), peer, options):
                    rows.append(row)
                    print(row, flush=True)
                    options.json.write_text(json.dumps([asdict(one) for one in rows], indent=1))


if __name__ == "__main__":
    main()
