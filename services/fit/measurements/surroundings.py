"""The surfaces of teeth around a single one, and errors of its dentin's shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from services.anatomy.dentin_shape import DentinShape
from services.anatomy.frame import ToothFrame
from services.anatomy.neighbours import with_usual_dentin
from services.anatomy.templates.dimensions import upper_tooth
from services.core.geometry import Camera, Tooth
from services.core.records import JobSpec
from services.transport.scene.recipe import ToothSurfaces


def neighbour_surfaces(
    tooth: Tooth, neighbours: Sequence[Tooth], cameras: tuple[Camera, ...], spec: JobSpec
) -> tuple[ToothSurfaces, ...]:
    """Teeth around the one that is fitted, with fixed dentin."""
    around = with_usual_dentin(tooth, neighbours, cameras, spec)
    return tuple(
        ToothSurfaces(other.outer, None if other.dentin is None else DentinShape.known(other.dentin))
        for other in around
    )


def with_shape_errors(surfaces: ToothSurfaces, shape: tuple[float, ...], frame: ToothFrame, fdi: int) -> ToothSurfaces:
    """The tooth with further blend modes: the errors of its dentin's shape at the blend weights ``shape``, and their
    opposites. ``frame`` is the tooth's canonical frame.
    """
    from services.anatomy.shape_errors import shape_errors

    assert surfaces.dentin is not None
    errors = shape_errors(surfaces.outer, surfaces.dentin, shape, frame, upper_tooth(fdi % 10))
    modes = np.concatenate([surfaces.dentin.modes_mm, errors, -errors])
    return replace(surfaces, dentin=replace(surfaces.dentin, modes_mm=modes))
