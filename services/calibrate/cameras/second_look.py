"""Second detectors for boards that the first one does not find in a photograph.

What one detector misses another one may find: they threshold a photograph in different ways. They take longer and are
less accurate, so the first one is asked first.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.calibrate.cameras.boards import Detection, corners_on_board, detect, opencv_board
from services.calibrate.cameras.lens import HALF_PIXEL
from services.core.raw.targets import Board

Picture = NDArray[np.uint8]
Floats = NDArray[np.float64]
MAX_WIDTH = 1600
"""Largest width of the picture in which a chessboard is searched again; wider ones are reduced, and the corners are
then refined in the whole picture."""
REFINED_PX, ROUNDS, PRECISION_PX = 5, 40, 1e-3
"""Half width of the window in which a corner is refined, its largest number of rounds, and the step that ends it."""
WIDEST_WINDOW = 73
"""Largest window of the thresholds by which markers are searched again, pixels; OpenCV's own is 23, too small for
unevenly lit boards."""


def detect_again(pictures: Iterable[Picture], board: Board, least: int) -> Detection | None:
    """Find a board that was missed: by the first detector in other pictures, then by second detectors in all of them.

    Args:
        pictures: grey copies (H, W) of one photograph; the first one is the one in which the board was missed.
        board: the board.
        least: number of corners of a detection that counts.

    Returns:
        The first detection of enough corners; None if there is none.
    """
    tried = list[Picture]()
    for picture in pictures:
        if tried and len((found := detect(picture, board)).ids) >= least:
            return found
        tried.append(picture)
    for picture in tried:
        other = _second(picture, board)
        if other is not None and len(other.ids) >= least:
            return other
    return None


def _second(picture: Picture, board: Board) -> Detection | None:
    if board.type == "chessboard":
        return _chessboard(picture, board)
    return _by_markers(picture, board) if board.type == "charuco" else None


def _by_markers(picture: Picture, board: Board) -> Detection:
    import cv2

    markers, refined = cv2.aruco.DetectorParameters(), cv2.aruco.CharucoParameters()
    markers.adaptiveThreshWinSizeMax = WIDEST_WINDOW
    refined.tryRefineMarkers = True
    detector = cv2.aruco.CharucoDetector(opencv_board(board), refined, markers)
    pixels, ids, _, found = detector.detectBoard(picture)
    numbers = np.empty(0, dtype=np.int64) if ids is None else np.ravel(ids).astype(np.int64)
    corners = np.empty((0, 2)) if pixels is None else np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
    seen = np.empty(0, dtype=np.int64) if found is None else np.ravel(found).astype(np.int64)
    return Detection(numbers, corners_on_board(board)[numbers], corners + HALF_PIXEL, seen)


def _chessboard(picture: Picture, board: Board) -> Detection | None:
    import cv2

    inner = (board.squares[0] - 1, board.squares[1] - 1)
    scale = min(1.0, MAX_WIDTH / picture.shape[1])
    small = picture if scale == 1 else cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    flags = cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
    is_found, corners = cv2.findChessboardCornersSB(small, inner, flags=flags)
    if not is_found and sum(board.squares) % 2:
        # The two detectors begin at opposite corners of a board that looks another way when it is turned by 180°: this
        # one beside a black square, the other one beside a white one. Of other boards the order is not known.
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        is_found, corners = cv2.findChessboardCorners(small, inner, flags=flags)
        corners = corners[::-1].copy() if is_found else corners
    if not is_found:
        return None
    pixels = _refined(picture, (np.asarray(corners).reshape(-1, 1, 2) + HALF_PIXEL) / scale - HALF_PIXEL)
    ids = np.arange(len(pixels), dtype=np.int64)
    return Detection(ids, corners_on_board(board), pixels + HALF_PIXEL, np.empty(0, dtype=np.int64))


def _refined(picture: Picture, corners: Any) -> Floats:
    import cv2

    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, ROUNDS, PRECISION_PX)
    window = (REFINED_PX, REFINED_PX)
    found = cv2.cornerSubPix(picture, np.ascontiguousarray(corners, dtype=np.float32), window, (-1, -1), stop)
    return np.asarray(found, dtype=np.float64).reshape(-1, 2)
