"""Pictures of the gallery's tooth with a true surface, a rough dielectric, by stock Mitsuba's ``prbvolpath``.

The ``dentine`` integrator knows no surface that refracts under lamps and environments. Stock Mitsuba does, but its
light that scattered inside finds a lamp by chance alone, because no connection goes through a refracting surface. So a
picture is put together: the scene with a black tooth as rendered, which is all reflection, and what the media add to
it, smoothed by the filter of the report's first picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.assets.colour.smoothing import smoothed_colours
from services.assets.mitsuba.rough_surface import rough_surface
from services.assets.mitsuba.scene import MAX_DEPTH, ROULETTE_DEPTH, medium_dict
from services.phantom.surface import INK, IOR
from services.transport.optics.parameters import Medium, Tissue

SceneDict = dict[str, Any]
Image = NDArray[np.float64]

RADIUS = 1 / 24
"""Radius of the smoothing filter as a share of the picture's width."""
BRIGHTEST = 0.99
"""Quantile of what the media add beside the tooth at which single bright paths are cut off."""
EDGE_SAMPLES = 64
"""Rays per pixel that tell how much of it the tooth covers."""
PASS_SAMPLES = 32
"""Paths per pixel of one pass of a render."""


def refracting_picture(scene: SceneDict, tissues: Sequence[Tissue], roughness: float, samples: int) -> Image:
    """Radiance (H, W, 3) of a scene of the gallery whose tooth is filled with media and has a rough surface.

    Args:
        scene: the scene, without media and integrator, for an RGB variant of Mitsuba.
        tissues: the media in red, green and blue.
        roughness: GGX roughness of the surface.
        samples: paths per pixel and channel.
    """
    normals, covered = _shown(scene)
    surface = rough_surface(IOR, roughness, compensated=True)
    # Free paths of one channel would carry weights without finite variance in the others, so each has a render.
    whole = np.stack(
        [_render(filled(scene, tissue, surface), samples)[..., k] for k, tissue in enumerate(tissues)], axis=-1
    )
    mirrored = _render(filled(scene, INK, surface), samples)
    added, beside = whole - mirrored, 1 - covered
    radius_px = max(1, round(RADIUS * whole.shape[1]))
    inside = smoothed_colours(added * (covered > 0)[..., None], normals, covered, radius_px)
    free = covered == 0
    most = float(np.quantile(np.abs(added[free]), BRIGHTEST)) if free.any() else 0.0
    around = smoothed_colours(np.clip(added, -most, most) * free[..., None], 0 * normals, beside * free, radius_px)
    return np.asarray(np.maximum(mirrored + inside + around, 0.0))


def filled(scene: SceneDict, tissue: Tissue, surface: SceneDict) -> SceneDict:
    """The scene with media in its tooth, in one channel, and a surface on its enamel."""
    flat = {"face_normals": False}
    enamel, dentin = (_medium(medium) for medium in (tissue.enamel, tissue.dentin))
    found = scene | {
        "integrator": {"type": "prbvolpath", "max_depth": MAX_DEPTH, "rr_depth": ROULETTE_DEPTH},
        "medium_enamel": enamel,
        "enamel": scene["enamel"] | flat | {"bsdf": surface, "interior": {"type": "ref", "id": "medium_enamel"}},
    }
    if "dentin" in scene:
        found |= {
            "medium_dentin": dentin,
            "dentin": scene["dentin"]
            | {
                "bsdf": {"type": "null"},
                "interior": {"type": "ref", "id": "medium_dentin"},
                "exterior": {"type": "ref", "id": "medium_enamel"},
            },
        }
    # Mitsuba loads in the order of the dictionary, and a reference needs what it names.
    first = {key: found[key] for key in ("type", "medium_enamel", "medium_dentin") if key in found}
    return first | {key: value for key, value in found.items() if key not in first}


def _medium(medium: Medium) -> SceneDict:
    own = medium_dict(medium)
    return own | {"sigma_t": 1.0, "scale": own["sigma_t"]}


def _render(scene: SceneDict, samples: int) -> Image:
    import mitsuba as mi

    loaded, passes = mi.load_dict(scene, optimize=False), max(1, samples // PASS_SAMPLES)
    total = np.zeros(())
    for number in range(passes):
        image = mi.render(loaded, spp=max(1, samples // passes), seed=1009 + number)
        total = total + np.array(image, dtype=np.float64)[..., :3] / passes
    return np.asarray(total)


def _shown(scene: SceneDict) -> tuple[Image, NDArray[np.float64]]:
    """Normals (H, W, 3) of the enamel, and the share (H, W) of each pixel that it covers."""
    import mitsuba as mi

    alone = {"type": "scene", "enamel": scene["enamel"], "camera": scene["camera"]}
    inner = {"type": "aov", "aovs": "normal:sh_normal"}
    image = np.array(mi.render(mi.load_dict(alone | {"integrator": inner}), spp=EDGE_SAMPLES), dtype=np.float64)[
        ..., -3:
    ]
    length = np.linalg.norm(image, axis=-1)
    # Normals over a pixel differ little, so that the length of their sum tells how many rays met the tooth.
    return image / np.maximum(length, 1e-9)[..., None], np.clip(length, 0.0, 1.0)
