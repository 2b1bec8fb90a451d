"""The calibration session of a virtual laboratory: boards, mirror and white spheres, a uniform source and a chart.

All images are computed ray by ray from the geometry: the rays of the distorted lens are intersected with planes and
spheres, and a mirror's highlight follows from the law of reflection. No code of the calibration takes part, so that the
calibration is tested independently.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.calibration.record import Calibration
from services.core.raw.targets import Board
from services.phantom.lab.folder import RawWriter
from services.phantom.lab.rig import Lens
from services.phantom.lab.sensor import Sensor

Floats = NDArray[np.float64]
BOARD = Board(name="plate", type="charuco", squares=(9, 7), square_mm=7, marker_mm=5, dictionary="DICT_5X5_100")
TEXELS_PER_MM = 20
"""Resolution of the board's print."""
BLUR_MM = 0.08
"""Standard deviation of the blur by the board's print and the lens together, mm."""
TILT_RAD, SHIFT_MM = 0.5, (14.0, 8.0, 15.0)
"""Largest components of the board's rotation vector and of its displacement."""
MIRROR_MM, WHITE_MM = 16.0, 14.0
"""Radii of the mirror sphere and of the white sphere, mm."""
REFLECTANCE = (0.92, 0.91, 0.90)
"""Reflectance of the white sphere in red, green and blue."""
SPHERE_POSITIONS = np.array(
    [[-1.0, 0.4, -1.0], [1.0, -0.6, -0.9], [-0.9, -0.8, 1.0], [1.0, 0.6, 1.0], [0.0, 1.4, 0.1], [0.0, -1.4, -0.1]]
)
"""Positions (N, 3) of the spheres' centres, in units of the distance from the middle at which all of a sphere is
seen."""
MARGIN_MM, DEPTH_MM = 4.0, 10.0
"""Margin around a sphere in the picture, and largest unit of ``SPHERE_POSITIONS`` along the cameras' line of sight,
mm."""
WALL, BODY, GLINT = 0.25, 0.02, 1.5
"""Radiance of the wall behind the mirror sphere, of the mirror's own surface and of its highlights, relative to a white
diffuser."""
GLINT_PX = 1.6
"""Radius of a highlight: the LED's own image and the lens' blur."""
NEUTRALS = (0.9, 0.59, 0.36, 0.19, 0.09, 0.032)
"""Reflectances of a chart's grey row."""
XYZ_FROM_SENSOR = np.array([[0.62, 0.22, 0.12], [0.28, 0.70, 0.02], [0.03, 0.12, 0.68]])
"""True matrix (3, 3) from the sensor's red, green and blue to XYZ."""
CHART_CORNERS = np.array([[0.14, 0.2], [0.86, 0.2], [0.86, 0.8], [0.14, 0.8]])
"""Centres of the patches 1, 6, 24 and 19, as fractions of the image."""
WHITE_RADIANCE = 1 / (np.pi * 1e6)
"""Radiance of a perfect diffuser at a metre from a light of intensity 1."""
EXPOSURE_S = 0.02
"""Exposure time of all frames, seconds."""


class Session:
    """Renderer of the frames of one session."""

    def __init__(self, writer: RawWriter, random: np.random.Generator, n_places: int) -> None:
        self._writer = writer
        self._lenses = [Lens(camera) for camera in writer.rig.cameras]
        self._rays = [lens.rays() for lens in self._lenses]
        self.poses = [self._board_pose(random, is_first=number == 0) for number in range(n_places)]
        self.centres_mm = SPHERE_POSITIONS * self._largest_offset_mm()
        self._texture = _board_texture()

    def _largest_offset_mm(self) -> Floats:
        """Largest distances (3,) in mm of a sphere's centre from the middle, along x, y and z."""
        halves = [
            np.array(camera.size) / 2 * np.linalg.norm(np.array(camera.camera_from_world)[:3, 3]) / camera.K[0][0]
            for camera in self._writer.rig.cameras
        ]
        x, z = np.maximum(np.min(halves, axis=0) - MIRROR_MM - MARGIN_MM, 1.0)
        return np.array([x, min(x, DEPTH_MM), z])

    def _board_pose(self, random: np.random.Generator, *, is_first: bool) -> Floats:
        """Random pose (4, 4) world_from_board; the plate faces the cameras, which look along the world's −y."""
        from scipy.spatial.transform import Rotation

        facing = Rotation.from_euler("x", 90, degrees=True)
        tilt = 0.1 if is_first else TILT_RAD
        rotation = (Rotation.from_rotvec(random.uniform(-tilt, tilt, 3)) * facing).as_matrix()
        columns, rows = BOARD.squares
        middle = np.array([columns, rows, 0]) * BOARD.square_mm / 2
        pose = np.eye(4)
        pose[:3, :3] = rotation
        pose[:3, 3] = random.uniform(-1, 1, 3) * np.array(SHIFT_MM) * (not is_first) - rotation @ middle
        return pose

    def board(self, camera: int, place: int) -> None:
        """Photograph the board at one place by intersecting each ray with its plane."""
        import cv2

        centre, rays = self._rays[camera]
        board_from_world = np.linalg.inv(self.poses[place])
        origin, towards = board_from_world[:3, :3] @ centre + board_from_world[:3, 3], rays @ board_from_world[:3, :3].T
        on_plate = origin[:2] - towards[:, :2] * (origin[2] / towards[:, 2:3])
        width, height = self._writer.rig.cameras[camera].size
        maps = (on_plate.reshape(height, width, 2) * TEXELS_PER_MM - 0.5).astype(np.float32)
        texture = cv2.remap(self._texture, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderValue=0.8)
        light = WHITE_RADIANCE * (0.05 + 0.75 * texture.astype(np.float64))
        image = np.repeat(light[..., None], 3, axis=2)
        self._writer.shoot(camera, f"board{place}", image, EXPOSURE_S, kind="board", board="plate", place=f"p{place}")

    def sphere(self, camera: int, place: int, light: int, kind: str) -> None:
        """Photograph a mirror or white sphere in front of a wall, under one light."""
        taken, lamp = self._writer.rig.cameras[camera], self._writer.rig.lights[light]
        centre, rays = self._rays[camera]
        radius = MIRROR_MM if kind == "mirror" else WHITE_MM
        middle_mm = self.centres_mm[place]
        along = rays @ (middle_mm - centre)
        nearest = np.sqrt(np.maximum(((middle_mm - centre) ** 2).sum() - along**2, 0))
        # Compute the fraction of each pixel that the sphere covers, with its outline taken as straight in a pixel.
        covered = np.clip(0.5 - (nearest - radius) / (along / taken.K[0][0]), 0, 1)[:, None]
        if kind == "mirror":
            body = np.full((len(rays), 3), BODY) + self._glint(camera, middle_mm, radius, np.array(lamp.position_mm))
            body = body * WHITE_RADIANCE
        else:
            points = centre + (along - np.sqrt(np.maximum(radius**2 - nearest**2, 0)))[:, None] * rays
            to_light = np.array(lamp.position_mm) - points
            distance = np.linalg.norm(to_light, axis=1, keepdims=True)
            normals = (points - middle_mm) / radius
            cosine = np.maximum((normals * to_light).sum(axis=1, keepdims=True) / distance, 0)
            body = np.array(REFLECTANCE) / np.pi * np.array(lamp.intensity) * cosine / distance**2
        wall = WALL * WHITE_RADIANCE if kind == "mirror" else 0.02 * WHITE_RADIANCE
        image = (covered * body + (1 - covered) * wall).reshape(*taken.size[::-1], 3)
        frame_keys = {"light": lamp.name, "sphere": kind, "place": f"s{place}"}
        self._writer.shoot(camera, f"{kind}{place}_{lamp.name}", image, EXPOSURE_S, kind=f"{kind}-sphere", **frame_keys)

    def _glint(self, camera: int, middle_mm: Floats, radius_mm: float, light_mm: Floats) -> Floats:
        """Relative radiance (N, 1) of a highlight at all pixels; zero if the highlight would lie at the outline."""
        lens, camera_centre = self._lenses[camera], self._rays[camera][0]
        normal = camera_centre - middle_mm
        for _ in range(50):
            point = middle_mm + radius_mm * normal / np.linalg.norm(normal)
            to_camera, to_light = camera_centre - point, light_mm - point
            # Apply the law of reflection: the normal bisects the angle between eye and light.
            normal = to_camera / np.linalg.norm(to_camera) + to_light / np.linalg.norm(to_light)
        normal /= np.linalg.norm(normal)
        width, height = lens.camera.size
        if normal @ to_camera / np.linalg.norm(to_camera) < 0.3:
            return np.zeros((width * height, 1))
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        spot = lens.project(point[None])[0]
        squared_px = (x - spot[0]) ** 2 + (y - spot[1]) ** 2
        return np.asarray(GLINT * np.exp(-squared_px / (2 * GLINT_PX**2))).reshape(-1, 1)

    def flat(self, camera: int) -> None:
        """Photograph a uniform source that fills the view."""
        width, height = self._writer.rig.cameras[camera].size
        for number in range(2):
            uniform = np.full((height, width, 3), 0.6 * WHITE_RADIANCE)
            self._writer.shoot(camera, f"flat{number}", uniform, EXPOSURE_S, kind="flat")

    def chart(self, camera: int, xyz: Floats) -> None:
        """Photograph a chart of 24 patches with the colours ``xyz`` (24, 3) that fills the middle of the view."""
        width, height = self._writer.rig.cameras[camera].size
        image = np.full((height, width, 3), 0.03)
        rgb = xyz @ np.linalg.inv(XYZ_FROM_SENSOR).T
        corners = CHART_CORNERS * [width, height]
        step = (corners[2] - corners[0]) / [5, 3]
        for patch in range(24):
            x, y = corners[0] + step * [patch % 6, patch // 6]
            rows, columns = (
                slice(int(y - 0.4 * step[1]), int(y + 0.4 * step[1])),
                slice(int(x - 0.4 * step[0]), int(x + 0.4 * step[0])),
            )
            image[rows, columns] = rgb[patch]
        frame_keys = {"chart": "colours", "corners_px": corners.tolist()}
        self._writer.shoot(camera, "chart", image * WHITE_RADIANCE, EXPOSURE_S, kind="chart", **frame_keys)


def write_session(
    root: Path, rig: Calibration, sensor: Sensor, seed: int, *, n_boards: int, n_mirror: int, n_white: int
) -> Floats:
    """Write a raw folder with all frames of a session.

    Args:
        root: folder to fill.
        rig: the true rig.
        sensor: sensor of all cameras.
        seed: seed of noise, places and colours.
        n_boards, n_mirror, n_white: numbers of places of the board and of the spheres.

    Returns:
        Pose (4, 4) world_from_board of the first board, whose frame is that of the calibration.
    """
    random = np.random.default_rng([seed, 0x5E5])
    writer = RawWriter(root, rig, sensor, random)
    session = Session(writer, random, n_boards)
    cameras = range(len(rig.cameras))
    for place in range(n_boards):
        for camera in cameras:
            session.board(camera, place)
    for kind, count in (("mirror", n_mirror), ("white", n_white)):
        for place in range(count):
            for camera in cameras:
                for light in range(len(rig.lights)):
                    session.sphere(camera, place, light, kind)
    xyz = random.uniform(0.05, 0.8, (24, 3)) @ XYZ_FROM_SENSOR.T
    xyz[18:] = np.array(NEUTRALS)[:, None] * XYZ_FROM_SENSOR.sum(axis=1)
    for camera in cameras:
        writer.black(camera, (EXPOSURE_S,), 2)
        session.flat(camera)
        session.chart(camera, xyz)
    table = "\n".join(",".join(f"{100 * value:.6f}" for value in row) for row in xyz)
    (root / "chart.csv").write_text(f"X,Y,Z\n{table}\n")
    board = {key: list(value) if isinstance(value, tuple) else value for key, value in BOARD.model_dump().items()}
    writer.finish(
        {
            "board": [board],
            "sphere": [
                {"name": "mirror", "kind": "mirror", "radius_mm": MIRROR_MM},
                {"name": "white", "kind": "white", "radius_mm": WHITE_MM, "reflectance": list(REFLECTANCE)},
            ],
            "chart": [{"name": "colours", "type": "colorchecker-24", "reference": "chart.csv"}],
        }
    )
    return session.poses[0]


def _board_texture() -> NDArray[np.float32]:
    """Image of the board's print, 0 to 1, drawn by OpenCV and blurred."""
    import cv2

    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, str(BOARD.dictionary)))
    board = cv2.aruco.CharucoBoard(BOARD.squares, BOARD.square_mm, BOARD.marker_mm, dictionary)
    columns, rows = (round(n * BOARD.square_mm * TEXELS_PER_MM) for n in BOARD.squares)
    drawn = board.generateImage((columns, rows)).astype(np.float32) / 255
    return np.asarray(cv2.GaussianBlur(drawn, (0, 0), BLUR_MM * TEXELS_PER_MM))
