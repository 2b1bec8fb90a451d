"""``dentine board``: boards to print, as PDF to scale."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def board_command(
    out: Annotated[Path, typer.Option(help="The PDF to write; raw.toml's entry for it is printed.")],
    kind: Annotated[str, typer.Option("--type", help="charuco, chessboard or aruco.")] = "charuco",
    squares: Annotated[tuple[int, int], typer.Option(help="Columns and rows of squares, or of markers: 9 7.")] = (9, 7),
    square_mm: Annotated[float, typer.Option(min=1, help="Edge of a square.")] = 12.0,
    marker_mm: Annotated[float | None, typer.Option(min=0.5, help="Edge of a marker; default 3/4 of a square.")] = None,
    dictionary: Annotated[str, typer.Option(help="Of the markers, by OpenCV's name.")] = "DICT_5X5_100",
) -> None:
    """Write a board as PDF, exact to scale if it is printed without fitting it to the page."""
    from pydantic import ValidationError

    from services.calibrate.cameras.printing import board_pdf
    from services.core.errors import SettingsError
    from services.core.files.validation import remedied
    from services.core.raw.targets import Board
    from services.core.store import write_atomic

    fields: dict[str, object] = {"name": "board", "type": kind, "squares": squares, "square_mm": square_mm}
    if kind != "chessboard":
        fields |= {"marker_mm": marker_mm or 0.75 * square_mm, "dictionary": dictionary}
    try:
        board = Board.model_validate(fields)
    except ValidationError as problem:
        first = problem.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the board"
        raise SettingsError(f"Option for {where}: {remedied(first)}.") from None
    write_atomic(out, board_pdf(board))
    print(f"{out}: print it at 100 %, and check that its ruler is 100 mm long. Its entry in raw.toml:")
    print("[[board]]")
    for key, value in board.model_dump(exclude_none=True, exclude={"legacy_pattern"}).items():
        text = f'"{value}"' if isinstance(value, str) else str(list(value)) if isinstance(value, tuple) else str(value)
        print(f"{key} = {text}")
