"""A photograph and the asset's render of it, side by side in colour."""

from __future__ import annotations

import json
import runpy
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.assets.colour.develop import ASSUMED, CapturedColours, developed, diffuser_radiance
from services.assets.colour.spaces import LINEAR_SRGB
from services.core.errors import InputError
from services.core.geometry import Light
from services.core.pages.pictures import Image8, enlarge, tone_map, white_level
from services.core.results import AssetManifest, PreparedManifest
from services.core.store import StoredArray, open_stage

Floats = NDArray[np.float64]
MIN_SIDE_PX = 480
"""Least size of the larger side of either picture; a photograph with fewer pixels is shown in squares."""
MARGIN_PX = 16
"""Width of the border around the pictures, pixels."""
FONT_PX = 15
"""Size of the caption's letters, pixels."""
DARK = 0.05
"""Least share of the photograph's brightest value at a pixel that shows the tooth."""
BACKGROUND, INK = (24, 24, 24), (235, 235, 235)
"""Colours of border and caption, sRGB bytes: dark, as the photographs' own background is."""


@dataclass(frozen=True)
class Beside:
    """A photograph and the render of an asset in the same view and light, linear sRGB (H, W, 3), with 1 for a perfect
    diffuser that faces the light.
    """

    camera: str
    light: str
    held_out: bool
    """Whether the fit has not seen the photograph."""
    photo: Floats
    render: Floats
    matrix: str
    """Where the camera's colours come from, as ``rig.json`` says it."""


def beside(job: Path, samples: int) -> Beside:
    """Render a published asset as one of its photographs shows it, by the script that is shipped with it.

    The photograph is the brightest of those that the fit has not seen, else of all.

    Args:
        job: folder of the job.
        samples: paths per pixel of the photograph.

    Raises:
        InputError: the asset has no red, green and blue. StoreError: the asset or the photographs are absent.
    """
    asset, _ = open_stage(job, "asset", AssetManifest, verify=False)
    prepared_folder, prepared = open_stage(job, "prepared", PreparedManifest, verify=False)
    rig = json.loads((asset / "rig.json").read_text(encoding="utf-8"))
    if "colour" not in rig:
        raise InputError(f"The asset in {job} has no red, green and blue; fit these channels for a picture in colour.")
    colours = CapturedColours(tuple(rig["colour"]["channels"]), prepared.colour or {})
    order = [prepared.channels.index(channel) for channel in colours.channels]
    radiance = StoredArray(prepared_folder / "prepared.zarr" / "radiance")
    views = [(c.name, k.name) for c in prepared.cameras for k in prepared.lights]
    candidates = [view for view in views if view in prepared.held_out] or views
    photos = {view: _photo(radiance, prepared, view)[..., order] for view in candidates}
    camera, light = max(photos, key=lambda view: float(np.nanmean(photos[view])))
    lamp = Light(name=light, **rig["lights"][light])
    by_channel = {channel: lamp.intensity[k] for k, channel in enumerate(rig["channels"])}
    lamp = lamp.model_copy(update={"intensity": tuple(by_channel[channel] for channel in colours.channels)})
    white = diffuser_radiance(lamp, tuple(rig["colour"]["diffuser_mm"]))
    script = runpy.run_path(str(asset / "render.py"))
    integrator = "prbvolpath" if rig["boundary"] == "matched" else ""
    image = script["render"](asset, camera, light, samples, integrator=integrator)
    image = image[..., [rig["channels"].index(channel) for channel in colours.channels]]
    own = colours.cameras.get(camera)
    photo, render = (developed(one / white, own, LINEAR_SRGB) for one in (photos[camera, light], image))
    matrix = rig["colour"]["cameras"][camera]["source"]
    return Beside(camera, light, (camera, light) in prepared.held_out, photo, render, matrix)


def _photo(radiance: StoredArray, prepared: PreparedManifest, view: tuple[str, str]) -> Floats:
    camera, light = view
    number = next(k for k, one in enumerate(prepared.cameras) if one.name == camera)
    lamp = next(k for k, one in enumerate(prepared.lights) if one.name == light)
    width, height = prepared.cameras[number].size
    return np.nan_to_num(radiance[number, lamp, :height, :width].astype(np.float64))


def picture(found: Beside, made_by: str) -> Image8:
    """Picture (H, W, 3), sRGB bytes, of the photograph at left, the render at right, and a caption of what is what.

    Both have the same exposure: what is brighter than 99 % of the photographed tooth is white.

    Args:
        found: photograph and render.
        made_by: what the photograph is, such as "Simulated photograph".
    """
    from PIL import Image, ImageDraw, ImageFont

    white = white_level(found.photo.max(axis=-1), found.photo.max(axis=-1) > DARK * found.photo.max())
    pictures = [Image.fromarray(enlarge(tone_map(one, white), MIN_SIDE_PX)) for one in (found.photo, found.render)]
    seen = "which the fit has not seen" if found.held_out else "which the fit has seen"
    captions = (
        f"{made_by}\ncamera {found.camera}, light {found.light},\n{seen}",
        "The asset, rendered by Mitsuba\nin the same view and light",
    )
    how = "taken for linear sRGB" if found.matrix == ASSUMED else f"brought to sRGB by {found.matrix}"
    below = f"Linear radiance {how}; the same exposure."
    font = ImageFont.load_default(FONT_PX)
    width, height = pictures[0].size
    column = max(width, *(int(font.getlength(line)) + 1 for text in captions for line in text.split("\n")))
    line = round(1.4 * FONT_PX)
    page_width = max(2 * column + 3 * MARGIN_PX, int(font.getlength(below)) + 1 + 2 * MARGIN_PX)
    page = Image.new("RGB", (page_width, height + 4 * line + 4 * MARGIN_PX), BACKGROUND)
    draw = ImageDraw.Draw(page)
    for k, (shown, caption) in enumerate(zip(pictures, captions, strict=True)):
        left = (page_width - 2 * column - MARGIN_PX) // 2 + k * (column + MARGIN_PX)
        page.paste(shown, (left + (column - width) // 2, MARGIN_PX))
        where = left + column // 2, height + 2 * MARGIN_PX
        draw.multiline_text(where, caption, fill=INK, font=font, anchor="ma", align="center", spacing=4)
    draw.text((page_width // 2, page.height - MARGIN_PX), below, fill=INK, font=font, anchor="ms")
    return np.asarray(page)
