"""Instrument of a capture as its calibration states it, and the errors that act on each photograph."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.calibration.uncertainty import CalibrationUncertainty
from services.core.geometry import Light
from services.core.records import JobSpec
from services.core.results import PreparedManifest
from services.fit.coordinates.instrument_errors import (
    InstrumentErrors,
    errors_of,
    flare_name,
    gain_name,
    light_names,
    shift_name,
)
from services.fit.measurements.blocks import BlockInstrument, BlockMotion
from services.fit.measurements.instrument.irradiance import uncertainty_at_teeth
from services.fit.measurements.instrument.motion import shift_errors_px
from services.fit.measurements.instrument.moves import Move, is_dome_given_by_lights, move_covariance, write_moves
from services.fit.measurements.slopes import motions_of
from services.fit.measurements.view_stack import ViewStack
from services.transport.scene.recipe import SceneRecipe
from services.transport.scene.rigid_moves import SCAN

MAX_JAW_LIGHTS = 12
"""Largest number of lights under which a jaw's fit has a gain for each light. With more, each light's gain counts as
exact. The noise of the products of derivatives and single lights' images has to be kept for every tooth and its
neighbours: 2 MB a tooth with 12 lights, and it grows with the square of their number. And the errors of many lights
average out."""


@dataclass(frozen=True)
class Instrument:
    """Instrument that took a capture, as a calibration states it."""

    lights: tuple[Light, ...]
    """Lights in the order of the views' images."""
    stated: CalibrationUncertainty | None
    has_irradiance_gains: bool = False
    """Whether the gain of a single light is the error of its irradiance at the teeth."""
    max_light_gains: int | None = None
    """Largest number of fitted lights under which gains of single lights are coordinates; None for no limit."""
    has_pose: bool = False
    """Whether the pose of the scan is among the coordinates; where it is not, its moves are considered."""
    shifts_px: Mapping[tuple[str, str], float] = field(default_factory=dict)
    """Standard error of each photograph's own shift, in pixels of the fit, by camera and light; photographs that are
    not named stand still."""

    def moves(self, folder: Path, recipe: SceneRecipe) -> tuple[Move, ...]:
        """Moves of scan and dome under the lights of a recipe, with their scenes."""
        covariance, _ = move_covariance(self.stated, self.lights)
        if self.has_pose:
            covariance[: len(SCAN)], covariance[:, : len(SCAN)] = 0.0, 0.0
        centre_mm = np.mean([light.position_mm for light in self.lights], axis=0)
        known = self.has_irradiance_gains and is_dome_given_by_lights(self.stated, self.lights)
        return write_moves(folder, recipe, covariance, centre_mm, keep_irradiance=known)

    def errors(self, channel: str, cameras: Sequence[str], used: NDArray[np.bool_]) -> InstrumentErrors:
        """Errors of one channel that act on the fitted photographs of some cameras under the lights of the mask
        ``used`` (L,).
        """
        lights = self._light_names(used)
        if self.max_light_gains is not None and len(lights) > self.max_light_gains:
            lights = []
        every = [(camera, light) for camera in cameras for light in self._light_names(used)]
        shifts_px = {shift_name(*one): self.shifts_px[one] for one in every if one in self.shifts_px}
        return errors_of(channel, lights, cameras, self.stated, with_scan=self.has_pose, shifts_px=shifts_px)

    def block_instrument(
        self, channel: str, camera: str, brightest: float, chosen: NDArray[np.bool_]
    ) -> BlockInstrument:
        """Errors that act on one camera's photographs under the chosen lights (L,).

        Args:
            brightest: largest radiance among the camera's valid pixels in this channel.
        """
        lights = self._light_names(chosen)
        names = light_names(lights, channel, self.stated)
        shifts = tuple(shift_name(camera, light) if (camera, light) in self.shifts_px else "" for light in lights)
        return BlockInstrument(
            gain_name(channel), names, flare_name(camera, channel), brightest, shifts if any(shifts) else ()
        )

    def motions(self, scene: SceneRecipe, views: Sequence[ViewStack]) -> Sequence[BlockMotion | None]:
        """For each view, the changes of its photographs by moves; None where the fit estimates none."""
        return motions_of(scene, views) if self.has_pose or self.shifts_px else [None] * len(views)

    def _light_names(self, lights: NDArray[np.bool_]) -> list[str]:
        return [light.name for light, is_chosen in zip(self.lights, lights, strict=True) if is_chosen]


def instrument_of(
    manifest: PreparedManifest,
    spec: JobSpec,
    teeth_mm: NDArray[np.float64],
    prepared: Path | None = None,
    pixel_step: int = 1,
) -> Instrument | None:
    """The instrument of a capture; None where the job takes it for exact, and for the solver adam, which does not fit
    its errors.

    Args:
        manifest: manifest of the prepared capture.
        spec: the job.
        teeth_mm: centre of the teeth (3,).
        prepared: folder of the prepared capture, whose photographs' motion a tooth's fit estimates; None to take it for
            exact.
        pixel_step: edge of the fitted squares, in pixels of the photographs.
    """
    if spec.instrument == "off" or spec.solver == "adam":
        return None
    max_gains = MAX_JAW_LIGHTS if spec.kind == "jaw" else None
    stated = uncertainty_at_teeth(manifest.uncertainty, manifest.lights, manifest.channels, teeth_mm)
    return Instrument(
        manifest.lights,
        stated,
        stated is not manifest.uncertainty,
        max_gains,
        has_pose=spec.kind != "jaw",
        shifts_px=shift_errors_px(prepared, pixel_step) if prepared is not None and spec.kind != "jaw" else {},
    )
