"""How programs without measured media show a part of an asset: colour, highlight and subsurface scattering.

The names and meanings of the subsurface inputs are those of OpenPBR 1.1 (Academy Software Foundation 2024): the radius
times the scale is the mean free path of light that forgets its direction at each scattering, 1 / (sigma_s' + sigma_a).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from services.assets.content import AssetContent, AssetPart
from services.assets.textures.files import base_colour_file

Colour = tuple[float, float, float]

ROUGHNESS = 0.35
"""Roughness of the highlight where the asset has no rough surface; its square is the width alpha of a GGX lobe: 0.12, a
wet and polished tooth."""
GUMS_IOR = 1.33
"""Refractive index of gums, which are wet."""
LOST = (
    "The surfaces have the colour of their tissue under even light, and the highlight of the rough surface that the"
    " fit held, else of a wet tooth. Light within the media, layers under each other, phase functions and light from"
    " behind are lost: an incisor was 13 % too dark under even light, with a median colour difference of 4.1 by"
    " CIEDE2000, 30 % too bright under a lamp from the front, and had 2 % of its light with the lamp behind it. The"
    " coefficients stand beside the surfaces."
)
"""What a surface material cannot say, for the file. The figures are those of
``python -m tests.benchmarks.surface_materials``, without the highlight."""


@dataclass(frozen=True)
class Appearance:
    """What a surface shader is told."""

    base_colour: Colour
    """Linear reflectance under diffuse light."""
    picture: str | None
    """Path of a picture of the reflectance with the curve of sRGB, which stands for ``base_colour``; None where the
    colour is the same everywhere."""
    roughness: float
    """Roughness of the highlight, 0 to 1; its square is GGX's alpha."""
    ior: float | None
    """Refractive index of the highlight; None for a wall without one."""
    radius_mm: float | None
    """Longest mean free path of the three colours, mm; None for a surface that only reflects."""
    radius_scale: Colour
    """Mean free paths in units of ``radius_mm``, at most 1."""


def appearance(content: AssetContent, part: AssetPart) -> Appearance:
    """The appearance of a part. A tooth's mean free paths are those of its dentin, through which most light passes, and
    an object's those of its core.
    """
    inner = part.name.replace("_enamel", "_dentin").replace("_body", "_core")
    dentin = content.part(inner) or part
    # Light that meets nothing has no mean free path.
    total = dentin.scattering_reduced_per_mm() + dentin.absorption_per_mm()
    paths_mm = np.full(3, np.inf) if not total.all() else 1 / total
    scatters = bool(np.isfinite(paths_mm).all())
    roughness = ROUGHNESS if content.alpha is None or part.tissue == "gums" else float(np.sqrt(content.alpha))
    ior = None if part.tissue == "cavity" else GUMS_IOR if part.tissue == "gums" else content.ior
    return Appearance(
        base_colour=_colour(part.base_colour()),
        picture=base_colour_file(part.name) if part.name in content.textures else None,
        roughness=1.0 if ior is None else roughness,
        ior=ior,
        radius_mm=float(paths_mm.max()) if scatters else None,
        radius_scale=_colour(paths_mm / paths_mm.max()) if scatters else (1.0, 1.0, 1.0),
    )


def _colour(values: np.ndarray) -> Colour:
    red, green, blue = (float(value) for value in values)
    return red, green, blue


def open_pbr_inputs(look: Appearance) -> dict[str, tuple[str, float | Colour | str]]:
    """Inputs of OpenPBR that differ from their defaults, name -> (MaterialX type, value or path of a picture)."""
    colour = look.picture or look.base_colour
    inputs: dict[str, tuple[str, float | Colour | str]] = {
        "base_color": ("color3", colour),
        "specular_roughness": ("float", look.roughness),
    }
    if look.ior is None:
        inputs["specular_weight"] = ("float", 0.0)
    else:
        inputs["specular_ior"] = ("float", look.ior)
    if look.radius_mm is not None:
        inputs |= {
            "subsurface_weight": ("float", 1.0),
            "subsurface_color": ("color3", colour),
            "subsurface_radius": ("float", look.radius_mm),
            "subsurface_radius_scale": ("color3", look.radius_scale),
            # The mean free path is that of isotropic scattering.
            "subsurface_scatter_anisotropy": ("float", 0.0),
        }
    return inputs
