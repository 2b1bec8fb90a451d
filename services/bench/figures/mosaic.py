"""Composition of pictures in rows and columns, with names, as one image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from services.core.errors import InputError
from services.core.pages.pictures import Image8, Picture, signed_map, tone_map, white_level

GAP_PX, HEAD_PX, LINE_PX = 6, 20, 16
FONT_PX = 13
RESIDUAL_LIMIT = 0.25
"""Difference at the end of the colour scale, as a fraction of white."""
PAPER = (255, 255, 255)


@dataclass(frozen=True)
class Column:
    """Name of a column; with ``starts_group`` there is a wider gap before it."""

    name: str
    starts_group: bool = False


def photo_and_fit(picture: Picture, *, difference: bool = True) -> list[Image8]:
    """Return pictures of the photograph and of the fit with the photograph's white level, and of fit minus photograph
    in blue and orange.
    """
    white = white_level(picture.photo, picture.valid)
    drawn = [
        tone_map(np.where(picture.valid[..., None], image, 0.0), white) for image in (picture.photo, picture.render)
    ]
    return drawn + ([signed_map(picture.residual, RESIDUAL_LIMIT * white, picture.valid)] if difference else [])


def mosaic(
    rows: Sequence[Sequence[Image8 | None]], columns: Sequence[Column], names: Sequence[str] = (), *, scale: int = 3
) -> Image8:
    """Join rows of pictures (H, W, 3) into one image; smaller pictures are centred in their cell.

    Args:
        rows: rows of pictures; None leaves a cell empty.
        columns: one column for each picture of a row.
        names: names of the rows; none by default.
        scale: width in the image of one pixel of a picture, in px.

    Raises:
        InputError: there are no rows, a row has another number of pictures than there are columns, or there is another
            number of names than of rows.
    """
    if not rows or any(len(row) != len(columns) for row in rows) or (names and len(names) != len(rows)):
        raise InputError(
            f"A figure of {len(rows)} rows and {len(columns)} columns needs as many pictures in every row and a name"
            " for each; correct it."
        )
    heights = [scale * max((image.shape[0] for image in row if image is not None), default=1) for row in rows]
    by_column = [[image for row in rows if (image := row[k]) is not None] for k in range(len(columns))]
    widths = [scale * max((image.shape[1] for image in images), default=1) for images in by_column]
    font = ImageFont.load_default(FONT_PX)
    label_px = GAP_PX + int(max((font.getlength(name) for name in names), default=0))
    lefts, x = list[int](), label_px + GAP_PX
    for column, width in zip(columns, widths, strict=True):
        x += 3 * GAP_PX if column.starts_group and lefts else 0
        lefts.append(x)
        x += max(width, int(font.getlength(column.name)) + 2) + GAP_PX
    page = Image.new("RGB", (x, HEAD_PX + sum(heights) + GAP_PX * len(rows)), PAPER)
    draw = ImageDraw.Draw(page)
    for column, left, width in zip(columns, lefts, widths, strict=True):
        middle = left + max(width, int(font.getlength(column.name)) + 2) // 2
        draw.text((middle, 2), column.name, fill=(0, 0, 0), font=font, anchor="ma")
    y = HEAD_PX
    for number, (row, height) in enumerate(zip(rows, heights, strict=True)):
        if names:
            draw.text((GAP_PX, y + height // 2), names[number], fill=(0, 0, 0), font=font, anchor="lm")
        for image, left, width, column in zip(row, lefts, widths, columns, strict=True):
            if image is not None:
                large = Image.fromarray(np.ascontiguousarray(image.repeat(scale, axis=0).repeat(scale, axis=1)))
                room = max(width, int(font.getlength(column.name)) + 2)
                page.paste(large, (left + (room - large.width) // 2, y + (height - large.height) // 2))
        y += height + GAP_PX
    return np.asarray(page)


def cropped(picture: Picture, margin_px: int = 1) -> Picture:
    """Return the part of a picture around its valid pixels."""
    rows, columns = (np.flatnonzero(picture.valid.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return picture
    window = tuple(slice(max(int(axis[0]) - margin_px, 0), int(axis[-1]) + 1 + margin_px) for axis in (rows, columns))
    return Picture(
        picture.camera,
        picture.light,
        picture.held_out,
        picture.photo[window],
        picture.render[window],
        picture.valid[window],
    )
