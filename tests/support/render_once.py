"""Run in a fresh process: build the small tooth's engine and send back its images and derivatives, once or more."""

from __future__ import annotations

from dataclasses import dataclass, replace
from multiprocessing.connection import Connection

import numpy as np
from numpy.typing import NDArray

from services.core.records import Boundary
from services.transport.engine import Engine
from services.transport.optics.parameters import Medium, Tissue
from tests.support.small_tooth import camera_at, whole_view
from tests.support.stained_tooth import stain, stained_recipe

NAMES = ("enamel.sigma", "dentin.alpha", "enamel.g1", "shape.0")
TISSUE = Tissue(Medium(2, 0.95, 0.8, 0.6, -0.3), Medium(3, 0.8, 0.7, 0.6, -0.3), (0.5, 0.4))


@dataclass(frozen=True)
class Picture:
    """Results of the engine for a scene and fixed seeds, for L lights and N pixels."""

    image: NDArray[np.float64]
    """Radiance (L, N)."""
    variance: NDArray[np.float64]
    jacobian: NDArray[np.float64]
    """Derivatives (F, L, N) to the F parameters ``NAMES``."""
    orders: NDArray[np.float64]
    """Radiance (K, L, N) by K bins of scattering orders."""
    shape: NDArray[np.float64]
    """Gradient (M,) of the images' sum to the dentin's shape weights."""
    texels: NDArray[np.float64]
    """Gradient of the images' sum to the texels of a stain. Threads add to common slots, so its last bits depend on
    their order."""


def plain_results(engine: Engine) -> dict[str, NDArray[np.float64]]:
    """Images, derivatives and orders of 16 x 16 pixels of a tooth, by their names in ``Picture``."""
    view = whole_view(camera_at((0.2, 1, 0.1), size=16))
    image = engine.images(TISSUE, view, samples=32, seed=5)
    jacobian = engine.jacobian(TISSUE, view, NAMES, samples=32, seed=6, batches=16)
    orders = engine.order_images(TISSUE, view, bin_edges=np.array([0, 2, 8, 64]), samples=16, seed=7, batches=16)
    return {"image": image.mean, "variance": image.variance, "jacobian": jacobian.jacobian, "orders": orders}


def picture(engine: Engine) -> Picture:
    """Render 16 x 16 pixels of a tooth that may have stains: 4,096 lanes, which Dr.Jit splits over its threads."""
    view, plain = whole_view(camera_at((0.2, 1, 0.1), size=16)), plain_results(engine)
    ones = np.ones(plain["image"].shape)
    shape = engine.shape_gradient(TISSUE, view, ones, samples=32, seed=8).gradient
    (texels,) = engine.stain_gradient(replace(TISSUE, stain=stain()), view, ones, samples=32, seed=9).gradient
    assert texels is not None
    return Picture(**plain, shape=shape, texels=texels)


def render_into(connection: Connection, boundary: Boundary, thread_counts: tuple[int, ...]) -> None:
    """Send the numbers of Dr.Jit's threads that were used, and the ``picture`` of an engine with each number.

    The first engine sets the number, and later engines of a process leave it as it is.
    """
    import drjit as dr

    used, results = [], []
    for number, threads in enumerate(thread_counts):
        engine = Engine(stained_recipe(boundary), threads)
        if number > 0:
            dr.set_thread_count(threads)
        used.append(dr.thread_count())
        results.append(picture(engine))
    connection.send((tuple(used), results))
    connection.close()
