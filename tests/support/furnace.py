"""A furnace as a camera sees it: the weight with which walks through media that absorb nothing leave for good."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from services.transport.optics.parameters import Medium
from services.transport.platform import prepare_device
from services.transport.scene.recipe import SceneRecipe, View


def escaping_weights(recipe: SceneRecipe, media: Sequence[Medium], view: View, paths: int = 256) -> NDArray[np.float64]:
    """Mean weight (N,) of the walks of each pixel and row of the tally, where they leave a scene of rough surfaces."""
    prepare_device()
    import mitsuba as mi

    from services.transport.boundary.models import mesh_boundary
    from services.transport.paths.rows import Rows
    from services.transport.paths.scores import Plan
    from services.transport.paths.starts import CameraStart
    from services.transport.paths.tally import Tally
    from services.transport.paths.walk import Walk
    from services.transport.paths.walker import Flight, Walker
    from services.transport.scene.media import Media
    from services.transport.scene.mesh_geometry import MeshGeometry

    class Furnace(Walk):
        """Walks that count their weight where they leave for good."""

        def _step(self, walker: Walker, tally: Tally, rows: Rows) -> Walker:
            self.tally = tally
            return super()._step(walker, tally, rows)

        def _end(self, walker: Walker, flight: Flight) -> mi.Bool:
            gone = walker.active & ~flight.scatters & ~flight.meets
            self.tally.add(walker.row, mi.UInt32(0), self._throughput(walker), gone)
            return super()._end(walker, flight)

    radius_mm = float(np.linalg.norm(recipe.vertices_mm(), axis=1).max())
    start = CameraStart(view, 4, seed=7, radius_mm=radius_mm)
    boundary = mesh_boundary(
        "rough", recipe.ior, roughness=recipe.roughness, compensated=recipe.multiple_scattering,
        gums_ior=None if recipe.gums is None else recipe.gums_ior,
    )  # fmt: skip
    sums, _ = Furnace(MeshGeometry(recipe), Media(list(media)), None, start, Plan(), boundary).run(paths).arrays()
    return np.asarray(sums[:, 0] / paths)
