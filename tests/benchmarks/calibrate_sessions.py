"""Whole calibration sessions with random errors: the errors of cameras, lights, intensities and colours, and whether
the stated standard errors match them.

``python -m tests.benchmarks.calibrate_sessions --draws 12 --json FILE`` takes about ten seconds of processor time per
draw, and continues where the file already holds draws; ``--width 5184`` draws cameras of 20 megapixels instead of 2.

Boards are drawn by projection with Gaussian errors of 0.1 px, spheres by their formulae (outlines 0.1 px plus a common
shift of up to 0.2 px per camera, highlights 0.05 px, white pixels 1 % shot noise); chart patches have errors of 0.3 %.
Each step receives the results of the step before, never the truth.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.calibrate.cameras.boards import corners_on_board
from services.calibrate.cameras.bundle import BundleFit, Rig, fit_bundle, pose_apply
from services.calibrate.cameras.sightings import View
from services.calibrate.cameras.start import first_lens, first_rig
from services.calibrate.colour.transform import fit_colour
from services.calibrate.lights.centres import OutlineView, fit_centres
from services.calibrate.lights.intensity import IntensityFit, WhitePhoto, WhiteSphere, fit_intensity, shading
from services.calibrate.lights.mirror import PosedCamera, highlight_points, nearest_point
from services.calibrate.lights.positions import LightsFit, fit_lights
from services.calibrate.lights.problem import SphereView
from services.calibrate.reweighted import solve_reweighted
from services.phantom.lab.session import XYZ_FROM_SENSOR
from tests.support.board_sessions import CHESSBOARD, SIZE, photographed, true_rig
from tests.support.sphere_sessions import STEEPEST, dome_lights, outline_points

Floats = NDArray[np.float64]
NAMES = ["left", "middle", "right"]
N_PLACES, N_LIGHTS = 20, 12
MIRROR_MM, WHITE_MM = 28.0, 20.0
MIRROR_PLACES_MM = np.array(
    [*([x, y, z] for x in (-62.0, 62.0) for y in (-38.0, 38.0) for z in (-50.0, 50.0)), [0, 0, 75], [0, 0, -80]]
)
"""Centres of the mirror sphere relative to the point at which the cameras look: the corners of a box, one place nearer
and one farther. The precision depends on their distances and their number; they are as far apart as the images can show
whole spheres of this radius."""
WHITE_PLACES_MM = np.array([[-32.0, -20, -20], [32, 20, -10], [0, 0, 30]])
REFLECTANCE = np.array([0.92, 0.9, 0.88])
SHOT, PATCH_ERROR = 0.01, 0.003
COUNTS = 1e3
"""Counts of a white sphere's photograph for radiance 1."""
MARGIN_PX = 5.0
"""Least distance between a whole sphere and the image's border, which the search for its edge needs."""


@dataclass(frozen=True)
class Spheres:
    """Photographs of a session's spheres, and the fits to them."""

    views: list[SphereView]
    fit: LightsFit
    photos: list[WhitePhoto]
    white_mm: Floats
    """Fitted centres (P, 3) of the white spheres, mm."""
    intensity: IntensityFit
    true_intensity: Floats


def one_session(seed: int, width: int = SIZE[0]) -> dict[str, Any]:
    """Errors of one session as rms values, and as whitened or normalised scores."""
    random = np.random.default_rng(1000 + seed)
    size = (width, width * SIZE[1] // SIZE[0])
    rig = true_rig(random, N_PLACES, size)
    # The teeth are at the point about which the boards were turned: the centre of the board at the first place.
    teeth = corners_on_board(CHESSBOARD).mean(axis=0)
    fit, _ = found_rig(random, rig, NAMES)
    layout = fit.layout
    columns = np.concatenate([np.r_[layout.lens_columns(k), layout.camera_columns(k)] for k in range(3)])
    covariance = fit.covariance[np.ix_(columns, columns)]
    true, found = posed_cameras_of(rig), posed_cameras_of(fit.rig)
    error = layout.pack(fit.rig) - layout.pack(rig)
    shift_mm, turn_deg = _seen_at_the_teeth(true, found, teeth)
    told: dict[str, Any] = {"seed": seed, "shift_mm": shift_mm, "turn_deg": turn_deg}
    told["z_cameras"] = _whitened(error[columns], covariance)
    # The lights are on the cameras' side of the teeth.
    lights = _turned(dome_lights(N_LIGHTS, random), away_from(true, teeth)) + teeth
    told |= _lights_and_intensity(random, true, found, covariance, lights, teeth)
    told["delta_e"] = _colour(random)
    return told


def posed_cameras_of(rig: Rig) -> tuple[PosedCamera, ...]:
    """The cameras of a rig."""
    return tuple(PosedCamera(lens, pose) for lens, pose in zip(rig.lenses, rig.cameras, strict=True))


def away_from(cameras: tuple[PosedCamera, ...], point_mm: Floats) -> Floats:
    """Vector (3,) in mm from a point to the mean of the cameras' centres."""
    return np.asarray(np.mean([camera.centre_mm for camera in cameras], axis=0) - point_mm)


def found_rig(random: np.random.Generator, rig: Rig, names: list[str]) -> tuple[BundleFit, list[View]]:
    """Fit a rig to board photographs with errors of 0.1 px; returns the fit and the photographs' corners."""
    views = photographed(rig, 0.1, random)
    lenses = [
        first_lens([view for view in views if view.camera == k], rig.lenses[k].size, "radial-tangential-4", name)
        for k, name in enumerate(names)
    ]
    return fit_bundle(views, first_rig(views, lenses, names)), views


def _lights_and_intensity(
    random: np.random.Generator,
    true: tuple[PosedCamera, ...],
    found: tuple[PosedCamera, ...],
    covariance: Floats,
    lights: Floats,
    teeth: Floats,
) -> dict[str, Any]:
    names = [f"L{n}" for n in range(N_LIGHTS)]
    spheres = photographed_spheres(random, true, found, covariance, lights, teeth, names)
    fit, answer = spheres.fit, spheres.intensity
    off = fit.positions_mm - lights[fit.lights]
    count = 3 * len(fit.lights)
    told = {"lights_mm": float(np.sqrt((off**2).sum(axis=1).mean())), "mirror_views": len(spheres.views)}
    told |= {"lights_se_mm": float(np.sqrt(np.trace(fit.covariance[:count, :count]) / len(fit.lights)))}
    logs = np.log(answer.intensity / spheres.true_intensity)
    scores = {"z_lights": _whitened(off.ravel(), fit.covariance[:count, :count])}
    scores["z_intensity"] = (logs.ravel() / np.sqrt(np.diag(answer.covariance))).tolist()
    return told | scores | {"intensity": float(np.sqrt(np.mean(logs**2)))}


def photographed_spheres(
    random: np.random.Generator,
    true: tuple[PosedCamera, ...],
    found: tuple[PosedCamera, ...],
    covariance: Floats,
    lights: Floats,
    teeth: Floats,
    names: list[str],
    intensity: Floats | None = None,
    reflectance_off: float = 0.0,
) -> Spheres:
    """Draw photographs of mirror and white spheres by the true cameras, and fit lights and intensities to them with the
    fitted cameras.

    Args:
        true: true cameras.
        found: fitted cameras.
        covariance: covariance of the fitted cameras.
        lights: true positions of the lights (L, 3), mm.
        teeth: point near which the cameras look (3,), mm.
        intensity: true intensities (L, C) of mean 1; drawn where not given.
        reflectance_off: relative excess of the white spheres' reflectance over the stated one.
    """
    looked_at = nearest_point(
        np.array([camera.centre_mm for camera in true]), np.array([camera.rotation[2] for camera in true])
    )
    away = away_from(true, teeth)
    mirror, white = (
        _turned(places, away) + looked_at + random.normal(0, 2, places.shape)
        for places in (MIRROR_PLACES_MM, WHITE_PLACES_MM)
    )
    shifts = random.uniform(-0.2, 0.2, 3)
    views = _mirror_views(random, true, shifts, lights, mirror)
    fit = fit_lights(views, found, names, covariance)
    count = 3 * len(fit.lights)
    # Fit the white spheres with the cameras that boards and mirror spheres gave.
    if intensity is None:
        intensity = random.uniform(0.6, 1.4, (len(lights), 3))
        intensity /= intensity.mean(axis=0)
    said = REFLECTANCE[: intensity.shape[1]]
    outlines, photos = [], []
    for place, centre in enumerate(white):
        for number, camera in enumerate(true):
            edge = _outline(random, camera, centre, WHITE_MM, shifts[number])
            if edge is None:
                continue
            outlines.append(OutlineView(number, place, WHITE_MM, edge))
            photos += [
                _photo(random, camera, centre, number, place, light, lights[light], (1 + reflectance_off) * said * own)
                for light, own in enumerate(intensity)
            ]
    centres = fit_centres(outlines, fit.cameras)
    spheres = [WhiteSphere(centre, WHITE_MM, said) for centre in centres]
    answer = fit_intensity(photos, fit.cameras, spheres, fit.positions_mm, names, fit.covariance[:count, :count])
    return Spheres(views, fit, photos, centres, answer, intensity)


def _mirror_views(
    random: np.random.Generator, cameras: tuple[PosedCamera, ...], shifts: Floats, lights: Floats, centres: Floats
) -> list[SphereView]:
    """Outlines and highlights of the mirror sphere, at the places where at least one camera shows the whole sphere."""
    views: list[SphereView] = []
    place = 0
    for centre in centres:
        here = []
        for number, camera in enumerate(cameras):
            if (edge := _outline(random, camera, centre, MIRROR_MM, shifts[number])) is None:
                continue
            points = highlight_points(camera.centre_mm, lights, centre, MIRROR_MM)
            to_camera = (camera.centre_mm - points) / np.linalg.norm(camera.centre_mm - points, axis=1, keepdims=True)
            seen = np.flatnonzero(((points - centre) / MIRROR_MM * to_camera).sum(axis=1) > STEEPEST)
            pixels = camera.project(points[seen]) + random.normal(0, 0.05, (len(seen), 2))
            here.append(SphereView(number, place, MIRROR_MM, edge, seen, pixels))
        views += here
        place += bool(here)
    return views


def _outline(
    random: np.random.Generator, camera: PosedCamera, centre: Floats, radius: float, shift: float
) -> Floats | None:
    """Edge points (90, 2) of a sphere with their errors; None where the image does not show the whole sphere."""
    edge, outward = outline_points(camera, centre, radius, 90)
    if not ((edge > MARGIN_PX) & (edge < np.array(camera.lens.size) - MARGIN_PX)).all():
        return None
    return np.asarray(edge + outward * (shift + random.normal(0, 0.1, (90, 1))))


def _photo(
    random: np.random.Generator,
    camera: PosedCamera,
    centre: Floats,
    number: int,
    place: int,
    light: int,
    light_mm: Floats,
    radiosity: Floats,
) -> WhitePhoto:
    """Draw pixels of a white sphere; ``radiosity`` (C,) is its reflectance times the light's intensity."""
    aim = camera.project(centre[None])[0]
    reach = 1.05 * WHITE_MM * camera.lens.values[0] / np.linalg.norm(centre - camera.centre_mm)
    grid = np.stack(np.meshgrid(*(np.linspace(-reach, reach, 21),) * 2), axis=-1).reshape(-1, 2) + aim
    factor, usable = shading(camera, WhiteSphere(centre, WHITE_MM, np.ones(1)), light_mm, grid)
    clean = COUNTS * factor[:, None] * radiosity
    level = clean[usable].mean() if usable.any() else 0.0
    noise = SHOT * np.sqrt(np.maximum(clean, 0) * level)
    return WhitePhoto(number, place, light, grid, clean + random.normal(size=clean.shape) * noise)


def _colour(random: np.random.Generator) -> float:
    """Median colour difference ΔE2000 of chart patches that are left out of the fit in turn."""
    rgb = random.uniform(0.04, 0.85, (24, 3))
    seen = rgb * (1 + random.normal(0, PATCH_ERROR, rgb.shape))
    return float(np.median(fit_colour(seen, rgb @ XYZ_FROM_SENSOR.T, "camera").held_out))


def _seen_at_the_teeth(
    true: tuple[PosedCamera, ...], found: tuple[PosedCamera, ...], teeth: Floats
) -> tuple[float, float]:
    """Apparent displacement (mm) and rotation (deg) of teeth of 10 mm when the fitted cameras are used in place of the
    true ones.
    """
    points = np.array([[x, y, z] for x in (-5.0, 5) for y in (-5.0, 5) for z in (-5.0, 5)])
    drawn = [camera.project(points + teeth) for camera in true]

    def off(pose: Floats) -> Floats:
        moved = pose_apply(pose, points) + teeth
        return np.concatenate(
            [(camera.project(moved) - seen).ravel() for camera, seen in zip(found, drawn, strict=True)]
        )

    def slope(pose: Floats) -> Floats:
        steps = 1e-5 * np.eye(6)
        return np.stack([(off(pose + step) - off(pose - step)) / 2e-5 for step in steps], axis=1)

    pose = solve_reweighted(off, slope, np.zeros(6))
    return float(np.linalg.norm(pose[3:])), float(np.rad2deg(np.linalg.norm(pose[:3])))


def _turned(points: Floats, away: Floats) -> Floats:
    """Rotate points (N, 3) about the origin so that their z axis points along a direction (3,)."""
    z = away / np.linalg.norm(away)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.asarray(points @ np.array([x, np.cross(z, x), z]))


def _whitened(error: Floats, covariance: Floats) -> list[float]:
    scale = np.sqrt(np.diag(covariance))
    factor = np.linalg.cholesky(covariance / np.outer(scale, scale))
    return [float(one) for one in np.linalg.solve(factor, error / scale)]


def summary(draws: list[dict[str, Any]]) -> dict[str, float]:
    """Rms of each error over the draws, and rms of the pooled scores."""
    told = {"draws": float(len(draws))}
    for key in ("shift_mm", "turn_deg", "lights_mm", "lights_se_mm", "mirror_views", "intensity", "delta_e"):
        told[f"rms_{key}"] = float(np.sqrt(np.mean([draw[key] ** 2 for draw in draws])))
    for key in ("z_cameras", "z_lights", "z_intensity"):
        told[f"rms_{key}"] = float(np.sqrt(np.mean(np.concatenate([draw[key] for draw in draws]) ** 2)))
    return told


def main() -> None:
    """Draw sessions and print their summary."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=12)
    parser.add_argument("--width", type=int, default=SIZE[0], help="of images, pixels; they are three quarters as high")
    parser.add_argument("--json", type=Path, default=None)
    options = parser.parse_args()
    draws: list[dict[str, Any]] = []
    if options.json is not None and options.json.exists():
        draws = json.loads(options.json.read_text())["draws"]
    for seed in range(len(draws), options.draws):
        draws.append(one_session(seed, options.width))
        if options.json is not None:
            options.json.write_text(json.dumps({"summary": summary(draws), "draws": draws}))
        print(seed, {key: round(value, 5) for key, value in draws[-1].items() if isinstance(value, float)}, flush=True)
    print(json.dumps(summary(draws), indent=1))


if __name__ == "__main__":
    main()
