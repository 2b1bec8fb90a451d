"""The fake engine for a whole mouth: every pixel shows the tooth or the gums at its centre, plus light from the mouth's
wall.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.transport.optics.parameters import Mouth, Tissue
from services.transport.rays import RayScene, pixel_rays
from services.transport.scene.recipe import SceneRecipe, View
from tests.support.fake_engine import NOISE, FakeEngine, Slowly

Array = NDArray[np.float64]


class FakeMouthEngine(FakeEngine):
    """Fake engine for a mouth; for a single tooth it gives the same images as ``FakeEngine``."""

    def __init__(self, recipe: SceneRecipe, threads: int | None = None) -> None:
        super().__init__(recipe, threads)
        self._rays: RayScene | None = None
        self._labels: dict[str, NDArray[np.int64]] = {}

    def _formula(self, tissue: Tissue | Mouth, view: View) -> Array:
        if isinstance(tissue, Tissue):
            return super()._formula(tissue, view)
        shown = self._shown(view)
        by_tooth = np.stack([super(FakeMouthEngine, self)._formula(tooth, view) for tooth in tissue.teeth])
        image = np.take_along_axis(
            by_tooth, np.broadcast_to(np.minimum(shown, len(by_tooth) - 1), by_tooth.shape[1:])[None], axis=0
        )[0]
        gums = (
            0.05
            if tissue.gums is None
            else tissue.gums.alpha_reduced**1.5
            * (1 - np.exp(-tissue.gums.sigma_s_reduced * (0.3 + view.pixels[:, 0] / 40)))
        )
        wall = 0.1 * (tissue.reflectance or 0.0) * np.cos(view.pixels[:, 1] / 9.0) ** 2
        return np.asarray(np.where(shown < len(by_tooth), image, gums) + wall)

    def _shown(self, view: View) -> NDArray[np.int64]:
        # Index of the tooth that a pixel shows, or the number of teeth where it shows anything else.
        if self._rays is None:
            assert self.recipe.gums is not None
            self._rays = RayScene(*(tooth.outer for tooth in self.recipe.teeth), self.recipe.gums)
        if view.camera.name not in self._labels:
            self._labels[view.camera.name] = self._rays.first_hits(*pixel_rays(view.camera)).mesh
        mesh = self._labels[view.camera.name][view.pixels[:, 0] + view.camera.size[0] * view.pixels[:, 1]]
        return np.where((mesh < 0) | (mesh >= len(self.recipe.teeth)), len(self.recipe.teeth), mesh)


class SlowFakeMouthEngine(Slowly, FakeMouthEngine):
    """The fake engine for a mouth with longer passes."""


class QuietFakeMouthEngine(FakeMouthEngine):
    """A fake engine for a mouth with a hundredth of the variance, so that the errors of photographs and calibration
    dominate.
    """

    path_noise = 0.1 * NOISE
