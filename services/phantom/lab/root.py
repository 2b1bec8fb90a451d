"""The whole root of a virtual laboratory's tooth: a phantom has a stub of it, as its gums hide the rest.

The engine renders the measured tooth alone, so light reaches what gums would cover. Through the end of a stub 4 mm
above the neck, lights from above brightened or darkened the lower crown by 5 to 20 % against a root of its kind's
length, which is what a registered scan's tooth has.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.anatomy.templates.crown import ROOT_STUB_MM, ROOT_TAPER
from services.anatomy.templates.dimensions import root_length_mm
from services.anatomy.templates.jaw import JawTooth
from services.core.geometry import Mesh, Tooth

Floats = NDArray[np.float64]
TAPER = 0.4
"""Width of the root's end to that at the cervical line."""


def with_whole_root(tooth: JawTooth) -> Tooth:
    """An upper tooth of a phantom, its stub stretched to the average length of its kind's root, enamel and dentin by
    the same map.
    """
    outer, dentin = (Mesh(_stretched(tooth, mesh.vertices_mm), mesh.faces) for mesh in (tooth.outer, tooth.dentin))
    return Tooth(tooth.fdi, outer, dentin)


def _stretched(tooth: JawTooth, points_mm: Floats) -> Floats:
    own = tooth.frame.canonical_from_world(points_mm)
    depth = np.maximum(tooth.cervix_mm - own[:, 2], 0.0) / ROOT_STUB_MM
    longer = root_length_mm(tooth.fdi % 10, is_upper=True) - ROOT_STUB_MM
    narrower = 1 + (TAPER / ROOT_TAPER - 1) * depth
    # Evenly from the cervical line on, so that surfaces that lie in one another still do.
    moved = np.stack([own[:, 0] * narrower, own[:, 1] * narrower, own[:, 2] - longer * depth], axis=1)
    return tooth.frame.world_from_canonical(moved)
