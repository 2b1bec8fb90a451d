"""Camera raw files for tests: Adobe's tags (DNG 1.4, chapter 4) in a TIFF by tifffile, independent of the reader."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import tifffile

_ONE, _ZERO = (1, 1), (0, 1)


def write_dng(
    path: Path,
    values: Any,
    pattern: tuple[int, ...] = (0, 1, 1, 2),
    repeat: tuple[int, int] = (2, 2),
    planes: tuple[int, ...] = (0, 1, 2),
    white: int = 4095,
    tile: tuple[int, int] | None = None,
) -> None:
    """Write counts (H, W) as a DNG.

    Args:
        pattern: plane of each pixel of the mosaic's repeat, row by row.
        repeat: rows and columns of the repeat.
        planes: colour of each plane: 0 to 6 are red, green, blue, cyan, magenta, yellow, white.
        white: count from which a pixel is full.
        tile: rows and columns of the tiles that the counts are stored in; None for strips.
    """
    matrix = [_ONE if k % 3 == k // 3 else _ZERO for k in range(3 * len(planes))]
    tags: tuple[tuple[str, str, int, Any], ...] = (
        ("CFARepeatPatternDim", "H", 2, repeat),
        ("CFAPattern", "B", len(pattern), bytes(pattern)),
        ("CFAPlaneColor", "B", len(planes), bytes(planes)),
        ("CFALayout", "H", 1, 1),
        ("DNGVersion", "B", 4, bytes((1, 4, 0, 0))),
        ("DNGBackwardVersion", "B", 4, bytes((1, 2, 0, 0))),
        ("Make", "s", 0, "Maker"),
        ("Model", "s", 0, "Model"),
        ("UniqueCameraModel", "s", 0, "Maker Model"),
        ("BlackLevel", "I", 1, 64),
        ("WhiteLevel", "I", 1, white),
        ("ColorMatrix1", "2i", len(matrix), sum(matrix, ())),
        ("CalibrationIlluminant1", "H", 1, 21),
        ("AsShotNeutral", "2I", len(planes), _ONE * len(planes)),
    )
    extra = [(name, kind, count, value, True) for name, kind, count, value in tags]
    tifffile.imwrite(path, values, photometric="cfa", tile=tile, extratags=extra)
