"""The whole root of a virtual laboratory's tooth, in place of the stub that a phantom has because gums hide the rest.

The engine renders the measured tooth without gums, so light also reaches the root. With the end of a stub 4 mm above
the neck, lights from above made the lower crown brighter or darker by 5 to 20 % than with a root of average length,
which the tooth of a registered scan has.
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
"""Ratio of the root's width at its end to that at the cervical line."""


def with_whole_root(tooth: JawTooth) -> Tooth:
    """Stretch the root stub of a phantom's upper tooth to the average root length of its kind.

    The same map is applied to enamel and dentin.
    """
    outer, dentin = (Mesh(_stretched(tooth, mesh.vertices_mm), mesh.faces) for mesh in (tooth.outer, tooth.dentin))
    return Tooth(tooth.fdi, outer, dentin)


def _stretched(tooth: JawTooth, points_mm: Floats) -> Floats:
    own = tooth.frame.canonical_from_world(points_mm)
    depth = np.maximum(tooth.cervix_mm - own[:, 2], 0.0) / ROOT_STUB_MM
    longer = root_length_mm(tooth.fdi % 10, is_upper=True) - ROOT_STUB_MM
    narrower = 1 + (TAPER / ROOT_TAPER - 1) * depth
    # Move points in proportion to their depth below the cervical line, so that nested surfaces stay nested.
    moved = np.stack([own[:, 0] * narrower, own[:, 1] * narrower, own[:, 2] - longer * depth], axis=1)
    return tooth.frame.world_from_canonical(moved)
