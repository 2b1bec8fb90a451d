"""Writes texture sets: linear values as OpenEXR, pictures as PNG, and ``textures.json``, which says what they mean."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.assets.content import RGB, in_rgb
from services.assets.textures.tooth import ToothTextures
from services.core.pages.pictures import png16_bytes, png_bytes, tone_map
from services.core.store import write_atomic

FOLDER = "textures"
MM_PER_COUNT = 1e-4
"""Step of a thickness in a PNG of 16 bits, mm; it ends at 6.55 mm, and enamel is at most 3 mm thick."""
BASE_COLOUR = (
    "linear reflectance under even light of enamel of this thickness on deep dentin, less what stains absorb; the PNG"
    " has the curve of sRGB"
)
STAIN = "transmittance of the stain, 1 where it absorbs nothing; light passes it on its way in and out"
STAIN_ERROR = (
    "standard error of the transmittance, with the media as they were fitted: an error that is the same everywhere is"
    " nearly one of the media's absorption and is not included"
)
NO_STAIN_ERROR = "The fit was made before stains had a standard error; make it again."
FIRST_ROW = "v = 0 in PLY files and glTF, v = 1 in USD and Blender"

Picture = NDArray[np.float64]


def base_colour_file(name: str) -> str:
    """Path of a part's colour picture, relative to the export's folder."""
    return f"{FOLDER}/{name}_base_colour.png"


def write_textures(folder: Path, sets: Mapping[str, ToothTextures]) -> dict[str, dict[str, Any]]:
    """Write the texture sets of some parts into ``folder/textures``; return what ``textures.json`` says of each."""
    told = {name: _write(folder / FOLDER, name, textures) for name, textures in sets.items()}
    if told:
        write_atomic(folder / FOLDER / "textures.json", (json.dumps(told, indent=1) + "\n").encode())
    return told


def _write(folder: Path, name: str, textures: ToothTextures) -> dict[str, Any]:
    folder.mkdir(parents=True, exist_ok=True)
    colour = in_rgb(textures.base_colour)
    height, width = colour.shape[:2]
    told: dict[str, Any] = {
        "size": [width, height],
        "texel_mm": textures.texel_mm,
        "texel_mm_5_to_95_percent": list(textures.texel_range_mm),
        "first_row": FIRST_ROW,
        "base_colour": {"png": f"{name}_base_colour.png", "exr": f"{name}_base_colour.exr", "meaning": BASE_COLOUR},
    }
    write_atomic(folder / f"{name}_base_colour.png", png_bytes(tone_map(colour, 1.0)))
    _write_exr(folder / f"{name}_base_colour.exr", dict(zip("RGB", np.moveaxis(colour, -1, 0), strict=True)))
    for key, values in (("thickness", textures.thickness_mm), ("thickness_se", textures.thickness_se_mm)):
        if values is None:
            continue
        write_atomic(folder / f"{name}_{key}.png", png16_bytes(values / (65535 * MM_PER_COUNT)))
        _write_exr(folder / f"{name}_{key}.exr", {"Y": values})
        meaning = "enamel thickness" if key == "thickness" else "standard error of the enamel thickness"
        told[key] = {
            "png": f"{name}_{key}.png",
            "png_mm_per_count": MM_PER_COUNT,
            "exr": f"{name}_{key}.exr",
            "unit": "mm",
            "meaning": meaning,
        }
    if textures.thickness_mm is not None and textures.thickness_se_mm is None:
        told["thickness_se"] = {"absent": textures.why_no_se}
    kinds = (("stain", textures.stains, STAIN), ("stain_se", textures.stain_errors, STAIN_ERROR))
    for key, pictures, meaning in kinds if textures.stains else ():
        if not pictures:
            told[key] = {"absent": NO_STAIN_ERROR}
            continue
        for channel, values in pictures.items():
            write_atomic(folder / f"{name}_{key}_{channel}.png", png16_bytes(values))
        named = set(RGB) == set(pictures)
        planes = {(c[0].upper() if named else c): values for c, values in pictures.items()}
        _write_exr(folder / f"{name}_{key}.exr", planes)
        told[key] = {
            "png": {channel: f"{name}_{key}_{channel}.png" for channel in pictures},
            "exr": f"{name}_{key}.exr",
            "meaning": meaning,
        }
    return told


def _write_exr(path: Path, planes: Mapping[str, Picture]) -> None:
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    channels = {name: np.ascontiguousarray(values, dtype=np.float32) for name, values in planes.items()}
    OpenEXR.File(header, channels).write(str(path))
