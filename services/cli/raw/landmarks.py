"""``dentine landmarks``: a page in which the landmarks of a raw folder are clicked."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def landmarks(
    raw: Annotated[Path, typer.Argument(metavar="RAW", help="Folder of raw.toml with [scan] and frames of the teeth.")],
    out: Annotated[
        Path | None, typer.Option(help="File to write the page to; default: landmarks.html in the folder.")
    ] = None,
) -> None:
    """Write a page in which the same points are clicked in the scan and in the photographs."""
    from services.calibrate.clicking.page import write_clicking_page

    print(f"open {write_clicking_page(raw, out)} in a browser; it needs no network")
