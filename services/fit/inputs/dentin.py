"""Dentin surfaces of a capture's teeth, and the teeth that surround a single one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.anatomy.dentin_shape import DentinShape
from services.anatomy.frame import ToothFrame
from services.anatomy.templates.dimensions import upper_tooth
from services.core.errors import InputError, NonFiniteError
from services.core.files.meshes import read_teeth
from services.core.geometry import Camera, Mesh, Tooth
from services.core.records import JobSpec
from services.fit.optics.priors import SHAPE
from services.fit.transport.scene.recipe import ToothSurfaces

MAX_NEIGHBOURS = 6
"""Largest number of teeth that are rendered around a single one: three to either side of a tooth in the middle."""


def dentin_shape(tooth: Tooth, cameras: tuple[Camera, ...], spec: JobSpec) -> DentinShape | None:
    """Dentin surface that the job asks for: the given one, a blend shape made from the enamel, or none.

    The axes of the blend modes follow from the mesh and from its FDI number and, where these leave them open, from the
    places of the cameras.
    """
    if spec.dentin == "known":
        assert tooth.dentin is not None
        return DentinShape.known(tooth.dentin)
    if spec.dentin == "fit":
        from services.anatomy.jaw_frames import tooth_frame

        return _blend_shape(tooth, tooth_frame(tooth, viewpoints_mm(cameras)))
    return None


def jaw_dentins(teeth: Sequence[Tooth], cameras: tuple[Camera, ...], spec: JobSpec) -> list[DentinShape | None]:
    """Dentin of each tooth that the job asks for: the given surface, a blend shape made from the enamel, or none.

    A tooth without dentin, or whose mesh allows no blend shape, is homogeneous.
    """
    if spec.dentin == "known":
        return known_dentins(teeth)
    if spec.dentin == "none":
        return [None for _ in teeth]
    from services.anatomy.jaw_frames import jaw_frames

    def blended(tooth: Tooth, frame: ToothFrame) -> DentinShape | None:
        try:
            return _blend_shape(tooth, frame)
        except (InputError, NonFiniteError):
            return None

    return [
        blended(tooth, frame) for tooth, frame in zip(teeth, jaw_frames(teeth, viewpoints_mm(cameras)), strict=True)
    ]


def known_dentins(teeth: Sequence[Tooth]) -> list[DentinShape | None]:
    """Dentin of each tooth as a fixed surface."""
    return [None if tooth.dentin is None else DentinShape.known(tooth.dentin) for tooth in teeth]


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


def viewpoints_mm(cameras: tuple[Camera, ...]) -> NDArray[np.float64]:
    """Centres (N, 3) of the cameras, in mm."""
    return np.array([camera.rays(np.zeros(1), np.zeros(1))[0] for camera in cameras])


def _blend_shape(tooth: Tooth, frame: ToothFrame) -> DentinShape:
    from services.anatomy.blend import dentin_blend_shape

    return dentin_blend_shape(tooth.outer, frame, crown=upper_tooth(tooth.fdi % 10))
