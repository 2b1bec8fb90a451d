"""Scene that the transport benchmarks share: a procedural incisor under the lights of a dome, for this engine and for
stock Mitsuba.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.anatomy.dentin_shape import DentinShape
from services.anatomy.templates.incisor import build_incisor
from services.core.files.meshes import write_mesh
from services.core.geometry import Camera, Mesh
from services.phantom.dome_rig import dome_cameras, dome_lights
from services.transport.engine import Engine
from services.transport.optics.parameters import Medium, Tissue
from services.transport.scene.recipe import SceneRecipe, View, single_tooth

TISSUE = Tissue(Medium(4.5, 0.997, 0.93, 0.82, -0.1), Medium(12.0, 0.9945, 1.0, 0.75))
PIXEL_MM = 0.5


@dataclass(frozen=True)
class IncisorStack:
    """A tooth, one camera and L point lights."""

    outer: Mesh
    dentin: Mesh
    camera: Camera
    light_positions_mm: NDArray[np.float64]
    """Positions of the lights (L, 3)."""
    light_intensities: NDArray[np.float64]
    """Radiant intensities of the lights (L,)."""

    def recipe(self, dentin: DentinShape | None = None) -> SceneRecipe:
        """Return the scene for this engine, by default with the tooth's own dentin; its faces do not reflect."""
        known = DentinShape.known(self.dentin)
        return single_tooth(self.outer, dentin or known, self.light_positions_mm, self.light_intensities)

    def tooth_view(self, engine: Engine, tissue: Tissue) -> View:
        """Return the pixels that show the tooth under at least one light."""
        width, height = self.camera.size
        y, x = np.mgrid[0:height, 0:width]
        everything = View(self.camera, np.stack([x.ravel(), y.ravel()], axis=1).astype(np.int32))
        is_lit = engine.images(tissue, everything, samples=16, seed=99).mean.sum(axis=0) > 0
        return View(self.camera, everything.pixels[is_lit])

    def some_lights(self, count: int) -> NDArray[np.int64]:
        """Return the indices of some lights, for a peer that is too slow for all of them."""
        return np.linspace(0, len(self.light_positions_mm) - 1, count).astype(np.int64)

    def stock_scene(self, folder: Path, tissue: Tissue, light: int, samples: int = 16) -> Any:
        """Return the scene under one light for stock Mitsuba; its meshes are written into ``folder``."""
        from services.assets.mitsuba.scene import load_scene, nested_scene

        files = folder / "outer.ply", folder / "dentin.ply"
        if not files[1].exists():
            write_mesh(files[0], self.outer)
            write_mesh(files[1], self.dentin)
        where, intensity = self.light_positions_mm[light], float(self.light_intensities[light])
        return load_scene(
            nested_scene(
                {"tooth": files}, tissue, (self.camera,), where, intensity, boundary="matched", ior=1.0, samples=samples
            )
        )


def incisor_stack(lights: int) -> IncisorStack:
    """Return the tooth under so many lights of a dome, which are equal in every run."""
    incisor = build_incisor()
    (camera,) = dome_cameras(1, PIXEL_MM, (incisor.outer,))
    rig = dome_lights(lights, ("green",), seed=1)
    positions, intensities = (
        np.array([light.position_mm for light in rig]),
        np.array([light.intensity[0] for light in rig]),
    )
    return IncisorStack(incisor.outer, incisor.dentin, camera, positions, intensities)
