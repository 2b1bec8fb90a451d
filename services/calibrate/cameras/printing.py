"""Boards as PDF files, to scale: pages of black rectangles in millimetres, which none of this project's dependencies
can write.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from services.calibrate.cameras.boards import opencv_board
from services.core.raw.targets import Board

POINTS_PER_MM = 72 / 25.4
MARGIN_MM = 10.0
"""Width of the white margin around a board: at least half a square, so that the outer squares are found."""
RULER_MM, RULER_HEIGHT_MM = 100.0, 1.0
"""Length and height of the printed ruler, by which the print's scale can be checked."""
Rectangle = tuple[float, float, float, float]
"""A rectangle's x, y, width and height in mm, from the board's upper left corner, y down."""


def board_rectangles(board: Board) -> list[Rectangle]:
    """Return the black rectangles of a board."""
    if board.type == "chessboard":
        return list(_squares(board))
    return [*(_squares(board) if board.type == "charuco" else ()), *_markers(board)]


def board_pdf(board: Board) -> bytes:
    """Return a PDF of one page that shows the board at its true size with margins, and a ruler of 100 mm below it."""
    columns, rows = board.squares
    width, height = columns * board.square_mm, rows * board.square_mm
    page_width = max(width, RULER_MM) + 2 * MARGIN_MM
    page_height = height + 3 * MARGIN_MM
    shapes = [(x + MARGIN_MM, y + MARGIN_MM, w, h) for x, y, w, h in board_rectangles(board)]
    shapes.append((MARGIN_MM, height + 2 * MARGIN_MM, RULER_MM, RULER_HEIGHT_MM))
    # PDF counts points from the lower left corner.
    lines = ["0 g"] + [
        " ".join(f"{value * POINTS_PER_MM:.5f}" for value in (x, page_height - y - h, w, h)) + " re"
        for x, y, w, h in shapes
    ]
    return _document("\n".join([*lines, "f"]).encode(), page_width * POINTS_PER_MM, page_height * POINTS_PER_MM)


def _squares(board: Board) -> Iterator[Rectangle]:
    """Yield the black squares. The upper left square of OpenCV's boards is black, but that of a ChArUco board of the
    legacy pattern with an even number of rows is white.
    """
    columns, rows = board.squares
    first = 1 if board.legacy_pattern and rows % 2 == 0 else 0
    side = board.square_mm
    for row in range(rows):
        for column in range(columns):
            if (row + column + first) % 2 == 0:
                yield column * side, row * side, side, side


def _markers(board: Board) -> Iterator[Rectangle]:
    """Yield the black cells of all markers, joined along rows."""
    import cv2

    made = opencv_board(board)
    dictionary = made.getDictionary()
    cells = int(dictionary.markerSize) + 2
    for number, corners in zip(np.ravel(made.getIds()), made.getObjPoints(), strict=True):
        bits = cv2.aruco.generateImageMarker(dictionary, int(number), cells, borderBits=1)
        left, top = np.asarray(corners)[0][:2]
        cell = float(np.linalg.norm(np.asarray(corners)[1] - np.asarray(corners)[0])) / cells
        for row in range(cells):
            for column, run in _runs(bits[row] == 0):
                yield float(left) + column * cell, float(top) + row * cell, run * cell, cell


def _runs(black: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """Yield the first cell and the length of each run of black cells."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], black.astype(int), [0]])))
    yield from ((int(start), int(stop - start)) for start, stop in zip(edges[::2], edges[1::2], strict=True))


def _document(content: bytes, width: float, height: float) -> bytes:
    """Return a PDF of one page with this content (ISO 32000-1, 7.5); width and height in points."""
    page = f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width:.5f} {height:.5f}] /Contents 4 0 R /Resources << >> >>"
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        page.encode(),
        b"<< /Length %d >>\nstream\n%s\nendstream" % (len(content), content),
    ]
    parts, offsets = [b"%PDF-1.4\n"], []
    for number, body in enumerate(objects, start=1):
        offsets.append(sum(map(len, parts)))
        parts.append(b"%d 0 obj\n%s\nendobj\n" % (number, body))
    start = sum(map(len, parts))
    table = b"".join(b"%010d 00000 n \n" % offset for offset in offsets)
    parts.append(b"xref\n0 %d\n0000000000 65535 f \n%s" % (len(objects) + 1, table))
    parts.append(b"trailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (len(objects) + 1, start))
    return b"".join(parts)
