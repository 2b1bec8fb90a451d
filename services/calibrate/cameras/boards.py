"""Positions of a board's corners on the board itself, and their detection in a photograph."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.calibrate.cameras.lens import HALF_PIXEL
from services.core.errors import CaptureInputError
from services.core.raw.targets import Board

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Detection:
    """Corners of a board that were found in one photograph.

    Attributes:
        ids: numbers of the corners (N,).
        corners_mm: positions of the corners on the board (N, 3).
        pixels: positions of the corners in the photograph (N, 2), pixel centres at half-integers.
        markers: numbers of the markers found (M,).
    """

    ids: NDArray[np.int64]
    corners_mm: Floats
    pixels: Floats
    markers: NDArray[np.int64]


def corners_on_board(board: Board) -> Floats:
    """Return the positions (N, 3) in mm of all corners on a board, in OpenCV's order of numbers; z = 0."""
    columns, rows = board.squares
    if board.type == "chessboard":
        x, y = np.meshgrid(np.arange(columns - 1), np.arange(rows - 1))
        flat = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
        return np.asarray(flat * board.square_mm, dtype=np.float64)
    made = opencv_board(board)
    if board.type == "charuco":
        return np.asarray(made.getChessboardCorners(), dtype=np.float64)
    return np.asarray(made.getObjPoints(), dtype=np.float64).reshape(-1, 3)


def opencv_board(board: Board) -> Any:
    """Return OpenCV's board object for a ChArUco or ArUco board.

    For an ArUco board ``square_mm`` is the distance from one marker's edge to the same edge of the next marker.

    Raises:
        CaptureInputError: the dictionary is unknown or has fewer markers than the board shows.
    """
    import cv2

    number = getattr(cv2.aruco, board.dictionary or "", None)
    if number is None or board.marker_mm is None:
        known = ", ".join(sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_")))
        raise CaptureInputError(
            f"Board {board.name} names dictionary {board.dictionary}, which OpenCV lacks; it has {known}."
        )
    dictionary = cv2.aruco.getPredefinedDictionary(number)
    places = board.squares[0] * board.squares[1]
    markers, known_markers = places if board.type == "aruco" else places // 2, len(dictionary.bytesList)
    if markers > known_markers:
        raise CaptureInputError(
            f"Board {board.name} shows {markers} markers and dictionary {board.dictionary} has {known_markers}; "
            "name a larger dictionary or fewer squares."
        )
    if board.type == "aruco":
        return cv2.aruco.GridBoard(board.squares, board.marker_mm, board.square_mm - board.marker_mm, dictionary)
    made = cv2.aruco.CharucoBoard(board.squares, board.square_mm, board.marker_mm, dictionary)
    made.setLegacyPattern(board.legacy_pattern)
    return made


def detect(image: NDArray[np.uint8], board: Board) -> Detection:
    """Find a board's corners in a grey 8-bit photograph (H, W).

    A photograph without the board gives a detection without corners. A chessboard has no markers that number its
    squares, so it is found whole or not at all; one that looks the same when turned by 180° must appear turned by less
    than 90° between cameras.
    """
    find = {"charuco": _detect_charuco, "chessboard": _detect_chessboard, "aruco": _detect_aruco}[board.type]
    ids, pixels, markers = find(image, board)
    return Detection(ids, corners_on_board(board)[ids], pixels + HALF_PIXEL, markers)


def _detect_charuco(image: NDArray[np.uint8], board: Board) -> tuple[NDArray[np.int64], Floats, NDArray[np.int64]]:
    import cv2

    # Markers only identify the squares' corners, so the markers' own corners are not refined; the squares' always are.
    detector = cv2.aruco.CharucoDetector(opencv_board(board))
    pixels, ids, _, markers = detector.detectBoard(image)
    return _numbers(ids), _pixels(pixels), _numbers(markers)


def _detect_aruco(image: NDArray[np.uint8], board: Board) -> tuple[NDArray[np.int64], Floats, NDArray[np.int64]]:
    import cv2

    made = opencv_board(board)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    quads, ids, _ = cv2.aruco.ArucoDetector(made.getDictionary(), parameters).detectMarkers(image)
    row = {int(number): place for place, number in enumerate(np.ravel(made.getIds()))}
    found = [(row[number], quad) for number, quad in zip(_numbers(ids).tolist(), quads, strict=True) if number in row]
    corners = np.array([4 * place + corner for place, _ in found for corner in range(4)], dtype=np.int64)
    return corners, _pixels(np.array([quad for _, quad in found])), _numbers(ids)


def _detect_chessboard(image: NDArray[np.uint8], board: Board) -> tuple[NDArray[np.int64], Floats, NDArray[np.int64]]:
    import cv2

    inner = (board.squares[0] - 1, board.squares[1] - 1)
    found, pixels = cv2.findChessboardCornersSB(image, inner, flags=cv2.CALIB_CB_ACCURACY)
    count = inner[0] * inner[1] if found else 0
    return np.arange(count, dtype=np.int64), _pixels(pixels if found else None), np.empty(0, dtype=np.int64)


def _numbers(found: Any) -> NDArray[np.int64]:
    return np.empty(0, dtype=np.int64) if found is None else np.ravel(found).astype(np.int64)


def _pixels(found: Any) -> Floats:
    return np.empty((0, 2)) if found is None else np.asarray(found, dtype=np.float64).reshape(-1, 2)
