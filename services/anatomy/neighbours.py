"""The teeth around a single one, as they are rendered with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from services.anatomy.dentin_shape import DentinShape
from services.anatomy.job_dentin import jaw_dentins
from services.core.files.meshes import read_teeth
from services.core.geometry import Camera, Mesh, Tooth
from services.core.records import JobSpec

MAX_NEIGHBOURS = 6
"""Largest number of teeth that are rendered around a single one: three to either side of a tooth in the middle."""
USUAL_WEIGHT = 0.6
"""Mean of a blend weight's prior: the weights nearest to the dentin of a micro-CT incisor and of procedural teeth lie
at 0.3 to 1."""


def read_neighbours(folder: Path, tooth: Tooth) -> tuple[Tooth, ...]:
    """Other teeth of a prepared capture that are rendered around one of them, the nearest first."""
    centre_mm = tooth.outer.vertices_mm.mean(axis=0)
    others = [other for other in read_teeth(folder) if other.fdi != tooth.fdi]
    others.sort(key=lambda other: float(np.linalg.norm(other.outer.vertices_mm.mean(axis=0) - centre_mm)))
    return tuple(others[:MAX_NEIGHBOURS])


def with_usual_dentin(
    tooth: Tooth, neighbours: Sequence[Tooth], cameras: tuple[Camera, ...], spec: JobSpec
) -> tuple[Tooth, ...]:
    """The teeth around ``tooth`` with the dentin that a job asks for; a blend shape has the usual weights."""
    # All together tell where the arch lies, and with it the axes of the blend shapes.
    dentins = jaw_dentins((tooth, *neighbours), cameras, spec)[1:] if neighbours else []
    return tuple(
        replace(other, dentin=None if dentin is None else _usual(dentin))
        for other, dentin in zip(neighbours, dentins, strict=True)
    )


def _usual(dentin: DentinShape) -> Mesh:
    return Mesh(dentin.vertices_mm((USUAL_WEIGHT,) * len(dentin.modes_mm)), dentin.base.faces)
