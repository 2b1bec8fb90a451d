"""A whole calibration session from arrays, without images: the measurements of every step, and ways to spoil them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from services.calibrate.cameras.bundle import Rig, fit_bundle
from services.calibrate.cameras.models import ModelChoice
from services.calibrate.cameras.sightings import View
from services.calibrate.colour.transform import fit_colour
from services.calibrate.lights.intensity import WhitePhoto, WhiteSphere, fit_intensity, shading
from services.calibrate.lights.lit_by import seem_lit_by_others
from services.calibrate.lights.mirror import PosedCamera, highlight_points, nearest_point
from services.calibrate.lights.problem import SphereView
from services.calibrate.session.boards import CamerasStep
from services.calibrate.session.charts import ColourStep
from services.calibrate.session.photos import Black
from services.calibrate.session.spheres import IntensityStep, LightsStep, place_lights
from services.calibrate.session.suspicions import suspicions
from services.core.raw.records import RawFolder
from services.phantom.lab.session import XYZ_FROM_SENSOR
from tests.support.board_sessions import photographed, true_rig
from tests.support.sphere_sessions import STEEPEST, dome_lights, outline_points

Floats = NDArray[np.float64]
NAMES = ("left", "middle", "right")
N_LIGHTS = 6
MIRROR_MM, WHITE_MM, REFLECTANCE = 22.0, 15.0, np.array([0.92, 0.9, 0.88])
PLACES_MM = np.array([[-40.0, -25, -30], [40, 25, 30], [-40, 25, 30], [40, -25, -30]])
LIST_SE_MM = 4.0
"""Standard error of a coordinate in the list of light positions, as measured with a tape in a dome."""


@dataclass(frozen=True)
class ArraySession:
    """Measurements of a calibration session, as the arrays that its steps read."""

    rig: Rig
    boards: tuple[View, ...]
    mirrors: tuple[SphereView, ...]
    white: tuple[WhitePhoto, ...]
    white_spheres: tuple[WhiteSphere, ...]
    listed_mm: Floats
    rgb: Floats
    xyz: Floats

    @property
    def folder(self) -> RawFolder:
        """A stand-in for the raw folder that gives the names of lights, board photographs, cameras and channels."""
        lights = [SimpleNamespace(name=f"L{n}") for n in range(N_LIGHTS)]
        camera = SimpleNamespace(full_counts=4095.0)
        return cast(
            "RawFolder",
            SimpleNamespace(
                light=lights,
                frame=[SimpleNamespace(file=view.name, kind="board", exposure_s=0.02) for view in self.boards]
                + self._mirror_frames(),
                camera_named=lambda _: camera,
                channels=("red", "green", "blue"),
            ),
        )

    def _mirror_frames(self) -> list[SimpleNamespace]:
        return [
            SimpleNamespace(
                file=f"{NAMES[view.camera]}_s{view.place}_L{light}",
                kind="mirror-sphere",
                exposure_s=0.02,
                camera=NAMES[view.camera],
                sphere="ball",
                place=f"s{view.place}",
                light=f"L{light}",
            )
            for view in self.mirrors
            for light in view.lights
        ]

    def cameras(self) -> CamerasStep:
        """Fit the bundle of the board photographs, starting at the true rig."""
        choices = {name: ModelChoice(lens, 0.1, {}) for name, lens in zip(NAMES, self.rig.lenses, strict=True)}
        return CamerasStep(NAMES, fit_bundle(self.boards, self.rig), choices, self.boards, ())

    def lights(self, cameras: CamerasStep) -> LightsStep:
        """Fit the lights' positions with the cameras that the boards gave."""
        names = [f"camera {NAMES[view.camera]}, ball, s{view.place}" for view in self.mirrors]
        lights = [f"L{n}" for n in range(N_LIGHTS)]
        return place_lights(
            self.mirrors, names, cameras.posed_cameras, lights, cameras.camera_covariance, self.listed_mm
        )

    def intensity(self, lights: LightsStep) -> IntensityStep:
        """Fit the lights' intensities with the light positions and cameras that the highlights gave."""
        where = np.full((N_LIGHTS, 3), np.nan)
        where[lights.fit.lights] = lights.fit.positions_mm
        names = [f"L{n}" for n in range(N_LIGHTS)]
        fit = fit_intensity(self.white, lights.fit.cameras, self.white_spheres, where, names)
        others = seem_lit_by_others(self.white, lights.fit.cameras, self.white_spheres, where)
        return IntensityStep(fit, self.white, np.zeros(3), None, others)

    def colours(self) -> ColourStep:
        """Fit the colour transform of one camera."""
        return ColourStep({"left": fit_colour(self.rgb, self.xyz, "left")}, {"left": self.rgb}, self.xyz, None)


def told_of(
    session: ArraySession,
    cameras: CamerasStep,
    lights: LightsStep | None = None,
    intensity: IntensityStep | None = None,
    colours: ColourStep | None = None,
    **more: dict[str, str],
) -> list[str]:
    """All suspicions of a session's steps."""
    black = {name: Black(64.0, 2.0) for name in NAMES}
    return list(suspicions(session.folder, cameras, lights, intensity, colours, black, **more))


def array_session(seed: int) -> ArraySession:
    """A good session: 3 cameras, 8 places of a board, 6 lights on a mirror sphere in 4 places, white spheres in 2, a
    chart.
    """
    random = np.random.default_rng(seed)
    rig = true_rig(random, 8)
    cameras = tuple(PosedCamera(lens, pose) for lens, pose in zip(rig.lenses, rig.cameras, strict=True))
    aim = nearest_point(
        np.array([camera.centre_mm for camera in cameras]), np.array([camera.rotation[2] for camera in cameras])
    )
    towards = np.mean([camera.centre_mm for camera in cameras], axis=0) - aim
    lights = turned(dome_lights(N_LIGHTS, random), towards) + aim
    centres = turned(PLACES_MM, towards) + aim
    mirrors = tuple(
        mirror_view(random, camera, number, place, centre, lights)
        for place, centre in enumerate(centres)
        for number, camera in enumerate(cameras)
    )
    spheres = tuple(WhiteSphere(centre, WHITE_MM, REFLECTANCE) for centre in centres[:2])
    intensity = random.uniform(0.6, 1.4, (N_LIGHTS, 3))
    white = tuple(
        white_photo(random, camera, number, place, light, lights[light], intensity[light], sphere)
        for place, sphere in enumerate(spheres)
        for number, camera in enumerate(cameras)
        for light in range(N_LIGHTS)
    )
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    listed = lights @ turn.T + random.uniform(-500, 500, 3) + random.normal(0, LIST_SE_MM, lights.shape)
    rgb = random.uniform(0.04, 0.85, (24, 3))
    xyz = rgb @ XYZ_FROM_SENSOR.T
    seen = rgb * (1 + random.normal(0, 0.003, rgb.shape))
    boards = tuple(photographed(rig, 0.1, random))
    return ArraySession(rig, boards, mirrors, white, spheres, listed, seen, xyz)


def mirror_view(
    random: np.random.Generator, camera: PosedCamera, number: int, place: int, centre: Floats, lights: Floats
) -> SphereView:
    """Draw a mirror sphere as one camera sees it, with errors of 0.1 px on its edge and of 0.05 px on highlights."""
    edge, outward = outline_points(camera, centre, MIRROR_MM, 60)
    edge = edge + outward * (0.1 + random.normal(0, 0.1, (60, 1)))
    points = highlight_points(camera.centre_mm, lights, centre, MIRROR_MM)
    to_camera = (camera.centre_mm - points) / np.linalg.norm(camera.centre_mm - points, axis=1, keepdims=True)
    seen = np.flatnonzero(((points - centre) / MIRROR_MM * to_camera).sum(axis=1) > STEEPEST)
    return SphereView(
        number, place, MIRROR_MM, edge, seen, camera.project(points[seen]) + random.normal(0, 0.05, (len(seen), 2))
    )


def white_photo(
    random: np.random.Generator,
    camera: PosedCamera,
    number: int,
    place: int,
    light: int,
    where: Floats,
    intensity: Floats,
    sphere: WhiteSphere,
) -> WhitePhoto:
    """Draw a white sphere under one light, on a grid of pixels with 1 % noise."""
    aim = camera.project(sphere.centre_mm[None])[0]
    grid = np.stack(np.meshgrid(*(np.arange(-100, 101, 12.5),) * 2), axis=-1).reshape(-1, 2) + aim
    factor, _ = shading(camera, sphere, where, grid)
    clean = 1e6 * factor[:, None] * REFLECTANCE * intensity
    return WhitePhoto(number, place, light, grid, clean * (1 + random.normal(0, 0.01, clean.shape)))


def turned(points: Floats, away: Floats) -> Floats:
    """Rotate points (N, 3) about the origin so that their z axis points along a direction (3,)."""
    z = away / np.linalg.norm(away)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.asarray(points @ np.array([x, np.cross(z, x), z]))


def exchanged(views: tuple[View, ...], one: int, two: int) -> tuple[View, ...]:
    """Swap two board photographs, so that each stands under the other's camera, place and name."""
    first, second = views[one], views[two]
    swapped = list(views)
    swapped[one] = replace(second, camera=first.camera, place=first.place, name=first.name)
    swapped[two] = replace(first, camera=second.camera, place=second.place, name=second.name)
    return tuple(swapped)
