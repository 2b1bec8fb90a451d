"""Enamel thickness at points of a tooth, with the standard error that a job's fit tells."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.anatomy.dentin_shape import DentinShape
from services.assets.fitted_job import fitted_dentins
from services.core.errors import StoreError
from services.core.geometry import Mesh, Tooth
from services.core.records import JobSpec
from services.core.results import FitReport, PreparedManifest
from services.core.store import open_stage
from services.transport.thickness import enamel_thickness_mm, uncertain_thickness

Array = NDArray[np.float64]

MAX_DIFFERENCE_MM = 0.01
"""Largest mean difference of two dentins that are taken for the same one, mm: a tenth of what thickness differs by from
tooth to tooth, and far above single precision."""
JAW = "The fit of a jaw keeps no covariance of the dentins' shapes."
GIVEN = "The dentin's surface was given, or its shape was held."
GONE = "The fit that made the asset is not in the job's folder."


@dataclass(frozen=True)
class FittedShape:
    """A dentin's blend shape, its fitted weights (M,) and their covariance (M, M)."""

    shape: DentinShape
    weights: Array
    covariance: Array


@dataclass(frozen=True)
class Thickness:
    """Thickness over one dentin."""

    dentin: Mesh
    """The dentin's surface in the asset."""
    fitted: FittedShape | None
    """What tells the standard error; None where nothing does."""
    why_no_se: str
    """A sentence where ``fitted`` is None."""

    def at(self, points_mm: Array) -> tuple[Array, Array | None]:
        """Thickness (N,) and its standard error (N,) at points (N, 3) of the outer surface, mm."""
        if self.fitted is None:
            return enamel_thickness_mm(points_mm, self.dentin), None
        found = uncertain_thickness(points_mm, self.fitted.shape, self.fitted.weights, self.fitted.covariance)
        return found.values_mm, found.errors_mm


def thicknesses(job: Path, spec: JobSpec | None, teeth: tuple[Tooth, ...]) -> Mapping[int, Thickness]:
    """What tells the enamel's thickness of each tooth of an asset that has dentin, by its number.

    Args:
        job: the folder of the job, whose fit may be gone.
        spec: the job's options; None where they are not known.
        teeth: the asset's surfaces.
    """
    shapes, why = _fitted_shapes(job, spec)
    found = {}
    for tooth in teeth:
        if tooth.dentin is None:
            continue
        fitted = shapes.get(tooth.fdi)
        own = why
        if fitted is not None and not _is_same(tooth, tooth.dentin, fitted):
            fitted, own = None, GONE
        found[tooth.fdi] = Thickness(tooth.dentin, fitted, "" if fitted else own)
    return found


def _fitted_shapes(job: Path, spec: JobSpec | None) -> tuple[dict[int, FittedShape], str]:
    if spec is None:
        return {}, GONE
    try:
        _, report = open_stage(job, "fit", FitReport)
        folder, prepared = open_stage(job, "prepared", PreparedManifest, verify=False)
    except StoreError:
        return {}, GONE
    if spec.kind == "jaw":
        return {}, JAW
    if not report.shape_covariance:
        return {}, GIVEN
    return {
        tooth.fdi: FittedShape(shape, np.array(weights), np.array(report.shape_covariance))
        for tooth, shape, weights in fitted_dentins(folder, prepared, spec, report)
        if shape is not None
    }, GIVEN


def _is_same(tooth: Tooth, dentin: Mesh, fitted: FittedShape) -> bool:
    # The asset may be of another attempt than the fit that is published now.
    points = tooth.outer.vertices_mm[:: max(1, len(tooth.outer.vertices_mm) // 200)]
    shaped = Mesh(fitted.shape.vertices_mm(tuple(fitted.weights.tolist())), fitted.shape.base.faces)
    difference = enamel_thickness_mm(points, shaped) - enamel_thickness_mm(points, dentin)
    return bool(np.abs(difference).mean() < MAX_DIFFERENCE_MM)
