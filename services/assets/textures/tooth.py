"""Bakes the texture set of a tooth's outer surface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.assets.people_mesh import PeopleMesh
from services.assets.stains import looked_up
from services.assets.textures.texels import texels_of
from services.assets.textures.thickness import Thickness
from services.transport.optics.half_space import half_space_reflectance
from services.transport.optics.layer_reflectance import layer_reflectance
from services.transport.optics.parameters import Medium

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ToothTextures:
    """Pictures (H, W) of what was measured at each point of a tooth's outer surface."""

    texel_mm: float
    """Edge of a texel on the surface: the root of its mean area, mm."""
    texel_range_mm: tuple[float, float]
    """The 5th and the 95th percentile of the edge over the surface, mm."""
    base_colour: Mapping[str, Array]
    """Channel -> linear reflectance under even light of enamel of this thickness on deep dentin, less what the stain
    absorbs of light that passes twice."""
    thickness_mm: Array | None
    """Enamel thickness; None without dentin."""
    thickness_se_mm: Array | None
    """Its standard error; None where the fit tells none."""
    why_no_se: str
    """Why there is no standard error, in a sentence; empty where there is one."""
    stains: Mapping[str, Array]
    """Channel -> transmittance of the stain, 1 where nothing is absorbed."""
    stain_errors: Mapping[str, Array]
    """Channel -> its standard error, where the fit kept one."""


def bake(
    mesh: PeopleMesh,
    enamel: Mapping[str, Medium],
    dentin: Mapping[str, Medium],
    thickness: Thickness | None,
    stains: Mapping[str, Array],
    stain_errors: Mapping[str, Array],
) -> ToothTextures:
    """The textures of one tooth.

    Args:
        mesh: the outer surface, whose texture size is that of the pictures.
        enamel: media by channel.
        dentin: the same; empty without dentin.
        thickness: what tells the enamel's thickness; None without dentin.
        stains: transmittances in the same chart, of any size.
        stain_errors: their standard errors, of the same size; empty where there are none.
    """
    texels = texels_of(mesh)
    found = None if thickness is None else thickness.at(texels.points_mm)
    passed, errors = (
        {channel: looked_up(picture, texels.uv) for channel, picture in one.items()} for one in (stains, stain_errors)
    )
    colours = {}
    for channel, medium in enamel.items():
        if found is None or channel not in dentin:
            colour = np.full(len(texels.uv), half_space_reflectance(medium))
        else:
            colour = layer_reflectance(medium, found[0], half_space_reflectance(dentin[channel]))
        colours[channel] = texels.picture(np.clip(colour * passed.get(channel, 1.0) ** 2, 0, 1))
    edges = mesh.texel_edges_mm()
    areas = edges**2
    low, high = np.percentile(edges, [5, 95])
    return ToothTextures(
        texel_mm=float(np.sqrt(areas.mean())),
        texel_range_mm=(float(low), float(high)),
        base_colour=colours,
        thickness_mm=None if found is None else texels.picture(found[0]),
        thickness_se_mm=None if found is None or found[1] is None else texels.picture(found[1]),
        why_no_se="" if thickness is None else thickness.why_no_se,
        stains={channel: texels.picture(values) for channel, values in passed.items()},
        stain_errors={channel: texels.picture(values) for channel, values in errors.items()},
    )
