"""Dentin as a blend shape made from the enamel's outer surface (teeth 2018 Eq. 5, Fig. 4)."""

from __future__ import annotations

from services.core.geometry import Mesh
from services.fit.anatomy.frame import ToothFrame
from services.fit.transport.recipe import DentinShape

MODES = ("buccal", "proximal", "occlusal")
"""Order of the blend weights c."""


def dentin_blend_shape(outer: Mesh, frame: ToothFrame | None = None, *, faces: int = 4000) -> DentinShape:
    """Base 0.1 mm below the enamel's surface and three modes towards 1.5 mm depth, in the coordinates of ``outer``.

    Args:
        outer: watertight enamel surface, mm.
        frame: the tooth's canonical frame; None when ``outer`` is in it.
        faces: the dentin surface is decimated to about so many triangles.

    Raises:
        MeshError: the mesh cannot bound a medium, or is too thin for any dentin.
    """
    raise NotImplementedError
