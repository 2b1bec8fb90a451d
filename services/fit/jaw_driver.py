"""Runs a jaw's fit: single teeth first, each on its own, then all together; one report at the end."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

from services.core.errors import SettingsError
from services.core.geometry import Camera, Mesh, Tooth
from services.core.records import FitReport, JobSpec
from services.fit.attempt import Attempt
from services.fit.blocks import GUMS
from services.fit.driver import dentin_shape
from services.fit.executors import Executor
from services.fit.jaw_report import JawFit, report
from services.fit.jaw_schedule import JawSchedule
from services.fit.jaw_starts import GUMS_START, LEAST_TOOTH_PIXELS, TOOTH_FAULTS, start_mouth, start_tooth
from services.fit.jaw_views import fitted_pixels, label_views, showing, without
from services.fit.journal import Journal
from services.fit.observations import (
    ChannelFiles,
    Observations,
    ViewStack,
    channel_scene,
    read_channel,
    read_observations,
    require_signal,
    write_channel,
)
from services.fit.optics.parameters import Medium, Tissue
from services.fit.optics.priors import SHAPE
from services.fit.pictures import shown_images
from services.fit.schedule import ChannelSchedule
from services.fit.transport.recipe import DentinShape

START_STEPS = 4
"""About so many steps start one tooth, for the progress shown."""


@dataclass(frozen=True)
class Channel:
    """One channel's inputs."""

    name: str
    views: tuple[ViewStack, ...]
    files: ChannelFiles


@dataclass
class JawDriver:
    """One attempt at a jaw."""

    attempt: Attempt

    def run(self, started_s: float) -> FitReport:
        """Fit all channels; files land in the stage's folder, the report is returned.

        Raises:
            SettingsError: more than one lobe was asked for. CaptureInputError, StoreError: what was prepared is no jaw that can be fitted.
        """
        attempt, spec = self.attempt, self.attempt.spec
        if spec.lobes != 1:
            raise SettingsError("A jaw is fitted with one lobe per medium; set lobes to 1, or fit its teeth one by one with kind 'tooth'.")
        observations = read_observations(attempt.context.root, spec)
        observations = replace(observations, teeth=tuple(fixed_dentin(tooth, observations.manifest.cameras, spec) for tooth in observations.teeth))
        dentins = known_dentins(observations.teeth)
        for tooth in observations.teeth if spec.dentin != "none" else ():
            if tooth.dentin is None:
                attempt.log(f"Tooth {tooth.fdi} has no dentin and is fitted as enamel throughout; give its dentin.ply, or check its mesh.")
        channels = []
        for name in spec.channels or observations.manifest.channels:
            views = label_views(read_channel(observations, name, spec), observations)
            channels.append(Channel(name, views, write_channel(attempt.inputs, channel_scene(observations, name, dentins, spec), name, views)))
        journal = attempt.journal(channel.files for channel in channels)
        begun, _ = journal.once("begun", lambda: started_s)
        with attempt.workers() as run_on:
            fits = {c.name: _ChannelRun(attempt, observations, dentins, c, journal, run_on, (n, len(channels))).fit() for n, c in enumerate(channels)}
        attempt.write_records(journal, observations, {c: jaw.fit.evaluation for c, jaw in fits.items()}, {c: jaw.views for c, jaw in fits.items()})
        return report(fits, observations, time.time() - begun)


def fixed_dentin(tooth: Tooth, cameras: tuple[Camera, ...], spec: JobSpec) -> Tooth:
    """A jaw's tooth with its dentin: the given one if any, none, or where it would be fitted the blend shape that a single tooth's fit starts from.

    A tooth whose mesh allows no such shape is homogeneous.
    """
    if spec.dentin == "known":
        return tooth
    try:
        shape = dentin_shape(tooth, cameras, spec)
    except TOOTH_FAULTS:
        shape = None
    if shape is None:
        return replace(tooth, dentin=None)
    return replace(tooth, dentin=Mesh(shape.vertices_mm((SHAPE[0],) * len(shape.modes_mm)), shape.base.faces))


def known_dentins(teeth: Sequence[Tooth]) -> list[DentinShape | None]:
    """Each tooth's dentin as a surface that does not move."""
    return [None if tooth.dentin is None else DentinShape.known(tooth.dentin) for tooth in teeth]


@dataclass
class _ChannelRun:
    """One channel, from single teeth to the whole mouth."""

    attempt: Attempt
    observations: Observations
    dentins: Sequence[DentinShape | None]
    channel: Channel
    journal: Journal
    run_on: Executor
    place: tuple[int, int]
    """Number of this channel, and of how many."""
    steps: int = 0

    def fit(self) -> JawFit:
        observations, views = self.observations, self.channel.views
        starts = []
        for k, tooth in enumerate(observations.teeth):
            own = showing(views, k)
            starts.append(start_tooth(tooth.fdi, fitted_pixels(own), partial(self._alone, k, own)))
            if starts[-1].sentence:
                self.attempt.log(f"{self.channel.name}: {starts[-1].sentence}")
        mouth = start_mouth(starts, self._gums(), has_cavity=observations.cavity is not None)

        # Pixels of a tooth that no medium could be fitted to would mislead its neighbours; no error is known of it, so the jaw's does not hold it.
        failed = [k for k, start in enumerate(starts) if start.state == "failed"]
        files, dentins = self.channel.files, [None if s.drops_dentin else d for s, d in zip(starts, self.dentins, strict=True)]
        if failed:
            scene, views = channel_scene(observations, self.channel.name, dentins, self.attempt.spec), without(views, failed)
            files = write_channel(self.attempt.inputs, scene, self.channel.name, views)
        self.attempt.log(f"{self.channel.name}: all {len(starts)} teeth together.")
        schedule = JawSchedule(
            files=files,
            passes=self.attempt.passes(self.run_on, files, self.channel.name),
            spec=self.attempt.spec,
            journal=self.journal,
            report=self.attempt.teller(observations, views, self.journal, self._done),
            pause=self.attempt.context.raise_if_cancelled,
            shown=shown_images(views),
            steps=self.steps,
            start=mouth,
            teeth=starts,
            dentin=tuple(dentin is not None for dentin in dentins),
        )
        return JawFit(tuple(starts), tuple(schedule.dentin), schedule.run(), views)

    def _alone(self, k: int, views: tuple[ViewStack, ...]) -> Tissue:
        tooth = self.observations.teeth[k]
        return self._start(f"{tooth.fdi}", replace(self.observations, teeth=(tooth,), gums=None, cavity=None), self.dentins[k], views, tooth.fdi)

    def _gums(self) -> Medium | None:
        # Gums alone are fitted like a tooth without dentin.
        gums, views = self.observations.gums, showing(self.channel.views, GUMS)
        if gums is None:
            return None
        if fitted_pixels(views) < LEAST_TOOTH_PIXELS:
            self.attempt.log(f"{self.channel.name}: gums show in {fitted_pixels(views)} usable pixels and start from the literature.")
            return GUMS_START
        try:
            alone = replace(self.observations, teeth=(Tooth(0, gums),), gums=None, cavity=None)
            return self._start("gums", alone, None, views, None).enamel
        except TOOTH_FAULTS as problem:
            self.attempt.log(f"{self.channel.name}: gums start from the literature: {problem.message}")
            return GUMS_START

    def _start(self, name: str, alone: Observations, dentin: DentinShape | None, views: tuple[ViewStack, ...], fdi: int | None) -> Tissue:
        # The first stages of a single tooth's fit, on a scene of its own.
        channel, spec = self.channel.name, self.attempt.spec
        require_signal(views, f"Tooth {name}" if fdi is not None else "The picture of the gums")
        folder = self.attempt.inputs / name
        scene = channel_scene(alone, channel, (dentin,), spec)
        files = write_channel(folder, scene if fdi is not None else replace(scene, ior=scene.gums_ior), channel, views, spec.loss)
        schedule = ChannelSchedule(
            files=files,
            passes=self.attempt.passes(self.run_on, files, f"{channel}/{name}"),
            spec=spec,
            journal=self.journal,
            has_dentin=dentin is not None,
            modes=0,
            report=self.attempt.teller(self.observations, self.channel.views, self.journal, self._done),
            pause=self.attempt.context.raise_if_cancelled,
            steps=self.steps,
            tooth=fdi,
        )
        try:
            return schedule.start()
        finally:
            self.steps = schedule.steps

    def _done(self, step: int) -> float:
        expected = START_STEPS * len(self.observations.teeth) + 2 * self.attempt.spec.max_steps
        return (self.place[0] + min(step / expected, 0.99)) / self.place[1]
