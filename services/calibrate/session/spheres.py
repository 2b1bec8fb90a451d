"""Steps of the lights: positions from mirror spheres, intensities from white spheres."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from services.calibrate.lights.centres import OutlineView, fit_centres
from services.calibrate.lights.images import Outline, about_outline, find_highlight, find_outline
from services.calibrate.lights.intensity import IntensityFit, WhitePhoto, WhiteSphere, fit_intensity
from services.calibrate.lights.listed import AlignedList, align_list
from services.calibrate.lights.lit_by import seem_lit_by_others
from services.calibrate.lights.mirror import PosedCamera
from services.calibrate.lights.positions import LightsFit, fit_lights
from services.calibrate.lights.problem import SphereView
from services.calibrate.session.flats import relative_square
from services.calibrate.session.photos import Photos
from services.core.errors import CaptureInputError
from services.core.raw.records import FrameKind, RawFrame

Floats = NDArray[np.float64]
Vignetting = tuple[float, float, float]
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
        lit_by_others: photographs whose shading shows another light than the stated one, by their number in ``photos``.
    """

    fit: IntensityFit
    photos: tuple[WhitePhoto, ...]
    middle_mm: Floats
    reflectance_se: float | None = None
    lit_by_others: Mapping[int, int] = field(default_factory=dict)


def find_lights(
    photos: Photos, cameras: Sequence[PosedCamera], covariance: Floats | None, distance_mm: float
) -> LightsStep | None:
    """Find the positions of the lights from the folder's mirror spheres; None without any.

    Args:
        photos: the folder's frames.
        cameras: the calibrated cameras.
        covariance: covariance (C, C) of the lens values and pose of each camera in turn; None for exact cameras.
        distance_mm: approximate distance of the spheres from the cameras.

    Raises:
        CaptureInputError: no outline of the given radius is found in a photograph, or a light has only one highlight.
    """
    groups = _groups(photos, "mirror-sphere")
    if not groups:
        return None
    folder = photos.folder
    camera_names, light_names = [one.name for one in folder.camera], [light.name for light in folder.light]
    places = list(dict.fromkeys(place for _, place in groups))
    radii = {sphere.name: sphere.radius_mm for sphere in folder.sphere}
    views, view_names, missed = [], [], []
    for (camera_name, place), frames in groups.items():
        radius, camera = radii[str(frames[0].sphere)], cameras[camera_names.index(camera_name)]
        outline = _outline(photos, frames, camera, radius, distance_mm)
        found = {}
        width, height = folder.camera_named(camera_name).size
        part = about_outline(outline.points_px, (height, width))
        first = np.array([part[1].start, part[0].start])
        for frame in frames:
            where = find_highlight(photos.grey(frame, part), outline.points_px - first)
            if where is None:
                missed.append(frame.file)
            else:
                found[light_names.index(str(frame.light))] = where + first
        numbers = np.array(sorted(found), dtype=np.int64)
        pixels = np.array([found[number] for number in numbers]).reshape(-1, 2)
        views.append(
            SphereView(camera_names.index(camera_name), places.index(place), radius, outline.points_px, numbers, pixels)
        )
        view_names.append(f"camera {camera_name}, {place}")
    listed = np.array([light.position_mm or (np.nan,) * 3 for light in folder.light], dtype=np.float64)
    return place_lights(views, view_names, cameras, light_names, covariance, listed, tuple(missed))


def place_lights(
    views: Sequence[SphereView],
    view_names: Sequence[str],
    cameras: Sequence[PosedCamera],
    light_names: Sequence[str],
    covariance: Floats | None,
    listed_mm: Floats,
    missed: tuple[str, ...] = (),
) -> LightsStep:
    """Fit the positions of the lights to the spheres that were found, and align the list with them if it is complete.

    Args:
        views: mirror spheres in photographs.
        view_names: names of the views, for messages.
        cameras: the calibrated cameras.
        light_names: names of the lights.
        covariance: covariance (C, C) of the lens values and pose of each camera in turn; None for exact cameras.
        listed_mm: positions that raw.toml lists (L, 3), NaN where it lists none.
        missed: files in which no highlight was found.

    Raises:
        CaptureInputError: a light has only one highlight.
    """
    fit = fit_lights(views, cameras, light_names, covariance)
    aligned = None
    if np.isfinite(listed_mm).all():
        found = np.full((len(light_names), 3), np.nan)
        found[fit.lights] = fit.positions_mm
        aligned = align_list(listed_mm, found)
    return LightsStep(fit, tuple(views), tuple(view_names), aligned, missed)


def measure_intensity(
    photos: Photos,
    cameras: Sequence[PosedCamera],
    lights_mm: Floats,
    distance_mm: float,
    vignettings: Mapping[str, Vignetting] = MappingProxyType({}),
) -> IntensityStep | None:
    """Measure the intensities of the lights from the folder's white spheres; None without any.

    Args:
        photos: the folder's frames.
        cameras: calibrated cameras.
        lights_mm: positions of the lights (L, 3), NaN where unknown.
        distance_mm: approximate distance of the spheres from the cameras.
        vignettings: vignetting a, b, c by camera.

    Raises:
        CaptureInputError: no outline is found in a photograph, a sphere is saturated or dark, or no photograph has
            enough usable pixels.
    """
    groups = _groups(photos, "white-sphere")
    if not groups:
        return None
    folder = photos.folder
    camera_names, light_names = [one.name for one in folder.camera], [light.name for light in folder.light]
    places = list(dict.fromkeys(place for _, place in groups))
    spheres_by_name = {sphere.name: sphere for sphere in folder.sphere}
    outlines: list[OutlineView] = []
    found: list[WhitePhoto] = []
    sphere_at = {place: spheres_by_name[str(frames[0].sphere)] for (_, place), frames in groups.items()}
    for (camera_name, place), frames in groups.items():
        camera, radius = cameras[camera_names.index(camera_name)], sphere_at[place].radius_mm
        outline = _outline(photos, frames, camera, radius, distance_mm)
        outlines.append(OutlineView(camera_names.index(camera_name), places.index(place), radius, outline.points_px))
        for frame in frames:
            number = light_names.index(str(frame.light))
            pixels, values = _sampled(photos, frame, outline)
            if (vignetting := vignettings.get(camera_name)) is not None:
                q = relative_square(pixels, camera.lens.size, camera.lens.values[2:4])
                values = values / (1 + q * (vignetting[0] + q * (vignetting[1] + q * vignetting[2])))[:, None]
            found.append(
                WhitePhoto(camera_names.index(camera_name), places.index(place), number, pixels, values, frame.file)
            )
    centres = fit_centres(outlines, cameras)
    spheres = [
        WhiteSphere(centre, sphere_at[place].radius_mm, np.array(sphere_at[place].reflectance))
        for centre, place in zip(centres, places, strict=True)
    ]
    middle = np.mean([sphere.centre_mm for sphere in spheres], axis=0)
    stated_se = [sphere.reflectance_se for sphere in sphere_at.values()]
    # Among several spheres the largest standard error counts; if one sphere has none, there is none for all.
    se = None if None in stated_se else max(one for one in stated_se if one is not None)
    others = seem_lit_by_others(found, cameras, spheres, lights_mm)
    try:
        fit = fit_intensity(found, cameras, spheres, lights_mm, light_names)
    except CaptureInputError as error:
        if not others:
            raise
        number, light = next(iter(others.items()))
        own = found[number]
        raise CaptureInputError(
            f"{error} By its shading {own.file} shows light {light_names[light]} and not {light_names[own.light]}."
        ) from error
    return IntensityStep(fit, tuple(found), middle, se, others)


def _groups(photos: Photos, kind: FrameKind) -> dict[tuple[str, str], list[RawFrame]]:
    """Return the frames of spheres by camera and place; all frames of a sphere without a place are of one place."""
    groups: dict[tuple[str, str], list[RawFrame]] = defaultdict(list)
    for frame in photos.folder.frame:
        if frame.kind == kind:
            groups[frame.camera, place_of(frame)].append(frame)
    return groups


def place_of(frame: RawFrame) -> str:
    """Return the sphere of a frame and its place, in words."""
    return f"{frame.sphere}, {frame.place or 'its place'}"


def _outline(
    photos: Photos, frames: Sequence[RawFrame], camera: PosedCamera, radius_mm: float, distance_mm: float
) -> Outline:
    """Find a sphere's outline in the mean of photographs under lights from all sides, because each light alone leaves a
    part of the outline dark.
    """
    chosen = [frames[k] for k in np.unique(np.linspace(0, len(frames) - 1, LIGHTS_OF_AN_OUTLINE).astype(int))]
    total = photos.grey(chosen[0]).copy()
    for frame in chosen[1:]:
        total += photos.grey(frame)
    outline = find_outline(total / np.float32(len(chosen)), camera, radius_mm, distance_mm)
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
