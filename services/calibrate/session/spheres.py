"""Steps of the lights: positions from mirror spheres, intensities from white spheres."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from services.calibrate.lights.centres import OutlineView, fit_centres
from services.calibrate.lights.images import Outline, about_outline, find_highlight, find_outline
from services.calibrate.lights.intensity import IntensityFit, WhitePhoto, WhiteSphere, fit_intensity
from services.calibrate.lights.listed import AlignedList, align_list
from services.calibrate.lights.mirror import Eye
from services.calibrate.lights.positions import LightsFit, fit_lights
from services.calibrate.lights.problem import SphereView
from services.calibrate.session.flats import relative_square
from services.calibrate.session.photos import Photos
from services.core.errors import CaptureInputError
from services.core.raw.records import FrameKind, RawFrame

Floats = NDArray[np.float64]
Fall = tuple[float, float, float]
WHITE_PIXELS_ACROSS = 60
"""Approximate number of samples across a white sphere: more add no information, because paint and lens limit it."""


LIGHTS_OF_AN_OUTLINE = 12
"""Largest number of photographs whose mean shows a sphere's outline: so many lights light it from all sides, and every
further photograph would have to be read a second time."""
MIN_UNSATURATED = 0.5
"""Smallest fraction of unsaturated samples on a white sphere: a glint saturates a few, too long an exposure the whole
lit side."""


@dataclass(frozen=True)
class LightsStep:
    """Positions of the lights.

    Attributes:
        fit: fit to highlights and outlines.
        views: mirror spheres in photographs.
        view_names: names of the views, for messages.
        aligned: the list of ``raw.toml`` aligned with the fit; None where the list is missing or incomplete, or too few
            lights were found.
        no_highlight: files in which no highlight was found.
    """

    fit: LightsFit
    views: tuple[SphereView, ...]
    view_names: tuple[str, ...]
    aligned: AlignedList | None
    no_highlight: tuple[str, ...]


@dataclass(frozen=True)
class IntensityStep:
    """Intensities of the lights.

    Attributes:
        fit: fitted intensities of the lights and sensitivities of the cameras.
        photos: photographs of white spheres.
        middle_mm: mean of the white spheres' centres (3,), towards which intensities are stated.
        reflectance_se: relative standard error of the white spheres' reflectance; None where raw.toml does not state
            it.
    """

    fit: IntensityFit
    photos: tuple[WhitePhoto, ...]
    middle_mm: Floats
    reflectance_se: float | None = None


def find_lights(photos: Photos, eyes: Sequence[Eye], covariance: Floats, distance_mm: float) -> LightsStep | None:
    """Find the positions of the lights from the folder's mirror spheres; None without any.

    Args:
        photos: the folder's frames.
        eyes: the calibrated cameras.
        covariance: covariance (C, C) of the lens values and pose of each camera in turn.
        distance_mm: approximate distance of the spheres from the cameras.

    Raises:
        CaptureInputError: no outline of the given radius is found in a photograph, or a light has only one highlight.
    """
    groups = _groups(photos, "mirror-sphere")
    if not groups:
        return None
    folder = photos.folder
    cameras, lights = [camera.name for camera in folder.camera], [light.name for light in folder.light]
    places = list(dict.fromkeys(place for _, place in groups))
    radii = {sphere.name: sphere.radius_mm for sphere in folder.sphere}
    views, names, missed = [], [], []
    for (camera, place), frames in groups.items():
        radius, eye = radii[str(frames[0].sphere)], eyes[cameras.index(camera)]
        outline = _outline(photos, frames, eye, radius, distance_mm)
        found = {}
        width, height = folder.camera_named(camera).size
        part = about_outline(outline.points_px, (height, width))
        first = np.array([part[1].start, part[0].start])
        for frame in frames:
            where = find_highlight(photos.grey(frame, part), outline.points_px - first)
            if where is None:
                missed.append(frame.file)
            else:
                found[lights.index(str(frame.light))] = where + first
        numbers = np.array(sorted(found), dtype=np.int64)
        pixels = np.array([found[number] for number in numbers]).reshape(-1, 2)
        views.append(SphereView(cameras.index(camera), places.index(place), radius, outline.points_px, numbers, pixels))
        names.append(f"camera {camera}, {place}")
    listed = np.array([light.position_mm or (np.nan,) * 3 for light in folder.light], dtype=np.float64)
    return place_lights(views, names, eyes, lights, covariance, listed, tuple(missed))


def place_lights(
    views: Sequence[SphereView],
    view_names: Sequence[str],
    eyes: Sequence[Eye],
    lights: Sequence[str],
    covariance: Floats,
    listed_mm: Floats,
    missed: tuple[str, ...] = (),
) -> LightsStep:
    """Fit the positions of the lights to the spheres that were found, and align the list with them if it is complete.

    Args:
        views: mirror spheres in photographs.
        view_names: names of the views, for messages.
        eyes: the calibrated cameras.
        lights: names of the lights.
        covariance: covariance (C, C) of the lens values and pose of each camera in turn.
        listed_mm: positions that raw.toml lists (L, 3), NaN where it lists none.
        missed: files in which no highlight was found.

    Raises:
        CaptureInputError: a light has only one highlight.
    """
    fit = fit_lights(views, eyes, lights, covariance)
    aligned = None
    if np.isfinite(listed_mm).all():
        found = np.full((len(lights), 3), np.nan)
        found[fit.lights] = fit.positions_mm
        aligned = align_list(listed_mm, found)
    return LightsStep(fit, tuple(views), tuple(view_names), aligned, missed)


def measure_intensity(
    photos: Photos,
    eyes: Sequence[Eye],
    lights_mm: Floats,
    distance_mm: float,
    falls: Mapping[str, Fall] = MappingProxyType({}),
) -> IntensityStep | None:
    """Measure the intensities of the lights from the folder's white spheres; None without any.

    Args:
        photos: the folder's frames.
        eyes: calibrated cameras.
        lights_mm: positions of the lights (L, 3), NaN where unknown.
        distance_mm: approximate distance of the spheres from the cameras.
        falls: vignetting a, b, c by camera.

    Raises:
        CaptureInputError: no outline is found in a photograph, a sphere is saturated or dark, or no photograph has
            enough usable pixels.
    """
    groups = _groups(photos, "white-sphere")
    if not groups:
        return None
    folder = photos.folder
    cameras, lights = [camera.name for camera in folder.camera], [light.name for light in folder.light]
    places = list(dict.fromkeys(place for _, place in groups))
    things = {sphere.name: sphere for sphere in folder.sphere}
    outlines: list[OutlineView] = []
    found: list[WhitePhoto] = []
    thing_of = {place: things[str(frames[0].sphere)] for (_, place), frames in groups.items()}
    for (camera, place), frames in groups.items():
        eye, radius = eyes[cameras.index(camera)], thing_of[place].radius_mm
        outline = _outline(photos, frames, eye, radius, distance_mm)
        outlines.append(OutlineView(cameras.index(camera), places.index(place), radius, outline.points_px))
        for frame in frames:
            number = lights.index(str(frame.light))
            pixels, values = _sampled(photos, frame, outline)
            if (fall := falls.get(camera)) is not None:
                q = relative_square(pixels, eye.lens.size, eye.lens.values[2:4])
                values = values / (1 + q * (fall[0] + q * (fall[1] + q * fall[2])))[:, None]
            found.append(WhitePhoto(cameras.index(camera), places.index(place), number, pixels, values))
    centres = fit_centres(outlines, eyes)
    spheres = [
        WhiteSphere(centre, thing_of[place].radius_mm, np.array(thing_of[place].reflectance))
        for centre, place in zip(centres, places, strict=True)
    ]
    middle = np.mean([sphere.centre_mm for sphere in spheres], axis=0)
    told = [thing.reflectance_se for thing in thing_of.values()]
    # Among several spheres the largest standard error counts; if one sphere has none, there is none for all.
    se = None if None in told else max(one for one in told if one is not None)
    return IntensityStep(fit_intensity(found, eyes, spheres, lights_mm, lights), tuple(found), middle, se)


def _groups(photos: Photos, kind: FrameKind) -> dict[tuple[str, str], list[RawFrame]]:
    """Return the frames of spheres by camera and place; all frames of a sphere without a place are of one place."""
    groups: dict[tuple[str, str], list[RawFrame]] = defaultdict(list)
    for frame in photos.folder.frame:
        if frame.kind == kind:
            groups[frame.camera, f"{frame.sphere}, {frame.place or 'its place'}"].append(frame)
    return groups


def _outline(photos: Photos, frames: Sequence[RawFrame], eye: Eye, radius_mm: float, distance_mm: float) -> Outline:
    """Find a sphere's outline in the mean of photographs under lights from all sides, because each light alone leaves a
    part of the outline dark.
    """
    chosen = [frames[k] for k in np.unique(np.linspace(0, len(frames) - 1, LIGHTS_OF_AN_OUTLINE).astype(int))]
    total = photos.grey(chosen[0]).copy()
    for frame in chosen[1:]:
        total += photos.grey(frame)
    outline = find_outline(total / np.float32(len(chosen)), eye, radius_mm, distance_mm)
    if outline is None:
        first = frames[0]
        raise CaptureInputError(
            f"Frame {first.file} (camera {first.camera}) shows no whole outline of sphere {first.sphere} of radius"
            f" {radius_mm:g} mm; photograph it whole against a background of another brightness, or correct radius_mm."
        )
    return outline


def _sampled(photos: Photos, frame: RawFrame, outline: Outline) -> tuple[Floats, Floats]:
    """Return pixels (N, 2) and light by channel (N, C) on a grid over a sphere, without saturated values."""
    width, height = photos.folder.camera_named(frame.camera).size
    channels = photos.channels(frame, about_outline(outline.points_px, (height, width)))
    points = outline.points_px - np.array(channels.first_px)
    middle = points.mean(axis=0)
    reach = float(np.linalg.norm(points - middle, axis=1).mean())
    step = max(int(2 * reach / channels.pixel / WHITE_PIXELS_ACROSS), 1)
    low = np.maximum(((middle - reach) / channels.pixel).astype(int), 0)
    high = np.minimum(((middle + reach) / channels.pixel).astype(int) + 1, channels.values.shape[1::-1])
    columns, rows = (grid.ravel() for grid in np.meshgrid(*(np.arange(low[k], high[k], step) for k in (0, 1))))
    good = ~channels.saturated[rows, columns]
    if good.mean() < MIN_UNSATURATED:
        raise CaptureInputError(
            f"Frame {frame.file} (camera {frame.camera}, light {frame.light}) is saturated on {1 - good.mean():.0%} of"
            " the white sphere; expose it less."
        )
    rows, columns = rows[good], columns[good]
    return channels.centres(rows, columns), channels.values[rows, columns].astype(np.float64)
