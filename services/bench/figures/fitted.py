"""A finished fit, rendered again and compared with its photographs."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.anatomy.dentin_shape import DentinShape
from services.anatomy.job_dentin import dentin_shape, known_dentins
from services.assets.asset import mouth_of
from services.assets.fitted_job import fitted_teeth
from services.bench.figures.cases import job_of
from services.bench.fits.tooth_capture import tissue_of
from services.core.pages.pictures import Picture
from services.core.records import JobSpec
from services.core.results import FitReport
from services.core.store import open_stage
from services.fit.measurements.observations import Observations, channel_scene, read_channel, read_observations
from services.fit.measurements.view_stack import ViewStack
from services.fit.passes.evaluate import ErrorSums, error_sums
from services.transport.engine import Engine
from services.transport.optics.parameters import Mouth, Tissue
from services.transport.scene.recipe import View
from services.transport.scene.stain_uv import read_stains

Image = tuple[str, str]
"""Names of an image's camera and light."""


@dataclass(frozen=True)
class Comparison:
    """A rendered image beside its photograph, and the sums of its error."""

    picture: Picture
    sums: ErrorSums


Comparisons = Mapping[Image, Comparison]


def error_of(comparisons: Comparisons, images: Iterable[Image]) -> float:
    """Return the relative error over some images, without the noise of renders and photographs, and not below its own
    Monte Carlo standard error.
    """
    total = sum((comparisons[image].sums for image in images), ErrorSums())
    return total.resolved_error or 0.0


def loss_of(comparisons: Comparisons, images: Iterable[Image]) -> float:
    """Return the relative squared error over some images, with the photographs' noise included."""
    return sum((comparisons[image].sums for image in images), ErrorSums()).loss or 0.0


@dataclass(frozen=True)
class Fitted:
    """A case's fit of one tooth or of a jaw."""

    folder: Path

    @cached_property
    def spec(self) -> JobSpec:
        """The fit's options, but with single pixels instead of means over squares of pixels, so that pictures have the
        photographs' own resolution.
        """
        return job_of(self.folder)[1].model_copy(update={"pixel_step": 1})

    @cached_property
    def _stage(self) -> tuple[Path, FitReport]:
        return open_stage(job_of(self.folder)[0], "fit", FitReport)

    @property
    def report(self) -> FitReport:
        """The fit's report."""
        return self._stage[1]

    @cached_property
    def observations(self) -> Observations:
        """The fit's observations; a jaw's teeth have the dentin that the fit assumed."""
        found = read_observations(job_of(self.folder)[0], self.spec)
        return (
            found
            if self.spec.kind == "tooth"
            else replace(found, teeth=fitted_teeth(found.folder, found.manifest, self.spec, self.report))
        )

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the fitted channels."""
        return tuple(self.report.parameters)

    def optics(self, channel: str) -> Tissue | Mouth:
        """Return the reported media of a channel."""
        if self.spec.kind == "jaw":
            return mouth_of(self.report, channel)
        stains = read_stains(self._stage[0])
        tissue = tissue_of({name: estimate.value for name, estimate in self.report.parameters[channel].items()})
        return replace(tissue, shape=self.report.shape, stain=None if stains is None else stains.textures.get(channel))

    def stage_tissue(self, channel: str, stage: str) -> Tissue:
        """Return a tooth's media at the end of a stage of the fit."""
        history = json.loads((self._stage[0] / "history.json").read_text())
        return replace(
            tissue_of(
                [step for step in history if (step["channel"], step["stage"]) == (channel, stage)][-1]["parameters"]
            ),
            shape=self.report.shape,
        )

    def dentins(self) -> list[DentinShape | None]:
        """Return the dentin shape of each tooth, None for a tooth without dentin."""
        if self.spec.kind == "tooth":
            (tooth,) = self.observations.teeth
            return [dentin_shape(tooth, self.observations.manifest.cameras, self.spec)]
        return known_dentins(self.observations.teeth)

    def renderer(self, channel: str) -> Engine:
        """Return the engine of a channel's scene under all lights."""
        stains = read_stains(self._stage[0])
        return Engine(
            channel_scene(
                self.observations,
                channel,
                self.dentins(),
                self.spec,
                None if stains is None else stains.corners_uv,
                surface=self.report.surface,
            )
        )

    def compared(
        self, samples: int, optics: Mapping[str, Tissue | Mouth] | None = None, cameras: tuple[str, ...] | None = None
    ) -> dict[Image, Comparison]:
        """Render every image of some cameras under all lights and compare it with its photograph.

        Args:
            samples: paths per pixel of each of two renders; their mean is shown.
            optics: media by channel; the reported ones by default.
            cameras: names of the cameras; all by default.
        """
        channels = [
            self._channel(channel, samples, self.optics(channel) if optics is None else optics[channel], cameras)
            for channel in self.channels
        ]
        return {image: _merged([found[image] for found in channels]) for image in channels[0]}

    def _channel(
        self, channel: str, samples: int, optics: Tissue | Mouth, cameras: tuple[str, ...] | None
    ) -> dict[Image, Comparison]:
        engine, found = self.renderer(channel), {}
        for number, view in enumerate(read_channel(self.observations, channel, self.spec)):
            if cameras is None or view.camera.name in cameras:
                first, second = (
                    engine.images(
                        optics, View(view.camera, view.pixels), samples=samples, seed=7001 + 2 * number + k
                    ).mean
                    for k in range(2)
                )
                for light, record in enumerate(self.observations.manifest.lights):
                    found[view.camera.name, record.name] = _comparison(
                        view, record.name, light, first[light], second[light]
                    )
        return found


def _comparison(
    view: ViewStack, name: str, light: int, first: NDArray[np.float64], second: NDArray[np.float64]
) -> Comparison:
    width, height = view.camera.size
    photo, render, valid = (
        np.zeros((height, width, 1)),
        np.zeros((height, width, 1)),
        np.zeros((height, width), dtype=bool),
    )
    x, y = view.pixels.T
    photo[y, x, 0], render[y, x, 0], valid[y, x] = view.reference[light], 0.5 * (first + second), view.valid[light]
    sums = error_sums(first, second, view.reference[light], view.variance[light], view.valid[light])
    return Comparison(Picture(view.camera.name, name, bool(view.held_out[light]), photo, render, valid), sums)


def _merged(channels: list[Comparison]) -> Comparison:
    # Join the channels into one picture.
    pictures = [one.picture for one in channels]
    photo, render = (
        np.concatenate([getattr(picture, name) for picture in pictures], axis=-1) for name in ("photo", "render")
    )
    valid = np.all([picture.valid for picture in pictures], axis=0)
    return Comparison(
        replace(pictures[0], photo=photo, render=render, valid=valid), sum((one.sums for one in channels), ErrorSums())
    )
