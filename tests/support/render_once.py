"""Run in a fresh process: build the small tooth's engine and print a digest of its image and derivatives, with their values."""

from __future__ import annotations

from multiprocessing.connection import Connection

import numpy as np
from numpy.typing import NDArray

from services.fit.optics.parameters import Medium, Tissue
from services.fit.transport.engine import Engine
from tests.support.small_tooth import camera_at, recipe, whole_view

NAMES = ("enamel.sigma", "dentin.alpha", "enamel.g1", "shape.0")
TISSUE = Tissue(Medium(2, 0.95, 0.8, 0.6, -0.3), Medium(3, 0.8, 0.7, 0.6, -0.3), (0.5, 0.4))


def picture(engine: Engine) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Image (L, N) and derivatives (F, L, N) of a fixed seed."""
    view = whole_view(camera_at((0.2, 1, 0.1)))
    image = engine.images(TISSUE, view, samples=64, seed=5).mean
    return image, engine.jacobian(TISSUE, view, NAMES, samples=64, seed=6).jacobian


def render_into(connection: Connection, threads: int) -> None:
    """Send ``picture`` of an engine with this many threads."""
    connection.send(picture(Engine(recipe("thin"), threads)))
    connection.close()
