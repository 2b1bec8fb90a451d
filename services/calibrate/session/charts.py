"""Step of the colours: from charts in photographs to each camera's transform to XYZ."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.calibrate.colour.chart import (
    COLUMNS,
    ROWS,
    Patches,
    find_corners,
    over_white,
    patch_means,
    read_reference,
)
from services.calibrate.colour.transform import ColourFit, fit_colour, least_squares_matrix
from services.calibrate.session.photos import Channels, Photos, to_eight_bit
from services.core.colour.cie import delta_e_2000, lab_from_xyz
from services.core.errors import CaptureInputError
from services.core.raw.records import RawFrame

Floats = NDArray[np.float64]
BETTER = 0.5
"""Largest ratio of another order's mean ΔE2000 to that of the given order with which the other order is reported. The
mean ΔE2000 is 20 and more for charts in a wrong order and less than 6 in the right one."""


@dataclass(frozen=True)
class ColourStep:
    """Colour transforms of every camera that photographed a chart.

    Attributes:
        fits: colour transform by camera.
        rgb: patch means divided by those of a perfect diffuser (24, 3), by camera; NaN for unusable patches.
        xyz: the chart's reference XYZ (24, 3).
        between_cameras: mean ΔE2000 of the cameras' colours from their common mean, over the patches that all of them
            show; None for a single camera.
    """

    fits: dict[str, ColourFit]
    rgb: dict[str, Floats]
    xyz: Floats
    between_cameras: float | None


def calibrate_colours(photos: Photos) -> ColourStep | None:
    """Fit each camera's transform from channels to XYZ; None without charts or without three channels.

    Raises:
        CaptureInputError: a chart is not found, is too bright or has no usable reference, or the frames show several
            charts.
    """
    frames = [frame for frame in photos.folder.frame if frame.kind == "chart"]
    if not frames or len(photos.folder.channels) != 3:
        return None
    charts = {chart.name: chart for chart in photos.folder.chart}
    fits, rgb = {}, {}
    if other := next((frame for frame in frames if frame.chart != frames[0].chart), None):
        raise CaptureInputError(
            f"Frame {other.file} shows chart {other.chart} and frame {frames[0].file} chart {frames[0].chart}; "
            "keep the frames of one chart in a session."
        )
    xyz = read_reference(photos.root / charts[str(frames[0].chart)].reference, str(frames[0].chart))
    for camera in dict.fromkeys(frame.camera for frame in frames):
        own_frames = [frame for frame in frames if frame.camera == camera]
        total = [_patches(photos, frame) for frame in own_frames]
        usable = np.logical_and.reduce([one.usable for one in total])
        # Sum photographs under single lights, because light is additive.
        summed = Patches(np.sum([one.means for one in total], axis=0), usable)
        patches = over_white(summed, xyz, camera)
        rgb[camera] = np.where(usable[:, None], patches, np.nan)
        fits[camera] = fit_colour(patches[usable], xyz[usable], camera)
    return ColourStep(fits, rgb, xyz, _between(fits, rgb))


def better_order(step: ColourStep) -> dict[str, tuple[str, float, float]]:
    """Return the cameras whose patches fit the reference far better in another order: for each camera that order in
    words, and the mean ΔE2000 of this order and of the given one.
    """
    numbers = np.arange(COLUMNS * ROWS).reshape(ROWS, COLUMNS)
    orders = {
        "turned by 180°": numbers[::-1, ::-1],
        "mirrored left to right": numbers[:, ::-1],
        "mirrored top to bottom": numbers[::-1],
    }
    better_orders = {}
    for camera, rgb in step.rgb.items():
        worse = float(step.fits[camera].fitted.mean())
        for name, order in orders.items():
            turned = rgb[order.ravel()]
            usable = np.isfinite(turned).all(axis=1)
            matrix = least_squares_matrix(turned[usable], step.xyz[usable])
            fitted_lab = lab_from_xyz(turned[usable] @ matrix.T)
            better = float(delta_e_2000(fitted_lab, lab_from_xyz(step.xyz[usable])).mean())
            if better < BETTER * worse:
                better_orders[camera] = (name, better, worse)
    return better_orders


def with_red_for_blue(step: ColourStep) -> list[str]:
    """Return the cameras whose red channel measures Z, and whose blue one does not: the two are interchanged.

    A linear transform fits a chart as well with interchanged channels, but every sensor's blue channel has the largest
    coefficient of Z.
    """
    found = []
    for camera, rgb in step.rgb.items():
        usable = np.isfinite(rgb).all(axis=1)
        z_by_channel = least_squares_matrix(rgb[usable], step.xyz[usable])[2]
        if z_by_channel[0] > z_by_channel[2]:
            found.append(camera)
    return found


def _patches(photos: Photos, frame: RawFrame) -> Patches:
    channels = photos.channels(frame)
    corners = np.array(frame.corners_px, dtype=np.float64) if frame.corners_px is not None else _search(channels)
    if corners is None:
        raise CaptureInputError(
            f"Frame {frame.file} (camera {frame.camera}) shows no chart that can be found; give corners_px, "
            "the centres of its patches 1, 6, 24 and 19."
        )
    return patch_means(channels.values, channels.saturated, corners / channels.pixel)


def _search(channels: Channels) -> Floats | None:
    bgr = np.stack([to_eight_bit(channels.values[..., k]) for k in (2, 1, 0)], axis=-1)
    found = find_corners(bgr)
    return None if found is None else found * channels.pixel


def _between(fits: dict[str, ColourFit], rgb: dict[str, Floats]) -> float | None:
    if len(fits) < 2:
        return None
    common = np.logical_and.reduce([np.isfinite(one).all(axis=1) for one in rgb.values()])
    labs = np.array([lab_from_xyz(fit.xyz(rgb[camera][common])) for camera, fit in fits.items()])
    return float(np.mean([delta_e_2000(one, labs.mean(axis=0)) for one in labs]))
