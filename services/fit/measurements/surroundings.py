"""Dentin surfaces of a capture's teeth, and the teeth that surround a single one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from services.anatomy.dentin_shape import DentinShape
from services.anatomy.frame import ToothFrame
from services.anatomy.job_dentin import jaw_dentins
from services.anatomy.templates.dimensions import upper_tooth
from services.core.files.meshes import read_teeth
from services.core.geometry import Camera, Mesh, Tooth
from services.core.records import JobSpec
from services.fit.coordinates.priors import SHAPE
from services.transport.scene.recipe import ToothSurfaces

MAX_NEIGHBOURS = 6
"""Largest number of teeth that are rendered around a single one: three to either side of a tooth in the middle."""


def read_neighbours(folder: Path, tooth: Tooth) -> tuple[Tooth, ...]:
    """Other teeth of a prepared capture that are rendered around one of them, the nearest first."""
    centre_mm = tooth.outer.vertices_mm.mean(axis=0)
    others = [other for other in read_teeth(folder) if other.fdi != tooth.fdi]
    others.sort(key=lambda other: float(np.linalg.norm(other.outer.vertices_mm.mean(axis=0) - centre_mm)))
    return tuple(others[:MAX_NEIGHBOURS])


def neighbour_surfaces(
    tooth: Tooth, neighbours: Sequence[Tooth], cameras: tuple[Camera, ...], spec: JobSpec
) -> tuple[ToothSurfaces, ...]:
    """Teeth around the one that is fitted. A blend shape of their dentin stays at the mean of its weights' prior."""

    def at_rest(dentin: DentinShape | None) -> DentinShape | None:
        if dentin is None:
            return None
        weights = (SHAPE[0],) * len(dentin.modes_mm)
        return DentinShape.known(Mesh(dentin.vertices_mm(weights), dentin.base.faces))

    # All together tell where the arch lies, and with it the axes of the blend shapes.
    dentins = jaw_dentins((tooth, *neighbours), cameras, spec)[1:] if neighbours else []
    return tuple(ToothSurfaces(other.outer, at_rest(dentin)) for other, dentin in zip(neighbours, dentins, strict=True))


def with_shape_errors(surfaces: ToothSurfaces, shape: tuple[float, ...], frame: ToothFrame, fdi: int) -> ToothSurfaces:
    """The tooth with further blend modes: the errors of its dentin's shape at the blend weights ``shape``, and their
    opposites. ``frame`` is the tooth's canonical frame.
    """
    from services.anatomy.shape_errors import shape_errors

    assert surfaces.dentin is not None
    errors = shape_errors(surfaces.outer, surfaces.dentin, shape, frame, upper_tooth(fdi % 10))
    modes = np.concatenate([surfaces.dentin.modes_mm, errors, -errors])
    return replace(surfaces, dentin=replace(surfaces.dentin, modes_mm=modes))
