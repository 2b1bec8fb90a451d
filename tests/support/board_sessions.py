"""Photographs of calibration boards: drawn from known cameras with noise, or read from tables of other projects."""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.calibrate.cameras.boards import corners_on_board
from services.calibrate.cameras.bundle import Rig, project_corners
from services.calibrate.cameras.lens import Lens
from services.calibrate.cameras.rotations import pose_matrix, pose_vector
from services.calibrate.cameras.sightings import View, joined
from services.core.raw.targets import Board

CHESSBOARD = Board(name="plate", type="chessboard", squares=(9, 7), square_mm=12.0)
SIZE = (1600, 1200)


def charuco(squares: tuple[int, int], dictionary: str = "DICT_6X6_250", **others: object) -> Board:
    """A ChArUco board with squares of 40 mm and markers of 20 mm; other fields replace these or choose another type."""
    told = {"type": "charuco", "square_mm": 40, "marker_mm": 20, **others}
    return Board.model_validate({"name": "plate", "squares": squares, "dictionary": dictionary, **told})


def looking(position_mm: NDArray[np.float64], target_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """The pose (6,) camera_from_world of a camera that looks at a target, its y axis down along the world's −y."""
    z = target_mm - position_mm
    z = z / np.linalg.norm(z)
    x = np.cross(np.array([0.0, -1.0, 0.0]), z)
    x = x / np.linalg.norm(x)
    rotation = np.array([x, np.cross(z, x), z])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ position_mm
    return pose_vector(matrix)


def true_rig(random: np.random.Generator, n_places: int = 12, size: tuple[int, int] = SIZE) -> Rig:
    """A rig of three cameras, 450 mm away from boards that lie tilted about the place of the teeth. The focal length
    scales with the image's size, so every size has the same field of view.
    """
    scale = size[0] / SIZE[0]
    lenses, cameras = [], []
    for azimuth in np.deg2rad([-35.0, 0.0, 35.0]):
        distortion = np.array([-0.12, 0.08, 0.0006, -0.0004]) * random.uniform(0.7, 1.3, 4)
        focal = 3200 * scale * random.uniform(0.95, 1.05)
        lenses.append(Lens(size, np.array([focal, focal * 1.002, 805.0 * scale, 590.0 * scale, *distortion])))
        cameras.append(looking(450 * np.array([np.sin(azimuth), 0.2, np.cos(azimuth)]), np.zeros(3)))
    return in_first_frame(tuple(lenses), cameras, tilted_places(random, n_places))


def tilted_places(
    random: np.random.Generator, n_places: int, towards: NDArray[np.float64] | None = None
) -> list[NDArray[np.float64]]:
    """Poses (4, 4) world_from_board of boards about the origin that face cameras on the side of +z.

    Args:
        towards: rotation (3, 3) that brings +z to another side.
    """
    centre, turned, places = corners_on_board(CHESSBOARD).mean(axis=0), np.eye(4), []
    if towards is not None:
        turned[:3, :3] = towards
    for _ in range(n_places):
        # Turned by π about x the plate faces the cameras; tilts of up to 35° separate focal length from distance.
        turn = np.array([np.pi, 0, 0]) + random.uniform(-0.6, 0.6, 3)
        matrix = pose_matrix(np.concatenate([turn, np.zeros(3)]))
        matrix[:3, 3] = random.uniform(-25, 25, 3) - matrix[:3, :3] @ centre
        places.append(turned @ matrix)
    return places


def in_first_frame(
    lenses: tuple[Lens, ...], cameras: Sequence[NDArray[np.float64]], places: Sequence[NDArray[np.float64]]
) -> Rig:
    """Build a rig whose world frame is that of the board at place 0.

    Args:
        cameras: poses (6,) camera_from_world.
        places: poses (4, 4) world_from_board.
    """
    to_first = np.linalg.inv(places[0])
    moved = [pose_vector(pose_matrix(camera) @ places[0]) for camera in cameras]
    return Rig(lenses, np.array(moved), np.array([pose_vector(to_first @ place) for place in places]))


def photographed(rig: Rig, noise_px: float, random: np.random.Generator) -> list[View]:
    """Draw every board from every camera, with Gaussian errors on the corners. Corners outside the image are left out,
    and so is a photograph with fewer than six corners.
    """
    corners = corners_on_board(CHESSBOARD)
    ids = np.arange(len(corners))
    views = []
    for place in range(len(rig.places)):
        for camera in range(len(rig.lenses)):
            blank = View(camera, place, corners, np.zeros((len(corners), 2)), ids, f"camera {camera}, place {place}")
            drawn = project_corners(rig, joined([blank]))
            inside = np.asarray(((drawn > 0) & (drawn < np.array(rig.lenses[camera].size))).all(axis=1))
            seen = drawn + random.normal(0, noise_px, drawn.shape)
            view = View(camera, place, corners, seen, ids, blank.name).selected(inside)
            if inside.sum() >= 6:
                views.append(view)
    return views


def table_views(path: Path) -> list[View]:
    """Read the views of a table of ChArUco corners, in metres and in OpenCV's pixel coordinates. Views with fewer than
    four corners are left out.
    """
    rows = defaultdict(list)
    with path.open() as stream:
        for row in csv.DictReader(stream):
            corner = [float(row[key]) for key in ("keypoint_id", "obj_loc_x", "obj_loc_y", "img_loc_x", "img_loc_y")]
            rows[int(row["cam_id"]), int(row["sync_index"])].append(corner)
    kept = {key: np.array(corners) for key, corners in sorted(rows.items()) if len(corners) >= 4}
    times = sorted({time for _, time in kept})
    return [
        View(
            camera,
            times.index(time),
            1e3 * np.column_stack([corners[:, 1:3], np.zeros(len(corners))]),
            corners[:, 3:] + 0.5,
            corners[:, 0].astype(np.int64),
            f"camera {camera}, time {time}",
        )
        for (camera, time), corners in kept.items()
    ]
