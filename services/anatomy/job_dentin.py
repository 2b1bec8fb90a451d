"""The dentin of each tooth as a job asks for it: the given surface, a blend shape made from the enamel, or none."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from services.anatomy.dentin_shape import DentinShape
from services.anatomy.frame import ToothFrame
from services.anatomy.templates.dimensions import upper_tooth
from services.core.errors import InputError, NonFiniteError
from services.core.geometry import Camera, Tooth
from services.core.records import JobSpec


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


def viewpoints_mm(cameras: tuple[Camera, ...]) -> NDArray[np.float64]:
    """Centres (N, 3) of the cameras, in mm."""
    return np.array([camera.rays(np.zeros(1), np.zeros(1))[0] for camera in cameras])


def _blend_shape(tooth: Tooth, frame: ToothFrame) -> DentinShape:
    from services.anatomy.blend import dentin_blend_shape

    return dentin_blend_shape(tooth.outer, frame, crown=upper_tooth(tooth.fdi % 10))
