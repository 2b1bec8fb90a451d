"""Driver of a tooth's fit: write inputs to files, fit the channels one after another, write one report."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from services.anatomy.dentin_shape import DentinShape
from services.anatomy.frame import ToothFrame
from services.anatomy.job_dentin import dentin_shape
from services.core.files.content_files import StoredFile
from services.core.results import FitReport
from services.fit.checks.alignment import offset_sentences
from services.fit.checks.frames import photograph_sentences
from services.fit.checks.identifiability import NOT_EXPLAINED, PARTLY_EXPLAINED, correlation, determined_sentences
from services.fit.checks.instrument.estimates import instrument_report
from services.fit.checks.next_calibration import calibration_advice
from services.fit.coordinates.priors import GUMS_START
from services.fit.measurements.instrument.capture import instrument_of
from services.fit.measurements.observations import (
    ChannelFiles,
    Observations,
    channel_scene,
    read_channel,
    read_observations,
    write_channel,
)
from services.fit.measurements.surface import held_surface
from services.fit.measurements.surroundings import neighbour_surfaces, with_shape_errors
from services.fit.measurements.view_stack import ViewStack
from services.fit.passes.final_uncertainty import DisplacedScene
from services.fit.solve.covariance import Uncertainty
from services.fit.solve.estimates import estimates
from services.fit.stages.attempt import Attempt, assess_convergence, standard_errors, worst_error
from services.fit.stages.channel_fit import ChannelFit
from services.fit.stages.previews import shown_images
from services.fit.stages.tooth.first_channel import FirstChannel, first_channel
from services.fit.stages.tooth.schedule import ChannelSchedule
from services.tasks.executors import Executor
from services.tasks.journal import Journal
from services.transport.optics.parameters import Tissue
from services.transport.scene.recipe_files import read_recipe, write_recipe
from services.transport.scene.stain_uv import ToothStains, stain_layout, store_stains, texel_edge_mm
from services.transport.thickness import fitted_thickness


@dataclass
class FitDriver:
    """One attempt at the fit of a tooth."""

    attempt: Attempt

    def run(self, started_s: float) -> FitReport:
        """Fit all channels, write files into the stage's folder and return the report."""
        attempt, spec = self.attempt, self.attempt.spec
        observations = read_observations(attempt.context.root, spec)
        (tooth,) = observations.teeth
        dentin = dentin_shape(tooth, observations.manifest.cameras, spec)
        neighbours = neighbour_surfaces(tooth, observations.neighbours, observations.manifest.cameras, spec)
        channels = spec.channels or observations.manifest.channels
        views = {channel: read_channel(observations, channel, spec) for channel in channels}
        surface = held_surface(spec, observations, attempt.inputs, attempt.log)
        layout = stain_layout(tooth.outer, texel_edge_mm(observations.pixel_edge_mm)) if spec.stains else None
        scenes = {
            channel: channel_scene(
                observations,
                channel,
                (dentin,),
                spec,
                None if layout is None else layout.corners_uv,
                neighbours,
                surface,
            )
            for channel in channels
        }
        centre_mm = tooth.outer.vertices_mm.mean(axis=0)
        instrument = instrument_of(observations.manifest, spec, centre_mm, observations.folder, observations.pixel_step)
        files = {
            channel: write_channel(attempt.inputs, scenes[channel], channel, views[channel], spec.loss, instrument)
            for channel in channels
        }
        journal = attempt.journal(files.values())
        begun, _ = journal.get_or_compute("begun", lambda: started_s)

        # Fit the channel with the most signal first; where blend weights are fitted, the others take them from it.
        modes = len(dentin.modes_mm) if dentin is not None else 0
        order = sorted(channels, key=lambda c: -files[c].quality)
        fits: dict[str, ChannelFit[Tissue]] = {}
        first: FirstChannel | None = None
        shape, covariance, next_capture = tuple[float, ...](), tuple[tuple[float, ...], ...](), ""
        with attempt.workers() as run_on:
            for number, channel in enumerate(order):
                begins = f"the fit starts from {order[0]}'s" if first else "renderers start, then the table is searched"
                attempt.log(f"{channel}: {begins}.")
                schedule = self._schedule(
                    observations, files[channel], views[channel], journal, run_on, (number, len(order))
                )
                schedule.has_dentin, schedule.modes, schedule.shape = dentin is not None, 0 if shape else modes, shape
                schedule.gums = None if observations.gums is None else GUMS_START
                schedule.shape_covariance = covariance
                schedule.first = first
                if dentin is not None and dentin.frame is not None:
                    given = files[channel].recipe, dentin.frame, tooth.fdi
                    schedule.make_displaced_scene = partial(_displaced_scene, attempt.inputs, *given)
                schedule.stain_layout = layout
                fits[channel] = schedule.run()
                first = first_channel(fits[channel]) if number == 0 else first
                if not shape:
                    shape, covariance = fits[channel].tissue.shape, shape_covariance(fits[channel].uncertainty)
                if spec.advise and number == 0 and fits[channel].solution.result.converged:
                    next_capture = schedule.next_capture(fits[channel], attempt.inputs)
                    measured = calibration_advice(fits[channel].tissue, schedule.media, fits[channel].uncertainty)
                    next_capture = f"{next_capture} {measured}".strip()
        textures = {c: stain for c in channels if (stain := fits[c].tissue.stain) is not None}
        if layout is not None and textures:
            store_stains(attempt.writer.folder, ToothStains(layout.corners_uv, textures))
        report = self._publish(
            observations, dentin, {c: fits[c] for c in channels}, order[0], views, journal, time.time() - begun
        ).model_copy(update={"surface": surface})
        where = f"In {order[0]}: " if next_capture and len(order) > 1 else ""
        return report.model_copy(update={"next_capture": "" if report.doubtful else where + next_capture})

    def _schedule(
        self,
        observations: Observations,
        files: ChannelFiles,
        views: tuple[ViewStack, ...],
        journal: Journal,
        run_on: Executor,
        channel_position: tuple[int, int],
    ) -> ChannelSchedule:
        attempt, spec = self.attempt, self.attempt.spec
        media = 2 * spec.adam_steps if spec.solver == "adam" else spec.max_steps + 10
        expected = 2 * media if spec.stains else media
        return ChannelSchedule(
            files=files,
            passes=attempt.passes(run_on, files, files.channel),
            spec=spec,
            journal=journal,
            has_dentin=True,
            modes=0,
            report=attempt.step_reporter(
                observations,
                views,
                journal,
                lambda step: (channel_position[0] + min(step / expected, 0.99)) / channel_position[1],
            ),
            log=attempt.log,
            raise_if_cancelled=attempt.context.raise_if_cancelled,
            shown=shown_images(views),
        )

    def _publish(
        self,
        observations: Observations,
        dentin: DentinShape | None,
        fits: dict[str, ChannelFit[Tissue]],
        first: str,
        views: Mapping[str, tuple[ViewStack, ...]],
        journal: Journal,
        seconds: float,
    ) -> FitReport:
        evaluations = {c: fit.evaluation for c, fit in fits.items()}
        self.attempt.write_records(journal, observations, evaluations, views)
        uncertainties = {c: fit.uncertainty for c, fit in fits.items()}
        tables = {c: self._table(fit, uncertainties[c], uncertainties[first]) for c, fit in fits.items()}
        assessment = assess_convergence(fits)
        misplaced = offset_sentences(
            evaluations,
            {c: worst_error(fit) for c, fit in fits.items()},
            observations,
            views,
            f"the mesh of tooth {observations.teeth[0].fdi}",
        )
        wrong = photograph_sentences(evaluations, observations, views, is_placed=not misplaced)
        converged = assessment.converged and not misplaced and not wrong
        correlations = {c: correlation(uncertainties[c]) for c in fits}
        shape, covariance = fits[first].tissue.shape, shape_covariance(uncertainties[first])
        thickness = fitted_thickness(
            observations.teeth[0].outer, dentin, shape, covariance, observations.manifest.cameras[0]
        )
        return FitReport(
            converged=converged,
            doubtful=assessment.doubtful,
            advice=" ".join(assessment.lacking + misplaced + wrong + assessment.advice),
            parameters=tables,
            fit_error={c: fit.fit_error for c, fit in fits.items()},
            held_out_error={c: fit.held_out_error for c, fit in fits.items() if fit.held_out_error is not None},
            fit_error_se=standard_errors({c: one.fitted for c, one in evaluations.items()}),
            held_out_error_se=standard_errors({c: one.held_out for c, one in evaluations.items()}),
            steps=sum(fit.steps for fit in fits.values()),
            shape=shape,
            shape_covariance=covariance,
            enamel_thickness=None if thickness is None else thickness.mean,
            correlations=correlations,
            told=NOT_EXPLAINED
            if not converged
            else PARTLY_EXPLAINED
            if assessment.doubtful
            else determined_sentences(tables, correlations),
            pixel_step=observations.pixel_step,
            pixel_edge_mm=observations.pixel_edge_mm,
            seconds=seconds,
            **instrument_report(self.attempt.spec, uncertainties, observations.manifest),
        )

    def _table(
        self, fit: ChannelFit[Tissue], uncertainty: Uncertainty, shape_uncertainty: Uncertainty
    ) -> dict[str, Any]:
        tooth = ("enamel",) if self.attempt.spec.dentin == "none" else ("enamel", "dentin", "shape")
        parts = tooth if fit.tissue.gums is None else (*tooth, "gums")
        fitted_shape = (
            shape_uncertainty
            if any(name.startswith("shape.") for name in shape_uncertainty.domain.parameters)
            else None
        )
        return estimates(fit.tissue, parts, uncertainty, fitted_shape)


def _displaced_scene(folder: Path, recipe: StoredFile, frame: ToothFrame, fdi: int, tissue: Tissue) -> DisplacedScene:
    scene = read_recipe(recipe)
    surfaces = with_shape_errors(scene.teeth[0], tissue.shape, frame, fdi)
    assert surfaces.dentin is not None
    count = (len(surfaces.dentin.modes_mm) - len(tissue.shape)) // 2
    return DisplacedScene(write_recipe(folder, replace(scene, teeth=(surfaces,))), count)


def shape_covariance(uncertainty: Uncertainty, tooth: int | None = None) -> tuple[tuple[float, ...], ...]:
    """Covariance of the blend weights, in a jaw those of one tooth; empty where they were not fitted."""
    own = [
        k
        for k, coordinate in enumerate(uncertainty.domain.coordinates)
        if coordinate.kind == "shape" and coordinate.tooth == tooth
    ]
    return tuple(tuple(row) for row in uncertainty.covariance[np.ix_(own, own)].tolist())
