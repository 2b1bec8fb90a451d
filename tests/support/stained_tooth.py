"""The small tooth with a texture of stains on its enamel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from services.core.records import Boundary
from services.transport.optics.parameters import Stain
from services.transport.scene.recipe import SceneRecipe, ToothSurfaces
from tests.support.small_tooth import SEMI_AXES_MM, ellipsoid, recipe

HEIGHT, WIDTH = 6, 8


def texture_coordinates() -> NDArray[np.float64]:
    """Texture coordinates (V, 2) of the vertices, across and up in the front view."""
    vertices = ellipsoid(SEMI_AXES_MM).vertices_mm
    return 0.5 + 0.49 * vertices[:, [0, 2]] / SEMI_AXES_MM[[0, 2]]


def stain(seed: int = 1, low: float = 0.3, high: float = 0.8) -> Stain:
    """A stain with random transmittance in every texel."""
    return Stain(np.random.default_rng(seed).uniform(low, high, (HEIGHT, WIDTH)))


def stained_recipe(boundary: Boundary) -> SceneRecipe:
    """The small tooth's scene with texture coordinates for stains."""
    (tooth,) = recipe(boundary).teeth
    return replace(
        recipe(boundary), teeth=(ToothSurfaces(tooth.outer, tooth.dentin, texture_coordinates()[tooth.outer.faces]),)
    )
