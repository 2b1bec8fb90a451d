"""The picture of photographs beside renders, with captions."""

from __future__ import annotations

import numpy as np

from services.assets.colour.beside import Beside, Pair
from services.core.pages.pictures import Image8, tone_map, white_level

MARGIN_PX = 14
"""Width of the border around the pictures, pixels."""
FONT_PX = 19
"""Size of the captions' letters, pixels: they stay legible where a page shows the picture at half its size."""
DARK = 0.05
"""Least share of a photograph's brightest value at a pixel that shows the surface."""
BACKGROUND, INK = (24, 24, 24), (235, 235, 235)
"""Colours of border and captions, sRGB bytes: dark, as the photographs' own background is."""


def picture(found: Beside, made_by: str) -> Image8:
    """Picture (H, W, 3), sRGB bytes: each photograph, its render at the right, and below them what they are.

    A pair has one exposure: what is brighter than 99 % of the photographed surface is white. The photograph's pixels
    are squares.

    Args:
        found: photographs and renders.
        made_by: what the photographs are, such as "Simulated photograph".
    """
    from PIL import Image, ImageDraw, ImageFont

    font, line = ImageFont.load_default(FONT_PX), round(1.35 * FONT_PX)
    columns = [column for pair in found.pairs for column in _columns(pair, made_by, found.has_surroundings)]
    sentence = _sentence(found)
    height, width = columns[0][0].shape[:2]
    wide = max(width, *(int(font.getlength(text)) + 1 for _, caption in columns for text in caption))
    page_width = max(len(columns) * (wide + MARGIN_PX) + MARGIN_PX, int(font.getlength(sentence)) + 2 * MARGIN_PX)
    lines = max(len(caption) for _, caption in columns)
    page = Image.new("RGB", (page_width, height + (lines + 1) * line + 4 * MARGIN_PX), BACKGROUND)
    draw = ImageDraw.Draw(page)
    left = (page_width - len(columns) * (wide + MARGIN_PX) + MARGIN_PX) // 2
    for k, (image, caption) in enumerate(columns):
        x = left + k * (wide + MARGIN_PX)
        page.paste(Image.fromarray(image), (x + (wide - width) // 2, MARGIN_PX))
        for row, text in enumerate(caption):
            draw.text((x + wide // 2, height + 2 * MARGIN_PX + row * line), text, fill=INK, font=font, anchor="ma")
    draw.text((page_width // 2, page.height - MARGIN_PX), sentence, fill=INK, font=font, anchor="ms")
    return np.asarray(page)


def _columns(pair: Pair, made_by: str, has_surroundings: bool) -> list[tuple[Image8, list[str]]]:
    white = white_level(pair.photo.max(axis=-1), pair.photo.max(axis=-1) > DARK * pair.photo.max())
    times = max(1, pair.render.shape[0] // pair.photo.shape[0])
    lit = f"light {pair.lit}" if len(pair.lights) == 1 else pair.lit
    unseen = "which the fit has not seen" if pair.held_out else ""
    photo = tone_map(pair.photo, white).repeat(times, axis=0).repeat(times, axis=1)
    rendered = "The fit with gums and teeth around it," if has_surroundings else "The asset in the"
    shown = (photo, [made_by, lit, unseen]), (tone_map(pair.render, white), [rendered, "same view and light"])
    return [(image, [text for text in caption if text]) for image, caption in shown]


def _sentence(found: Beside) -> str:
    how = "calibrated sRGB" if found.is_calibrated else "the camera's channels taken for sRGB"
    return f"Camera {found.camera}, {how}. Renders of {found.samples} paths a pixel, whose noise a filter has smoothed."
