"""The engine's door: one built scene, images and Jacobians on demand."""

from __future__ import annotations

from services.fit.optics.parameters import Tissue
from services.fit.transport.recipe import JacobianEstimate, SceneRecipe, StackEstimate, View


class Engine:
    """A scene built once per process; parameters and dentin shape change per call without rebuilding it."""

    def __init__(self, recipe: SceneRecipe, threads: int | None = None) -> None:
        """Build the scene. Selects the variant and thread count if none is set yet.

        Raises:
            PlatformError: no usable libLLVM. MeshError: a surface cannot bound a medium.
        """
        raise AttributeError

    def images(self, tissue: Tissue, view: View, *, samples: int, seed: int, batches: int = 16) -> StackEstimate:
        """Images under all lights. ``samples`` paths per pixel in ``batches`` independent batches; seeded by (seed, pixel, sample) alone."""
        raise AttributeError

    def jacobian(self, tissue: Tissue, view: View, names: tuple[str, ...], *, samples: int, seed: int, batches: int = 4) -> JacobianEstimate:
        """Images and derivatives to the natural parameters ``names`` (see Tissue), both boundary terms included for ``shape.k``."""
        raise AttributeError
