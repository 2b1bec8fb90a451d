"""Readers of five photographs of one patient and of reference meshes of the same teeth, with landmarks clicked by hand.

Focal lengths and principal points are those that the data's authors fitted, for images 800 pixels wide. The landmarks
were clicked by looking at the photographs and at shaded meshes, without the labels of tooth edges or fitted poses.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.calibrate.registration.landmarks import Click
from services.calibrate.registration.outlines import View
from services.core.files.meshes import read_mesh
from services.core.geometry import Camera, Mesh

SIZE = (800, 600)
FOCAL_PX = {"upper": 924.81, "frontal": 1426.57}
PRINCIPAL_PX = {"upper": (410.57, 335.03), "frontal": (428.88, 295.94)}
NUMBER = {"upper": 0, "frontal": 4}
CLICKED_WIDTH = 1440
UPPER_TEETH = (*range(11, 18), *range(21, 28))
STILL = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))

CLICKED_ON_MESHES = {
    "upper": (
        ("11 mesial edge", (-0.3, -3.9, 17.2), (790, 325)),
        ("11 distal edge", (-7.3, -2.5, 16.0), (578, 316)),
        ("21 mesial edge", (0.6, -4.0, 17.2), (808, 328)),
        ("21 distal edge", (8.2, -2.6, 15.3), (1003, 352)),
        ("14 palatal side", (-16.7, -0.1, 2.2), (355, 525)),
        ("15 palatal side", (-17.8, 0.2, -4.3), (338, 645)),
        ("16 palatal side", (-17.5, 0.6, -13.2), (362, 780)),
        ("24 palatal side", (15.3, -0.2, 1.3), (1097, 605)),
        ("25 palatal side", (18.5, -0.2, -5.3), (1128, 705)),
        ("26 palatal side", (16.7, 0.9, -13.5), (1055, 800)),
        ("27 palatal tip", (24.4, -3.0, -23.8), (1180, 1010)),
        ("17 palatal tip", (-22.8, -3.8, -24.5), (240, 1010)),
        ("14 buccal side", (-24.5, -3.1, 5.3), (123, 530)),
        ("25 buccal side", (26.6, -2.8, -1.9), (1345, 715)),
    ),
    "frontal": (
        ("11 distal edge", (-7.6, -3.7, 17.5), (601, 612)),
        ("11 mesial edge", (-0.3, -4.1, 17.8), (785, 627)),
        ("21 mesial edge", (0.4, -3.8, 17.4), (799, 624)),
        ("21 distal edge", (7.9, -3.9, 16.8), (975, 605)),
        ("12 distal edge", (-14.2, -3.1, 13.9), (448, 590)),
        ("13 tip", (-17.4, -4.2, 11.4), (375, 605)),
        ("22 mesial edge", (9.5, -2.8, 16.8), (995, 580)),
        ("22 distal edge", (15.0, -3.0, 13.7), (1108, 583)),
        ("14 tip", (-24.5, -3.4, 4.1), (243, 565)),
    ),
}


def camera(view: str) -> Camera:
    """The camera of a photograph, with the identity as its pose."""
    focal, (cx, cy) = FOCAL_PX[view], PRINCIPAL_PX[view]
    K = ((focal, 0.0, cx), (0.0, focal, cy), (0.0, 0.0, 1.0))
    return Camera(name=view, size=SIZE, K=K, camera_from_world=STILL)


def upper_teeth(root: Path) -> list[Mesh]:
    """Read the reference meshes of the upper teeth in their common frame."""
    return [read_mesh(root / "ref_mesh" / f"Ref_Mesh_Tag=0_FDI={fdi}.obj") for fdi in UPPER_TEETH]


def clicks(view: str) -> list[Click]:
    """Landmarks of a photograph, with pixels for an image 800 pixels wide."""
    scale = SIZE[0] / CLICKED_WIDTH
    return [
        Click(name, view, np.array(point), scale * np.array(pixel, dtype=np.float64))
        for name, point, pixel in CLICKED_ON_MESHES[view]
    ]


def photograph(root: Path, view: str) -> View:
    """Read a photograph and scale it to a width of 800 pixels."""
    import cv2

    image = cv2.imread(str(root / "image" / f"0-{NUMBER[view]}.png"))[..., ::-1]
    return View(camera(view), cv2.resize(image.astype(np.float32), SIZE, interpolation=cv2.INTER_AREA))


def distance_to_edges_px(root: Path, view: str, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance (N,) of pixels (N, 2) from the middle line of the nearest hand-labelled edge."""
    import cv2

    label = cv2.imread(str(root / "label" / f"0-{NUMBER[view]}.png"), cv2.IMREAD_UNCHANGED).astype(np.float32)
    drawn = cv2.resize(label[..., :3].max(axis=-1) * label[..., 3] / 255, SIZE, interpolation=cv2.INTER_AREA)
    line = cv2.ximgproc.thinning((drawn > 80).astype(np.uint8) * 255) > 0
    distance = cv2.distanceTransform((~line).astype(np.uint8), cv2.DIST_L2, 5)
    column, row = np.clip(np.round(pixels - 0.5).astype(int), 0, np.array(SIZE) - 1).T
    return np.asarray(distance[row, column], dtype=np.float64)
