"""Driver of a jaw's fit: fit single teeth first, each on its own, then all together; write one report."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from services.anatomy.dentin_shape import DentinShape
from services.anatomy.job_dentin import jaw_dentins
from services.core.errors import SettingsError
from services.core.geometry import Tooth
from services.core.job_kinds import job_kinds
from services.core.records import JobSpec
from services.core.results import FitReport
from services.fit.coordinates.priors import GUMS_START, SHAPE
from services.fit.measurements.blocks import GUMS
from services.fit.measurements.instrument.capture import Instrument, instrument_of
from services.fit.measurements.observations import (
    ChannelFiles,
    Observations,
    channel_scene,
    read_channel,
    read_observations,
    require_signal,
    write_channel,
)
from services.fit.measurements.surface import held_surface
from services.fit.measurements.view_stack import ViewStack
from services.fit.stages.attempt import Attempt
from services.fit.stages.jaw.schedule import JawSchedule
from services.fit.stages.jaw.starts import MIN_TOOTH_PIXELS, TOOTH_ERRORS, start_mouth, start_tooth
from services.fit.stages.jaw.tooth_reports import JawFit, report
from services.fit.stages.jaw.views import fitted_pixels, label_views, views_of_parts, views_without_teeth
from services.fit.stages.previews import shown_images
from services.fit.stages.tooth.schedule import ChannelSchedule
from services.tasks.executors import Executor
from services.tasks.journal import Journal
from services.transport.optics.parameters import Medium, Tissue

START_STEPS = 4
"""Approximate number of steps at the start of one tooth, for the displayed progress."""


@dataclass(frozen=True)
class Channel:
    """Inputs of one channel."""

    name: str
    views: tuple[ViewStack, ...]
    files: ChannelFiles


@dataclass
class JawDriver:
    """One attempt at the fit of a jaw."""

    attempt: Attempt

    def run(self, started_s: float) -> FitReport:
        """Fit all channels, write files into the stage's folder and return the report.

        Raises:
            SettingsError: an option applies to single teeth only.
            CaptureInputError, StoreError: the prepared capture is no jaw that can be fitted.
        """
        attempt, spec = self.attempt, self.attempt.spec
        require_jaw_options(spec)
        observations = read_observations(attempt.context.root, spec)
        dentins = jaw_dentins(observations.teeth, observations.manifest.cameras, spec)
        for tooth, dentin in zip(observations.teeth, dentins, strict=True) if spec.dentin != "none" else ():
            if dentin is None:
                attempt.log(
                    f"Tooth {tooth.fdi} has no dentin and is fitted as enamel throughout; give its dentin.ply, or check"
                    " its mesh."
                )
        surface = held_surface(spec, observations, attempt.inputs, attempt.log)
        centre_mm = np.concatenate([tooth.outer.vertices_mm for tooth in observations.teeth]).mean(axis=0)
        channels, instrument = [], instrument_of(observations.manifest, spec, centre_mm)
        for name in spec.channels or observations.manifest.channels:
            views = label_views(read_channel(observations, name, spec), observations)
            channels.append(
                Channel(
                    name,
                    views,
                    write_channel(
                        attempt.inputs,
                        channel_scene(observations, name, dentins, spec, surface=surface),
                        name,
                        views,
                        instrument=instrument,
                    ),
                )
            )
        journal = attempt.journal(channel.files for channel in channels)
        begun, _ = journal.get_or_compute("begun", lambda: started_s)

        # Fit the channel with the most signal first; where blend weights are fitted, the others take them from it.
        order = sorted(channels, key=lambda channel: -channel.files.quality)
        found: dict[str, JawFit] = {}
        with attempt.workers() as run_on:
            for number, channel in enumerate(order):
                shapes = [tooth.shape for tooth in found[order[0].name].fit.tissue.teeth] if found else None
                run = _ChannelRun(
                    attempt, observations, dentins, channel, journal, run_on, (number, len(order)), instrument, shapes
                )
                found[channel.name] = run.fit()
        fits = {channel.name: found[channel.name] for channel in channels}
        attempt.write_records(
            journal,
            observations,
            {c: jaw.fit.evaluation for c, jaw in fits.items()},
            {c: jaw.views for c, jaw in fits.items()},
        )
        told = report(spec, fits, order[0].name, dentins, observations, time.time() - begun)
        return told.model_copy(update={"surface": surface})


def require_jaw_options(spec: JobSpec) -> None:
    """Refuse options that a jaw's fit does not support.

    Raises:
        SettingsError: names the option and its required value.
    """
    for option, usual in job_kinds()["jaw"].fixed_options.items():
        if (value := getattr(spec, option)) != usual:
            raise SettingsError(
                f"A jaw is fitted with {option} = {usual!r}, not {value!r}; leave it out, or fit its teeth one by one"
                " with kind 'tooth'."
            )


@dataclass
class _ChannelRun:
    """Fit of one channel, from single teeth to the whole mouth."""

    attempt: Attempt
    observations: Observations
    dentins: Sequence[DentinShape | None]
    channel: Channel
    journal: Journal
    run_on: Executor
    channel_position: tuple[int, int]
    """Index of this channel, and the number of channels."""
    instrument: Instrument | None
    """Instrument whose errors all teeth share; None for one without errors."""
    shapes: Sequence[tuple[float, ...]] | None = None
    """Known blend weights of each tooth; None where they are to be fitted."""
    steps: int = 0

    def fit(self) -> JawFit:
        observations, views = self.observations, self.channel.views
        starts = []
        for k, tooth in enumerate(observations.teeth):
            own = views_of_parts(views, k)
            starts.append(start_tooth(tooth.fdi, fitted_pixels(own), partial(self._fit_alone, k, own)))
            if starts[-1].sentence:
                self.attempt.log(f"{self.channel.name}: {starts[-1].sentence}")
        mouth = start_mouth(starts, self._gums_start(), has_cavity=observations.cavity is not None)
        shapes = [() if start.drops_dentin else self._shape(k) for k, start in enumerate(starts)]
        mouth = replace(
            mouth, teeth=tuple(replace(tooth, shape=shape) for tooth, shape in zip(mouth.teeth, shapes, strict=True))
        )

        # Leave out the pixels of teeth whose fit failed: they would mislead the neighbours. Their image error is not
        # known, so the jaw's error does not include it.
        failed = [k for k, start in enumerate(starts) if start.state == "failed"]
        files, dentins = (
            self.channel.files,
            [None if s.drops_dentin else d for s, d in zip(starts, self.dentins, strict=True)],
        )
        if failed:
            scene, views = (
                channel_scene(observations, self.channel.name, dentins, self.attempt.spec),
                views_without_teeth(views, failed),
            )
            files = write_channel(self.attempt.inputs, scene, self.channel.name, views, instrument=self.instrument)
        self.attempt.log(f"{self.channel.name}: all {len(starts)} teeth together.")
        schedule = JawSchedule(
            files=files,
            passes=self.attempt.passes(self.run_on, files, self.channel.name),
            spec=self.attempt.spec,
            journal=self.journal,
            report=self.attempt.step_reporter(observations, views, self.journal, self._progress),
            log=self.attempt.log,
            raise_if_cancelled=self.attempt.context.raise_if_cancelled,
            shown=shown_images(views),
            steps=self.steps,
            start=mouth,
            teeth=starts,
            dentin=tuple(dentin is not None for dentin in dentins),
            fits_shape=self.shapes is None,
        )
        return JawFit(tuple(starts), tuple(schedule.dentin), schedule.run(), views)

    def _fit_alone(self, k: int, views: tuple[ViewStack, ...]) -> Tissue:
        tooth = self.observations.teeth[k]
        alone = replace(self.observations, teeth=(tooth,), gums=None, cavity=None)
        return self._start(f"{tooth.fdi}", alone, self.dentins[k], self._shape(k), views, tooth.fdi)

    def _shape(self, k: int) -> tuple[float, ...]:
        # Blend weights of a tooth at the start. Known weights are empty where another channel had to drop the dentin.
        dentin, known = self.dentins[k], () if self.shapes is None else self.shapes[k]
        return known or (() if dentin is None else (SHAPE[0],) * len(dentin.modes_mm))

    def _gums_start(self) -> Medium | None:
        # Start of the gums, fitted like a tooth without dentin.
        gums, views = self.observations.gums, views_of_parts(self.channel.views, GUMS)
        if gums is None:
            return None
        if fitted_pixels(views) < MIN_TOOTH_PIXELS:
            self.attempt.log(
                f"{self.channel.name}: gums show in {fitted_pixels(views)} usable pixels and start from the literature."
            )
            return GUMS_START
        try:
            alone = replace(self.observations, teeth=(Tooth(0, gums),), gums=None, cavity=None)
            return self._start("gums", alone, None, (), views, None).enamel
        except TOOTH_ERRORS as problem:
            self.attempt.log(f"{self.channel.name}: gums start from the literature: {problem.message}")
            return GUMS_START

    def _start(
        self,
        name: str,
        alone: Observations,
        dentin: DentinShape | None,
        shape: tuple[float, ...],
        views: tuple[ViewStack, ...],
        fdi: int | None,
    ) -> Tissue:
        # Run the first stages of a single tooth's fit, on a scene of its own.
        channel, spec = self.channel.name, self.attempt.spec
        require_signal(views, f"Tooth {name}" if fdi is not None else "The picture of the gums")
        folder = self.attempt.inputs / name
        scene = channel_scene(alone, channel, (dentin,), spec)
        files = write_channel(folder, scene if fdi is not None else replace(scene, ior=scene.gums_ior), channel, views)
        schedule = ChannelSchedule(
            files=files,
            passes=self.attempt.passes(self.run_on, files, f"{channel}/{name}"),
            spec=spec,
            journal=self.journal,
            has_dentin=dentin is not None,
            modes=0,
            shape=shape,
            report=self.attempt.step_reporter(self.observations, self.channel.views, self.journal, self._progress),
            log=self.attempt.log,
            raise_if_cancelled=self.attempt.context.raise_if_cancelled,
            steps=self.steps,
            tooth=fdi,
        )
        try:
            return schedule.start()
        finally:
            self.steps = schedule.steps

    def _progress(self, step: int) -> float:
        expected = (
            START_STEPS * len(self.observations.teeth)
            + (3 if self.attempt.spec.dentin == "fit" else 2) * self.attempt.spec.max_steps
        )
        return (self.channel_position[0] + min(step / expected, 0.99)) / self.channel_position[1]
