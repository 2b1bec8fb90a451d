"""Judgement of a calibration: whether it keeps its limits, what looks wrong, and what to photograph again."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from services.calibrate.cameras.bundle import BundleFit
from services.calibrate.cameras.projection import image_grid, projection_sigma
from services.calibrate.session.boards import CamerasStep
from services.calibrate.session.charts import ColourStep
from services.calibrate.session.photos import Black
from services.calibrate.session.spheres import IntensityStep, LightsStep
from services.calibrate.session.suspicions import suspicions
from services.core.calibration.record import CalibrationLimit
from services.core.calibration.uncertainty import CalibrationUncertainty
from services.core.raw.records import RawFolder

Floats = NDArray[np.float64]
GRID = (8, 6)
"""Columns and rows of the cells into which an image is divided."""
FEW_PLACES = 8
"""Number of places of the board below which more are advised."""
MAX_EMPTY = 0.3
"""Largest fraction of an image's cells without a board corner: a board in nine places leaves only the image's corners
empty."""
CHANNELS_OF_COLOUR = 3
"""Number of channels for which XYZ is fitted to a chart."""
SUBJECTS = {"boards": "boards", "spheres": "spheres", "white": "the white sphere", "chart": "the chart"}
RETAKE_PLANS = {
    "boards": (
        "take boards in ten places and more, tilted by 20° to 40° in several directions, and fill the image with them"
    ),
    "spheres": (
        "take the mirror sphere in ten places that lie far apart, sharp and as large as the teeth's surroundings allow"
    ),
    "white": "measure its radius again, and take it in three places, whole and not overexposed",
    "chart": "take the chart sharp, evenly lit and not overexposed",
}
ENOUGH_SPHERE_PLACES = 10
"""Number of places of the mirror sphere below which more places are advised, which help more than more photographs: by
the covariance of two rigs six places give 2.5 mm where ten far apart give 1.6."""
MAX_TIMES = 10
"""Largest factor in the number of photographs that is advised: nobody takes ten times as many."""


@dataclass(frozen=True)
class Limit:
    """One limit on a figure of a calibration.

    Attributes:
        what: name of the figure.
        value: its value.
        limit: largest value that keeps the limit.
        unit: unit of value and limit.
        improved_by: kind of photographs that would improve the figure.
    """

    what: str
    value: float
    limit: float
    unit: str
    improved_by: Literal["boards", "spheres", "white", "chart"]

    @property
    def is_kept(self) -> bool:
        """Whether the value is within the limit."""
        return self.value <= self.limit


@dataclass(frozen=True)
class Judgement:
    """Judgement of a calibration.

    Attributes:
        limits: all limits, kept or not.
        suspicions: sentences on what looks wrong, each with its remedy.
        advice: sentence on what to photograph again.
    """

    limits: tuple[Limit, ...]
    suspicions: tuple[str, ...]
    advice: str

    @property
    def broken(self) -> tuple[Limit, ...]:
        """The limits that are not kept."""
        return tuple(one for one in self.limits if not one.is_kept)

    @property
    def recorded(self) -> tuple[CalibrationLimit, ...]:
        """The limits in the form of the calibration's record, for those who use the calibration."""
        return tuple(
            CalibrationLimit(
                what=one.what, value=one.value if math.isfinite(one.value) else None, limit=one.limit, unit=one.unit
            )
            for one in self.limits
        )


def judge(
    folder: RawFolder,
    cameras: CamerasStep,
    lights: LightsStep | None,
    intensity: IntensityStep | None,
    colours: ColourStep | None,
    uncertainty: CalibrationUncertainty | None,
    black: Mapping[str, Black] | None = None,
    inputs: Mapping[str, str] | None = None,
) -> Judgement:
    """Check a calibration against the limits that keep a tooth's absorption within a few per cent."""
    limits = list(_limits(cameras, lights, uncertainty, colours))
    wrong = tuple(suspicions(folder, cameras, lights, intensity, colours, black, inputs))
    return Judgement(tuple(limits), wrong, _advice(folder, limits, cameras, lights, intensity, colours, wrong))


def _limits(
    cameras: CamerasStep,
    lights: LightsStep | None,
    uncertainty: CalibrationUncertainty | None,
    colours: ColourStep | None,
) -> Iterator[Limit]:
    for number, name in enumerate(cameras.names):
        yield Limit(f"scatter of corners, camera {name}", cameras.fit.rms_px(number), 1.0, "px", "boards")
        worst = float(np.max(uncertainty_at_the_boards(cameras.fit, number, cameras.distance_mm)))
        yield Limit(f"uncertainty of projection at the boards, camera {name}", worst, 0.05, "mm", "boards")
    if lights is not None:
        count = 3 * len(lights.fit.lights)
        errors = np.sqrt(np.diag(lights.fit.covariance)[:count].reshape(-1, 3).sum(axis=1))
        yield Limit("position of the lights, rms ±", float(np.sqrt(np.mean(errors**2))), 2.0, "mm", "spheres")
    if uncertainty is not None:
        gains = [n for n, name in enumerate(uncertainty.names) if name.startswith("light_gain.")]
        if gains:
            variances = np.diag(uncertainty.matrix)[gains]
            rms = 100 * float(np.sqrt(np.mean(variances)))
            yield Limit("intensity of the lights, rms ±", rms, 0.5, "%", "white")
    if colours is not None:
        for name, fit in colours.fits.items():
            median = float(np.median(fit.held_out))
            yield Limit(f"patches that were left out, median ΔE2000, camera {name}", median, 1.0, "", "chart")


def uncertainty_at_the_boards(fit: BundleFit, camera: int, distance_mm: float) -> Floats:
    """Return the standard deviation (N,) in mm of a camera's projection of points at the boards' distance, for the N
    cells of the image that boards covered; infinite where they covered none.
    """
    lens = fit.rig.lenses[camera]
    grid = image_grid(lens.size, *GRID)
    covered = grid[covered_cells(fit, camera)]
    if len(covered) == 0:
        return np.array([np.inf])
    return projection_sigma(fit, camera, covered, distance_mm) * distance_mm / float(lens.values[0])


def covered_cells(fit: BundleFit, camera: int) -> NDArray[np.bool_]:
    """Return a mask (rows · columns,) of the cells of the grid that contain an inlier corner."""
    columns, rows = GRID
    width, height = fit.rig.lenses[camera].size
    corners_px = fit.corners.pixels[fit.inliers & (fit.corners.camera == camera)]
    cell = np.clip((corners_px / [width, height] * [columns, rows]).astype(int), 0, [columns - 1, rows - 1])
    covered = np.zeros(columns * rows, dtype=bool)
    covered[cell[:, 1] * columns + cell[:, 0]] = True
    return covered


def _advice(
    folder: RawFolder,
    limits: list[Limit],
    cameras: CamerasStep,
    lights: LightsStep | None,
    intensity: IntensityStep | None,
    colours: ColourStep | None,
    wrong: tuple[str, ...],
) -> str:
    """Return a sentence on what to photograph again and what this would improve; errors fall with the square root of
    the number of photographs.
    """
    worst = max(limits, key=lambda one: one.value / one.limit)
    if not worst.is_kept:
        places = 0 if lights is None else len({view.place for view in lights.views})
        return _retake_advice(worst, places, has_suspicions=bool(wrong))
    if lights is None:
        return (
            "Photograph a mirror sphere light by light in three or more places: without it the lights are where the"
            " list says."
        )
    if intensity is None:
        return "Photograph a white sphere light by light: without it all lights count as equally bright."
    if colours is None and len(folder.channels) == CHANNELS_OF_COLOUR:
        return "Photograph a colour chart under all lights: without it the asset has no colours."
    empty = {name: 1 - float(covered_cells(cameras.fit, number).mean()) for number, name in enumerate(cameras.names)}
    name, share = max(empty.items(), key=lambda pair: pair[1])
    if share > MAX_EMPTY:
        return (
            f"All limits are kept; boards nearer to the edges of camera {name} would cover the {share:.0%} of its image"
            " that none touches."
        )
    if len(cameras.fit.rig.places) < FEW_PLACES:
        return (
            f"All limits are kept by {len(cameras.fit.rig.places)} places of the board; twice as many would make lenses"
            " 1.4 times surer."
        )
    return "All limits are kept; nothing needs to be photographed again."


def _retake_advice(worst: Limit, sphere_places: int, *, has_suspicions: bool) -> str:
    """Return a sentence on what would improve the figure that exceeds its limit most.

    Args:
        worst: this figure.
        sphere_places: number of places of the mirror sphere.
        has_suspicions: whether something looks wrong, which is to be mended before photographs are counted.
    """
    what = SUBJECTS[worst.improved_by]
    if not math.isfinite(worst.value):
        return f"Photograph {what} again: {worst.what} is not known at all, and {worst.limit:g} {worst.unit} are asked."
    off = f"{worst.what} is {worst.value:.2g} {worst.unit} against {worst.limit:g} {worst.unit}"
    if has_suspicions:
        return f"First mend what looks wrong: {off}."
    times = math.ceil((worst.value / worst.limit) ** 2)
    is_short_of_places = worst.improved_by == "spheres" and sphere_places < ENOUGH_SPHERE_PLACES
    if times > MAX_TIMES or is_short_of_places or worst.improved_by == "white":
        return f"Photograph {what} again: {off}; {RETAKE_PLANS[worst.improved_by]}."
    return (
        f"Photograph {what} again: {off}; {times} times as many photographs would meet it, if chance alone is the"
        " cause."
    )
