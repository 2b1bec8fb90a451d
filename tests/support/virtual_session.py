"""A raw folder of a calibration session whose truth is known: boards by projection, spheres by their formulae, with shot noise."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.calibrate.cameras.boards import corners_on_board, opencv_board
from services.calibrate.cameras.bundle import pose_apply
from services.calibrate.cameras.lens import Lens
from services.calibrate.cameras.rotations import inverse_pose, pose_matrix, pose_vector, rotation_matrix
from services.calibrate.lights.mirror import Eye, highlight_points
from services.core.raw.targets import Board
from tests.support.board_sessions import looking
from tests.support.raw_folders import write_toml
from tests.support.sphere_sessions import dome_lights

Floats = NDArray[np.float64]
SIZE, BITS, BLACK = (640, 480), 12, 64
FOCAL_PX = 1350.0
BOARD = Board(name="plate", type="charuco", squares=(9, 7), square_mm=12, marker_mm=9, dictionary="DICT_5X5_100")
TEXELS_PER_MM = 10
FULL_WELL = 20_000
"""Electrons at the largest count."""
MIRROR_MM, WHITE_MM = 18.0, 15.0
REFLECTANCE = (0.9, 0.9, 0.9)
CENTRES_MM = np.array([[-32.0, -22, 0], [34, -18, 15], [0, 24, -15], [-4, 0, 30]])
NEUTRALS = (0.9, 0.59, 0.36, 0.19, 0.09, 0.032)
XYZ_FROM_SENSOR = np.array([[0.62, 0.22, 0.12], [0.28, 0.70, 0.02], [0.03, 0.12, 0.68]])


@dataclass(frozen=True)
class Truth:
    """What a session was made from; all in the frame of its first board."""

    eyes: tuple[Eye, ...]
    lights_mm: Floats
    intensity: Floats
    radiance_per_count: Floats


class Maker:
    """Writes frames of one session."""

    def __init__(self, root: Path, random: np.random.Generator, n_cameras: int, n_lights: int, n_places: int) -> None:
        self.root, self.random = root, random
        azimuths = np.deg2rad(np.linspace(-30, 30, n_cameras))
        where = [450 * np.array([np.sin(a), 0.2, np.cos(a)]) for a in azimuths]
        values = [FOCAL_PX, FOCAL_PX * 1.002, 322.0, 237.0, -0.12, 0.08, 0.0006, -0.0004]
        self.eyes = tuple(Eye(Lens(SIZE, np.array(values)), looking(place, np.zeros(3))) for place in where)
        self.lights_mm = dome_lights(n_lights, random)
        intensity = random.uniform(0.6, 1.4, (n_lights, 3))
        self.intensity = intensity / intensity.mean(axis=0)
        # A white sphere half a metre from a light of intensity 1 comes out at half of the range in a second.
        self.scale = np.array([[1.0, 0.9, 1.1]]) * random.uniform(0.95, 1.05, (n_cameras, 1)) * 0.9 / np.pi / 1e6 / 2000
        self.places = self._places(n_places)
        self.frames: list[dict[str, Any]] = []
        self._texture: NDArray[np.float32] | None = None
        columns, rows = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
        self.pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
        self.rays = [eye.directions(self.pixels) for eye in self.eyes]

    def _places(self, count: int) -> list[Floats]:
        """Poses (6,) world_from_board that turn the plate towards the cameras."""
        centre, places = corners_on_board(BOARD).mean(axis=0), []
        for number in range(count):
            turn = np.array([np.pi, 0, 0]) + self.random.uniform(-0.5, 0.5, 3) * (number > 0)
            matrix = pose_matrix(np.concatenate([turn, np.zeros(3)]))
            matrix[:3, 3] = self.random.uniform(-14, 14, 3) - matrix[:3, :3] @ centre
            places.append(pose_vector(matrix))
        return places

    def write(self, camera: int, kind: str, counts: Floats, **others: Any) -> None:
        """Add shot noise and black, round, and list the frame; counts are those above black (H, W, 3)."""
        electrons = FULL_WELL / (2**BITS - 1 - BLACK)
        noisy = counts + self.random.normal(size=counts.shape) * np.sqrt(np.maximum(counts, 0) / electrons + 4.0)
        file = f"{kind}-{len(self.frames):03d}.npy"
        np.save(self.root / file, np.clip(np.round(noisy + BLACK), 0, 2**BITS - 1).astype(np.uint16))
        self.frames.append({"camera": f"c{camera}", "file": file, "kind": kind, "exposure_s": 1.0, **others})

    def board(self, camera: int, place: int) -> None:
        """A board by the plane that its pose is, from a blurred texture."""
        import cv2

        if self._texture is None:
            drawn = opencv_board(BOARD).generateImage((9 * 12 * TEXELS_PER_MM, 7 * 12 * TEXELS_PER_MM))
            self._texture = cv2.GaussianBlur(drawn.astype(np.float32) / 255, (0, 0), 0.18 * TEXELS_PER_MM)
        eye, pose = self.eyes[camera], inverse_pose(self.places[place])
        origin = pose_apply(pose, eye.centre_mm[None])[0]
        rays = self.rays[camera] @ rotation_matrix(pose[:3]).T
        on_plate = (origin[:2] - rays[:, :2] * (origin[2] / rays[:, 2:3])).reshape(SIZE[1], SIZE[0], 2)
        maps = (on_plate * TEXELS_PER_MM - 0.5).astype(np.float32)
        seen = cv2.remap(self._texture, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderValue=0.8)
        counts = 200 + 2200 * seen.astype(np.float64)
        self.write(camera, "board", np.repeat(counts[..., None], 3, axis=2), board="plate", place=f"p{place}")

    def sphere(self, camera: int, place: int, light: int, kind: str) -> None:
        """A mirror or a white sphere before a wall, under one light."""
        eye, centre = self.eyes[camera], CENTRES_MM[place]
        radius = MIRROR_MM if kind == "mirror" else WHITE_MM
        towards, rays = centre - eye.centre_mm, self.rays[camera]
        middle = rays @ towards
        nearest = np.sqrt(np.maximum(towards @ towards - middle**2, 0))
        pixel_mm = middle / FOCAL_PX
        covered = np.clip(0.5 - (nearest - radius) / pixel_mm, 0, 1)[:, None]
        depth = middle - np.sqrt(np.maximum(radius**2 - nearest**2, 0))
        points = eye.centre_mm + depth[:, None] * rays
        if kind == "mirror":
            wall, body = np.full((len(rays), 3), 500.0), np.full((len(rays), 3), 60.0)
        else:
            normals, to_light = (points - centre) / radius, self.lights_mm[light] - points
            distance = np.linalg.norm(to_light, axis=1, keepdims=True)
            cosine = np.maximum((normals * to_light).sum(axis=1, keepdims=True) / distance, 0)
            radiance = np.array(REFLECTANCE) / np.pi * self.intensity[light] * cosine / distance**2
            wall, body = np.full((len(rays), 3), 40.0), radiance / self.scale[camera] + 1.0
        counts = covered * body + (1 - covered) * wall
        if kind == "mirror":
            spot = highlight_points(eye.centre_mm, self.lights_mm[light : light + 1], centre, radius)
            normal, view = (spot[0] - centre) / radius, eye.centre_mm - spot[0]
            if normal @ view / np.linalg.norm(view) > 0.3:
                off = ((self.pixels - eye.project(spot)) ** 2).sum(axis=1, keepdims=True)
                counts = counts + 2500 * np.exp(-off / (2 * 1.2**2))
        others = {"light": f"L{light}", "sphere": kind, "place": f"s{place}"}
        self.write(camera, f"{kind}-sphere", counts.reshape(SIZE[1], SIZE[0], 3), **others)

    def chart(self, camera: int, xyz: Floats) -> None:
        """A chart that fills the middle, as the sensor sees colours."""
        counts = np.full((SIZE[1], SIZE[0], 3), 100.0)
        rgb = xyz @ np.linalg.inv(XYZ_FROM_SENSOR).T
        for patch in range(24):
            column, row = patch % 6, patch // 6
            counts[60 + 90 * row : 130 + 90 * row, 50 + 90 * column : 120 + 90 * column] = 3000 * rgb[patch]
        corners = [[85.0, 95.0], [535.0, 95.0], [535.0, 365.0], [85.0, 365.0]]
        self.write(camera, "chart", counts, chart="colours", corners_px=corners)


def write_virtual_session(
    root: Path,
    random: np.random.Generator,
    *,
    n_cameras: int = 2,
    n_lights: int = 6,
    n_places: int = 10,
    n_mirror: int = 4,
    n_white: int = 2,
) -> Truth:
    """Write a raw folder of a session, and tell what is true in the frame of its first board."""
    maker = Maker(root, random, n_cameras, n_lights, n_places)
    cameras = range(n_cameras)
    for camera in cameras:
        for _ in range(2):
            maker.write(camera, "black", np.zeros((SIZE[1], SIZE[0], 3)))
    for place in range(n_places):
        for camera in cameras:
            maker.board(camera, place)
    for kind, count in (("mirror", n_mirror), ("white", n_white)):
        for place in range(count):
            for camera in cameras:
                for light in range(n_lights):
                    maker.sphere(camera, place, light, kind)
    xyz = random.uniform(0.05, 0.8, (24, 3)) @ XYZ_FROM_SENSOR.T
    xyz[18:] = np.array(NEUTRALS)[:, None] * XYZ_FROM_SENSOR.sum(axis=1)
    for camera in cameras:
        maker.chart(camera, xyz)
    table = "\n".join(",".join(f"{100 * value:.6f}" for value in row) for row in xyz)
    (root / "chart.csv").write_text(f"X,Y,Z\n{table}\n")
    tree: dict[str, Any] = {
        "units": "mm",
        "camera": [{"name": f"c{camera}", "size": list(SIZE), "bits": BITS} for camera in cameras],
        "light": [{"name": f"L{n}", "position_mm": where.tolist()} for n, where in enumerate(maker.lights_mm)],
        "frame": maker.frames,
        "board": [{key: list(v) if isinstance(v, tuple) else v for key, v in BOARD.model_dump().items()}],
        "sphere": [
            {"name": "mirror", "kind": "mirror", "radius_mm": MIRROR_MM},
            {"name": "white", "kind": "white", "radius_mm": WHITE_MM, "reflectance": list(REFLECTANCE)},
        ],
        "chart": [{"name": "colours", "type": "colorchecker-24", "reference": "chart.csv"}],
    }
    write_toml(root, tree)
    return _in_first_frame(maker)


def _in_first_frame(maker: Maker) -> Truth:
    """Everything moved to the frame of the board at its first place."""
    first = pose_matrix(maker.places[0])
    eyes = tuple(Eye(eye.lens, pose_vector(pose_matrix(eye.pose) @ first)) for eye in maker.eyes)
    lights = pose_apply(inverse_pose(maker.places[0]), maker.lights_mm)
    return Truth(eyes, lights, maker.intensity, maker.scale)
