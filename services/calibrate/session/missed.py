"""Reasons why a board was not found in a photograph: the most frequent mistakes, tried one by one."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from services.calibrate.cameras.boards import Detection, detect
from services.core.raw.targets import Board

ENOUGH = 6
"""Number of corners that identify a board; fewer may be found by chance or belong to a small part of it."""


def why_missed(image: NDArray[np.uint8], board: Board, found: Detection) -> str:
    """Return cause and remedy for a photograph in which a board shows too few corners, as the end of a sentence.

    Args:
        image: the photograph, grey, 8 bit (H, W).
        board: the board as raw.toml describes it.
        found: the corners and markers that were found.
    """
    for tried, other, remedy in _other_readings(image, board):
        if len(detect(tried, other).ids) >= max(ENOUGH, 2 * len(found.ids)):
            return remedy
    if len(found.markers) or len(found.ids):
        return (
            f"only {len(found.markers)} markers and {len(found.ids)} corners of board {board.name} show: it is cut off,"
            " hidden or out of focus; photograph more of it"
        )
    return (
        f"nothing of board {board.name} shows: check that the board of raw.toml (type, squares, dictionary) is the one"
        " that was photographed, whole, lit and in focus"
    )


def _other_readings(image: NDArray[np.uint8], board: Board) -> Iterator[tuple[NDArray[np.uint8], Board, str]]:
    """Yield changed photographs or board descriptions, each with the remedy if the board is found with it."""
    mirrored = np.ascontiguousarray(image[:, ::-1])
    yield mirrored, board, "the image is mirrored; export it as the camera saw it"
    columns, rows = board.squares
    turned = board.model_copy(update={"squares": (rows, columns)})
    yield (
        image,
        turned,
        f"board {board.name} has squares = [{rows}, {columns}], not [{columns}, {rows}]; correct raw.toml",
    )
    if board.type == "charuco":
        other = board.model_copy(update={"legacy_pattern": not board.legacy_pattern})
        yield (
            image,
            other,
            f"board {board.name} has legacy_pattern = {str(other.legacy_pattern).lower()}; correct raw.toml",
        )
