"""Benchmark that features a scene does not use cost nothing: each feature switched off, against a scene without it and
against the feature switched on.

Every case compares three calls: ``off``, where the feature exists but is not used; ``without``, where it does not
exist; and ``on``. Operations are those of a call's largest kernel, by Dr.Jit's kernel history. Times are medians over
interleaved pairs of ``off`` and ``without`` with equal seeds, each of which goes first in every other pair; all kernels
are compiled before.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from services.anatomy.blend import dentin_blend_shape
from services.anatomy.dentin_shape import DentinShape
from services.anatomy.templates.incisor import build_incisor
from services.bench import Row
from services.core.geometry import Camera, Mesh
from services.phantom.dome_rig import dome_cameras, dome_lights
from services.transport.engine import Engine
from services.transport.optics.parameters import Medium, Stain, Tissue
from services.transport.optics.phase_table import PhaseTable
from services.transport.scene.recipe import View, single_tooth

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAIRS = 30
LIGHTS, FEW_LIGHTS = 18, (2, 7, 11)
PIXEL_MM = 0.5
ONE_LOBE = Medium(4.5, 0.99, 1.0, 0.75)
TWO_LOBES = replace(ONE_LOBE, beta=0.9, g2=-0.3)
TABLE = PhaseTable((0.0, 0.5, 1.5, np.pi), (10.0, 3.0, 0.5, 0.3))
TISSUE = Tissue(ONE_LOBE, replace(ONE_LOBE, sigma=9.0), (0.5, 0.3, 0.4))
ORDER_EDGES = np.array([0, 4, 16, 1 << 20])

Call = Callable[[int, int], Any]
"""Function (samples, seed) -> estimate, with the same number of batches in every call."""


class SkipRow(Row):
    """A row with the size of its kernel and, in a peer's summary row, the comparison."""

    operations: int
    """Number of operations of the largest kernel."""
    time_ratio: float | None = None
    """Median over the pairs of the time with the feature off, divided by the time without it."""
    operations_on: int | None = None
    """Number of operations of the largest kernel with the feature on."""
    seconds_on: float | None = None
    """Time with the feature on."""


@dataclass(frozen=True)
class Case:
    """One feature and its three calls."""

    name: str
    off: Call
    without: Call
    on: Call


def run(*, quick: bool) -> list[dict[str, Any]]:
    """Return for each feature a row of this engine with the feature off, a row of the peer without it, and the peer's
    summary row.
    """
    samples = 32 if quick else 128
    return [row.model_dump() for case in cases() for row in _compare(case, samples)]


def cases() -> list[Case]:
    """Return a case for every feature for which kernels are specialised, on a procedural incisor."""
    from services.bench.transport.plain_walk import PlainEngine

    incisor = build_incisor()
    rig = dome_lights(LIGHTS, ("green",), seed=1)
    positions, intensities = (
        np.array([light.position_mm for light in rig]),
        np.array([light.intensity[0] for light in rig]),
    )
    homogeneous = single_tooth(incisor.outer, None, positions, intensities)
    few = replace(
        homogeneous, light_positions_mm=positions[list(FEW_LIGHTS)], light_intensities=intensities[list(FEW_LIGHTS)]
    )
    dentin = dentin_blend_shape(incisor.outer)
    modelled = Mesh(dentin.vertices_mm(TISSUE.shape), dentin.base.faces)
    plain, unable = Engine(homogeneous), PlainEngine(homogeneous)
    (tooth,), coordinates = homogeneous.teeth, np.zeros((len(incisor.outer.faces), 3, 2))
    stainable = Engine(replace(homogeneous, teeth=(replace(tooth, stain_uv=coordinates),)))
    stained = replace(TISSUE, shape=(), stain=Stain(np.full((4, 4), 0.8)))
    blend = Engine(single_tooth(incisor.outer, dentin, positions, intensities))
    known = Engine(
        single_tooth(
            incisor.outer, DentinShape(modelled, np.zeros((0, *modelled.vertices_mm.shape))), positions, intensities
        )
    )
    camera = dome_cameras(1, PIXEL_MM, (incisor.outer,))[0]
    every_pixel, (crop, cropped_camera) = _view(camera), _crop(camera)
    one, unused, tabulated, ready, two, layered = (
        replace(TISSUE, shape=()),
        Tissue(ONE_LOBE, TWO_LOBES),
        Tissue(ONE_LOBE, replace(ONE_LOBE, table=TABLE)),
        Tissue(replace(ONE_LOBE, g2=-0.3), ONE_LOBE),
        Tissue(TWO_LOBES, ONE_LOBE),
        TISSUE,
    )

    def images(engine: Engine, tissue: Tissue = one, view: View = every_pixel) -> Call:
        return lambda samples, seed: engine.images(tissue, view, samples=samples, seed=seed)

    def jacobian(engine: Engine, tissue: Tissue, *names: str) -> Call:
        return lambda samples, seed: engine.jacobian(tissue, every_pixel, names, samples=samples, seed=seed, batches=16)

    def orders(samples: int, seed: int) -> NDArray[np.float64]:
        return plain.order_images(one, every_pixel, bin_edges=ORDER_EDGES, samples=samples, seed=seed, batches=16)

    bare = images(unable)
    return [
        Case("scores", jacobian(plain, one), bare, jacobian(plain, one, "enamel.sigma", "enamel.alpha", "enamel.g1")),
        Case("shape", images(blend, layered), images(known), jacobian(blend, layered, "shape.0")),
        Case("dentin", images(plain, unused), bare, images(known)),
        Case("second lobe", images(plain, ready), bare, images(plain, two)),
        Case("phase table", images(plain, tabulated), bare, images(plain, Tissue(tabulated.dentin, ONE_LOBE))),
        Case(
            "thin faces",
            images(Engine(replace(homogeneous, boundary="thin", ior=1.0))),
            bare,
            images(Engine(replace(homogeneous, boundary="thin"))),
        ),
        Case("stains", images(stainable), bare, images(stainable, stained)),
        Case("order bins", images(plain), bare, orders),
        Case(
            "unseen lights",
            images(plain, view=replace(every_pixel, lights=FEW_LIGHTS)),
            images(Engine(few)),
            images(plain),
        ),
        Case("masked pixels", images(plain, view=crop), images(plain, view=_view(cropped_camera)), images(plain)),
    ]


def kernel_operations(call: Call, samples: int) -> int:
    """Return the number of operations of the largest kernel that a call launches."""
    import drjit as dr

    # Equal expressions are traced only once while the first one is alive. Collect the remains of finished traces, so
    # that they do not replace operations of this one.
    gc.collect()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        call(samples, 0)
        return max(int(kernel["operation_count"]) for kernel in dr.kernel_history([dr.KernelType.JIT]))


def _compare(case: Case, samples: int) -> list[SkipRow]:
    calls = (case.off, case.without, case.on)
    off, without, on = (kernel_operations(call, samples) for call in calls)
    seconds, estimates = np.zeros((PAIRS, 2)), []
    for pair in range(PAIRS):
        for which in (0, 1) if pair % 2 else (1, 0):
            begun = time.perf_counter()
            estimate = calls[which](samples, pair + 1)
            seconds[pair, which] = time.perf_counter() - begun
            estimates.append((which, estimate))
    begun = time.perf_counter()
    case.on(samples, 1)
    seconds_on = time.perf_counter() - begun

    # Estimate the error of one image from the mean variance of all.
    errors = [
        np.sqrt(np.mean([(e.variance.sum() / np.sum(e.mean**2)) for w, e in estimates if w == which]))
        for which in (0, 1)
    ]
    ratio = float(np.median(seconds[:, 0] / seconds[:, 1]))
    name, (ours, theirs) = f"transport-skip {case.name}", np.median(seconds, axis=0)
    peer = SkipRow(benchmark=name, peer="without", seconds=theirs, error=errors[1], operations=without)
    summary = {
        "efficiency_ratio": float(errors[1] ** 2 / errors[0] ** 2 / ratio),
        "time_ratio": ratio,
        "operations_on": on,
        "seconds_on": seconds_on,
    }
    return [
        SkipRow(benchmark=name, peer="dentine", seconds=ours, error=errors[0], operations=off),
        peer,
        peer.model_copy(update=summary),
    ]


def picture(rows: list[dict[str, Any]]) -> Figure:
    """Draw times relative to a kernel without the feature, and the kernels' operations, with the feature off and on."""
    from services.bench.plots import grid

    compared = [row for row in rows if row["time_ratio"] is not None][::-1]
    names = [row["benchmark"].removeprefix("transport-skip ") for row in compared]
    figure, (times, operations) = grid(2)
    measures = (("off", [row["time_ratio"] for row in compared], [row["operations"] for row in compared]),
                ("on", [row["seconds_on"] / row["seconds"] for row in compared],
                 [row["operations_on"] for row in compared]))  # fmt: skip
    for label, ratios, counts in measures:
        times.plot(ratios, names, "o", label=label)
        operations.plot(counts, names, "o", label=label)
    times.axvline(1.0, color="grey", linewidth=1)
    times.set(xlabel="time over that without the feature", xlim=(0, None))
    operations.set(xlabel="operations in the kernel", xlim=(0, None), yticklabels=[])
    for axes in (times, operations):
        axes.grid(alpha=0.25)
        axes.legend(fontsize=8)
    return figure


def _view(camera: Camera) -> View:
    width, height = camera.size
    y, x = np.mgrid[0:height, 0:width]
    return View(camera, np.stack([x.ravel(), y.ravel()], axis=1).astype(np.int32))


def _crop(camera: Camera) -> tuple[View, Camera]:
    """Return the middle quarter of an image, as the pixels that a mask leaves and as a camera of these pixels alone."""
    size = (camera.size[0] // 2, camera.size[1] // 2)
    corner = np.array([size[0] // 2, size[1] // 2])
    smaller = np.array(camera.K)
    smaller[:2, 2] -= corner
    whole = Camera(name=camera.name, size=size, K=smaller.tolist(), camera_from_world=camera.camera_from_world)
    return View(camera, (_view(whole).pixels + corner).astype(np.int32)), whole
