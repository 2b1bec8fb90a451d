"""Intensity of each light in each channel, from white spheres of known reflectance.

A Lambertian sphere under a point light has the radiance ρ ÷ π · I · cos θ ÷ d². Every photograph of a white sphere
under one light gives one slope per channel: the ratio of its pixels to the known factor ρ ÷ π · cos θ ÷ d². The
slope's logarithm is the sum of a term of the camera (counts per radiance), a term of the light (its intensity) and,
where the sphere stood in several places, a term of the lights' common lobe, so all photographs together form a linear
least-squares problem. Only the product of intensity and counts per radiance is measurable, so the mean of the
intensities is set to 1 in every channel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.calibrate.lights.mirror import PosedCamera
from services.core.errors import CaptureInputError
from services.core.robust import robust_sigma

Floats = NDArray[np.float64]
MIN_COSINE_OF_LIGHT = 0.35
"""Smallest cosine of the angle between light and normal at a usable pixel. Beyond 70° the light grazes: cos changes by
a tenth within 2°, and no paint is Lambertian there."""
MIN_COSINE_OF_VIEW = 0.5
"""Smallest cosine of the angle between camera and normal at a usable pixel: towards the outline pixels mix with the
background."""
MIN_PIXELS = 50
"""Smallest number of usable pixels of a photograph."""
MIN_PLACES_FOR_A_LOBE = 3
"""Smallest number of places of the sphere from which a lobe is estimated."""
LOBE_SIGMAS = 4.0
"""Smallest exponent of the lobe in its standard errors; a smaller one is set to 0."""
SIGMA_FLOOR = 1e-6
"""Smallest relative standard deviation of a slope, for exact synthetic photographs."""
WRONG_SIGMAS, MIN_WRONG = 8.0, 0.05
"""Limits of a photograph's residual against the fit of the others, in robust standard deviations and as a relative
error. A photograph beyond both was taken with another light, exposure or level than raw.toml says."""
MAX_WRONG_SHARE = 0.1
"""Largest fraction of photographs that are left out as wrong: with more of them the whole list is not trustworthy."""
MIN_FREEDOM = 0.2
"""Smallest value of 1 − leverage with which a photograph is compared with the others."""


@dataclass(frozen=True)
class WhitePhoto:
    """One photograph of a white sphere under one light.

    Attributes:
        camera: number of the camera.
        place: number of the place where the sphere stood.
        light: number of the light.
        pixels: positions (N, 2) of the photograph's pixels, without saturated ones.
        values: counts above black, divided by exposure, gain, level and the lens's vignetting (N, C).
        file: name of the photograph's file, for messages.
    """

    camera: int
    place: int
    light: int
    pixels: Floats
    values: Floats
    file: str = ""


@dataclass(frozen=True)
class WhiteSphere:
    """A white sphere at one place: its centre (3,) and radius in mm, and its reflectance by channel (C,)."""

    centre_mm: Floats
    radius_mm: float
    reflectance: Floats


@dataclass(frozen=True)
class IntensityFit:
    """Fitted intensities of the lights and sensitivities of the cameras, by channel.

    Attributes:
        intensity: intensity (L, C) of each light towards the mean of the spheres, with mean 1 over the lights; NaN for
            lights that no photograph shows.
        radiance_per_count: radiance per count of each camera (K, C).
        exponent: exponent of the lights' common lobe about their direction to the spheres' mean.
        exponent_se: standard error of the exponent.
        covariance: covariance (S · C, S · C) of the logarithms of the intensities of the S lights that photographs
            show, by light and then channel, from the photographs' scatter and the uncertainty of the positions.
        by_positions: derivative (S · C, 3 L) of those logarithms with respect to the lights' positions, by which errors
            of the positions are propagated jointly.
        sigma: relative standard deviation of one photograph's slope, by channel (C,).
        residuals: residuals (U, C) of the logarithms of the slopes of the U usable photographs, including those that
            were left out as wrong.
        used: numbers of the usable photographs (U,).
    """

    intensity: Floats
    radiance_per_count: Floats
    exponent: float
    exponent_se: float
    covariance: Floats
    by_positions: Floats
    sigma: Floats
    residuals: Floats
    used: tuple[int, ...]


def shading(
    camera: PosedCamera, sphere: WhiteSphere, light_mm: Floats, pixels: Floats
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the factor cos θ ÷ (π d²) in mm⁻² at pixels (N,), and a mask (N,) of the pixels that show a usable part of
    the sphere.
    """
    rays, origin = camera.directions(pixels), camera.centre_mm
    towards = sphere.centre_mm - origin
    middle = rays @ towards
    inside = middle**2 - towards @ towards + sphere.radius_mm**2
    points = origin + (middle - np.sqrt(np.maximum(inside, 0)))[:, None] * rays
    normals = (points - sphere.centre_mm) / sphere.radius_mm
    to_light = light_mm - points
    distance = np.linalg.norm(to_light, axis=1)
    cosine = (normals * to_light).sum(axis=1) / distance
    view = -(normals * rays).sum(axis=1)
    usable = (inside > 0) & (cosine > MIN_COSINE_OF_LIGHT) & (view > MIN_COSINE_OF_VIEW)
    return np.asarray(cosine / (np.pi * distance**2)), np.asarray(usable)


def slope(photo: WhitePhoto, camera: PosedCamera, sphere: WhiteSphere, light_mm: Floats) -> Floats | None:
    """Return the ratio (C,) of the values to the known factor times the reflectance, by least squares under shot noise;
    None where fewer than ``MIN_PIXELS`` pixels are usable.
    """
    factor, usable = shading(camera, sphere, light_mm, photo.pixels)
    if np.count_nonzero(usable) < MIN_PIXELS:
        return None
    # The variance of shot noise is proportional to the value and so to the factor: with weights 1 ÷ factor the
    # least-squares slope is a ratio of sums.
    return np.asarray(photo.values[usable].sum(axis=0) / (factor[usable].sum() * sphere.reflectance))


def fit_intensity(
    photos: Sequence[WhitePhoto],
    cameras: Sequence[PosedCamera],
    spheres: Sequence[WhiteSphere],
    lights_mm: Floats,
    light_names: Sequence[str],
    position_covariance: Floats | None = None,
) -> IntensityFit:
    """Fit the intensities of all lights to all photographs.

    Args:
        photos: photographs of white spheres, each under one light.
        cameras: calibrated cameras.
        spheres: white spheres by place.
        lights_mm: positions of the lights (L, 3).
        light_names: names of the lights, for messages.
        position_covariance: covariance of the lights' positions (3 L, 3 L) in mm²; exact positions by default.

    Raises:
        CaptureInputError: no photograph has enough pixels, or a sphere is dark in some channel under a light.
    """
    found = [slope(one, cameras[one.camera], spheres[one.place], lights_mm[one.light]) for one in photos]
    numbers = tuple(number for number, value in enumerate(found) if value is not None)
    usable = [(photo, value) for photo, value in zip(photos, found, strict=True) if value is not None]
    if not usable:
        raise CaptureInputError("No photograph of a white sphere shows enough of its lit side; photograph it larger.")
    if dark := next((photo for photo, value in usable if value.min() <= 0), None):
        raise CaptureInputError(
            f"Light {light_names[dark.light]} leaves a white sphere dark in some channel; look whether it was on, or"
            " another in its place."
        )
    used = [photo for photo, _ in usable]
    logs = np.log(np.array([value for _, value in usable]))
    shown_lights = np.unique([photo.light for photo in used])
    cosines = _log_cosines(used, spheres, lights_mm)
    design = _design(used, shown_lights, len(cameras))
    good = _without_wrong_photographs(design, logs)
    places = {photo.place for photo, is_good in zip(used, good, strict=True) if is_good}
    exponent, exponent_se = _common_exponent(design[good], logs[good].mean(axis=1), cosines[good], len(places))
    logs = logs - exponent * cosines[:, None]
    solver = np.zeros((design.shape[1], len(used)))
    solver[:, good] = np.linalg.pinv(design[good])
    solution = solver @ logs
    residuals = logs - design @ solution
    freedom = max(np.count_nonzero(good) - np.linalg.matrix_rank(design[good]), 1)
    sigma = np.maximum(np.sqrt((residuals[good] ** 2).sum(axis=0) / freedom), SIGMA_FLOOR)
    relative = np.exp(solution[: len(shown_lights)])
    mean = relative.mean(axis=0)
    intensity = np.full((len(lights_mm), relative.shape[1]), np.nan)
    intensity[shown_lights] = relative / mean
    steps = np.concatenate([np.zeros((1, relative.shape[1])), solution[len(shown_lights) :]])
    by_positions = _by_positions(used, cameras, spheres, lights_mm)
    covariance, gain_by_positions = _covariance(
        solver[: len(shown_lights)], by_positions, sigma, relative, position_covariance
    )
    return IntensityFit(
        intensity,
        1 / (mean * np.exp(steps)),
        exponent,
        exponent_se,
        covariance,
        gain_by_positions,
        sigma,
        residuals,
        numbers,
    )


def _without_wrong_photographs(design: Floats, logs: Floats) -> NDArray[np.bool_]:
    """Return a mask (R,) of the photographs that agree with the others.

    Photographs leave one by one, the one with the largest residual first, because it also biases the fit of the other
    photographs of its light.

    Args:
        design: design matrix (R, P) of the photographs' lights and cameras.
        logs: logarithms of the slopes (R, C).
    """
    brightness, good = logs.mean(axis=1), np.ones(len(logs), dtype=bool)
    for _ in range(int(MAX_WRONG_SHARE * len(logs))):
        hat = design[good] @ np.linalg.pinv(design[good])
        # Take each residual against the fit of the other photographs. A photograph whose leverage is near 1 determines
        # its light alone, so the others cannot contradict it.
        one_minus_leverage = 1 - np.diag(hat)
        off = np.where(
            one_minus_leverage > MIN_FREEDOM,
            (brightness[good] - hat @ brightness[good]) / np.maximum(one_minus_leverage, MIN_FREEDOM),
            0.0,
        )
        scatter = robust_sigma(off)
        worst = int(np.argmax(np.abs(off)))
        if abs(off[worst]) <= max(WRONG_SIGMAS * scatter, MIN_WRONG):
            break
        good[np.flatnonzero(good)[worst]] = False
    return good


def _design(photos: Sequence[WhitePhoto], shown_lights: NDArray[np.int64], n_cameras: int) -> Floats:
    """Return the design matrix (R, P): a column for each light in ``shown_lights``, then one for each camera but the
    first.
    """
    design = np.zeros((len(photos), len(shown_lights) + n_cameras - 1))
    for row, photo in enumerate(photos):
        design[row, np.searchsorted(shown_lights, photo.light)] = 1
        if photo.camera > 0:
            design[row, len(shown_lights) + photo.camera - 1] = 1
    return design


def _log_cosines(photos: Sequence[WhitePhoto], spheres: Sequence[WhiteSphere], lights_mm: Floats) -> Floats:
    """Return the logarithm (R,) of the cosine between a light's directions to the photographed sphere and to the mean
    of all spheres.
    """
    middle = np.mean([sphere.centre_mm for sphere in spheres], axis=0)
    lights = lights_mm[[photo.light for photo in photos]]
    centres = np.array([spheres[photo.place].centre_mm for photo in photos])
    axis, aim = middle - lights, centres - lights
    cosine = (axis * aim).sum(axis=1) / (np.linalg.norm(axis, axis=1) * np.linalg.norm(aim, axis=1))
    return np.asarray(np.log(np.minimum(cosine, 1.0)))


def _common_exponent(design: Floats, logs: Floats, cosines: Floats, n_places: int) -> tuple[float, float]:
    """Return the exponent of the lobe and its standard error; the exponent is 0 where it is not significant or there
    are fewer than ``MIN_PLACES_FOR_A_LOBE`` places.
    """
    if n_places < MIN_PLACES_FOR_A_LOBE:
        return 0.0, float("inf")
    full = np.column_stack([design, cosines])
    inverse = np.linalg.pinv(full.T @ full)
    solution = inverse @ full.T @ logs
    freedom = max(len(logs) - np.linalg.matrix_rank(full), 1)
    error = float(np.sqrt(inverse[-1, -1] * ((logs - full @ solution) ** 2).sum() / freedom))
    exponent = float(solution[-1])
    return (exponent, error) if exponent > LOBE_SIGMAS * error else (0.0, error)


def _by_positions(
    photos: Sequence[WhitePhoto], cameras: Sequence[PosedCamera], spheres: Sequence[WhiteSphere], lights_mm: Floats
) -> Floats:
    """Return the derivative (R, 3 L) in 1/mm of the slopes' logarithms with respect to the lights' positions, by
    central differences with a step of 0.1 mm.
    """
    derivative, step = np.zeros((len(photos), 3 * len(lights_mm))), 0.1
    for row, photo in enumerate(photos):
        for axis in range(3):
            logs = []
            for sign in (-1, 1):
                where = lights_mm[photo.light].copy()
                where[axis] += sign * step
                moved = slope(photo, cameras[photo.camera], spheres[photo.place], where)
                logs.append(np.log(moved).mean() if moved is not None else 0.0)
            derivative[row, 3 * photo.light + axis] = (logs[1] - logs[0]) / (2 * step)
    return derivative


def _covariance(
    solver: Floats,
    by_positions: Floats,
    sigma: Floats,
    relative: Floats,
    position_covariance: Floats | None,
) -> tuple[Floats, Floats]:
    """Return the covariance (S · C, S · C) of the logarithms of the intensities, by light and then channel, and their
    derivative (S · C, 3 L) with respect to the lights' positions.
    """
    n_lights, n_channels = relative.shape
    size = n_lights * n_channels
    covariance, gain_by_positions = np.zeros((size, size)), np.zeros((size, by_positions.shape[1]))
    for channel in range(n_channels):
        # Apply the gauge, a mean intensity of 1: subtract from each logarithm's error the mean of all, weighted by the
        # intensities.
        gauge = np.eye(n_lights) - relative[:, channel] / relative[:, channel].sum()
        rows = np.arange(n_lights) * n_channels + channel
        own = gauge @ solver
        covariance[np.ix_(rows, rows)] = sigma[channel] ** 2 * own @ own.T
        gain_by_positions[rows] = own @ by_positions
    if position_covariance is not None:
        covariance += gain_by_positions @ position_covariance @ gain_by_positions.T
    return covariance, gain_by_positions
