"""A fitted job, read again: its results, and its teeth with the dentin that was fitted."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from services.core.files.meshes import read_mesh
from services.core.geometry import Mesh
from services.core.records import JobSpec
from services.core.results import FitReport, PreparedManifest, ToothReport
from services.core.store import open_stage

if TYPE_CHECKING:
    from services.anatomy.dentin_shape import DentinShape
    from services.core.geometry import Tooth
    from services.transport.scene.stain_uv import ToothStains


@dataclass(frozen=True)
class FittedJob:
    """Results of a job's fit, with the preparation that it was made from."""

    spec: JobSpec
    folder: Path
    """Folder of the published fit."""
    report: FitReport
    prepared_folder: Path
    prepared: PreparedManifest

    @property
    def channels(self) -> tuple[str, ...]:
        """The channels that were fitted."""
        return tuple(self.report.parameters)

    @cached_property
    def shaped(self) -> list[tuple[Tooth, DentinShape | None, tuple[float, ...]]]:
        """See ``fitted_dentins``."""
        return fitted_dentins(self.prepared_folder, self.prepared, self.spec, self.report)

    @cached_property
    def teeth(self) -> tuple[Tooth, ...]:
        """The teeth with the fitted dentin surfaces."""
        return tuple(_with_dentin(*each) for each in self.shaped)

    @property
    def gums(self) -> Mesh | None:
        """The gums that were rendered with the teeth."""
        path, rendered = self.prepared_folder / "gums.ply", self.spec.kind == "jaw" or self.prepared.surroundings
        return read_mesh(path) if rendered and path.is_file() else None

    @property
    def neighbours(self) -> tuple[Tooth, ...]:
        """Teeth that were rendered around a single one, which no asset has."""
        from services.anatomy.neighbours import read_neighbours, with_usual_dentin

        if self.spec.kind != "tooth" or not self.prepared.surroundings:
            return ()
        (tooth,) = self.teeth
        around = read_neighbours(self.prepared_folder, tooth)
        return with_usual_dentin(tooth, around, self.prepared.cameras, self.spec)

    @cached_property
    def stains(self) -> ToothStains | None:
        """Fitted stains; None where none were fitted."""
        from services.transport.scene.stain_uv import read_stains

        return read_stains(self.folder)


def read_fitted(root: Path, spec: JobSpec) -> FittedJob:
    """Read what a job's fit has published.

    Raises:
        StoreError: the fit or the preparation is missing or damaged.
    """
    folder, report = open_stage(root, "fit", FitReport)
    prepared_folder, prepared = open_stage(root, "prepared", PreparedManifest, verify=False)
    return FittedJob(spec, folder, report, prepared_folder, prepared)


def fitted_teeth(
    prepared_folder: Path, prepared: PreparedManifest, spec: JobSpec, report: FitReport
) -> tuple[Tooth, ...]:
    """The teeth with the fitted dentin surfaces."""
    return tuple(_with_dentin(*each) for each in fitted_dentins(prepared_folder, prepared, spec, report))


def fitted_dentins(
    prepared_folder: Path, prepared: PreparedManifest, spec: JobSpec, report: FitReport
) -> list[tuple[Tooth, DentinShape | None, tuple[float, ...]]]:
    """Each tooth as it was prepared, its dentin as it was modelled, and the fitted weights of its blend modes."""
    from services.anatomy.job_dentin import dentin_shape, jaw_dentins, known_dentins
    from services.core.files.meshes import read_teeth

    teeth = read_teeth(prepared_folder, prepared.fdi)
    if spec.kind == "jaw":
        shapes = [(report.teeth[str(tooth.fdi)].shape, _is_layered(report.teeth[str(tooth.fdi)])) for tooth in teeth]
        dentins = [
            dentin if layered else None
            for dentin, (_, layered) in zip(jaw_dentins(teeth, prepared.cameras, spec), shapes, strict=True)
        ]
        return [(tooth, dentin, shape) for tooth, dentin, (shape, _) in zip(teeth, dentins, shapes, strict=True)]
    (tooth,) = teeth
    if spec.kind == "object":
        return [(tooth, known_dentins(teeth)[0], ())]
    return [(tooth, dentin_shape(tooth, prepared.cameras, spec), report.shape)]


def _is_layered(tooth: ToothReport) -> bool:
    return all("dentin.sigma" in table for table in tooth.parameters.values())


def _with_dentin(tooth: Tooth, dentin: DentinShape | None, shape: tuple[float, ...]) -> Tooth:
    return replace(tooth, dentin=None if dentin is None else Mesh(dentin.vertices_mm(shape), dentin.base.faces))
