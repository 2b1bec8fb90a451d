"""Sixteen synthetic tabs: one small tooth of sixteen media, whose colours differ in lightness and in yellow."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from services.assets.appearance.instrument import Spot, spot_towards
from services.core.files.meshes import write_mesh
from services.core.geometry import Mesh
from services.transport.optics.parameters import MEDIUM_FIELDS, Medium, Tissue
from tests.support.small_tooth import SEMI_AXES_MM, camera_at, ellipsoid

CHANNELS = ("red", "green", "blue")
EYE = (0.0, 1.0, 0.0)
"""Direction from the tooth to the camera of its capture."""
NAMES = tuple(f"{row}{column}" for row in "PQRS" for column in range(1, 5))
GREYS = (0.05, 0.13, 0.3, 0.65)
"""Absorption per mm of the dentin in red, by row."""
YELLOWS = (1.3, 2.6, 4.6, 8.0)
"""Ratio of the dentin's absorption in blue to that in red, by column."""


def outer() -> Mesh:
    return ellipsoid(SEMI_AXES_MM)


def dentin() -> Mesh:
    return ellipsoid(SEMI_AXES_MM - 0.6)


def tissues(name: str) -> tuple[Tissue, ...]:
    """The media of a tab in red, green and blue."""
    grey, yellow = GREYS["PQRS".index(name[0])], YELLOWS[int(name[1]) - 1]
    found = []
    for share in (0.0, 0.4, 1.0):
        absorption = grey * yellow**share
        enamel = Medium(2.0 + 0.05 * absorption, 2.0 / (2.0 + 0.05 * absorption), g1=0.5)
        found.append(Tissue(enamel, Medium(5.0 + absorption, 5.0 / (5.0 + absorption), g1=0.4)))
    return tuple(found)


def spot() -> Spot:
    return spot_towards(outer(), 600.0 * np.array(EYE))


def write_tab(folder: Path, name: str, relative_se: float = 0.0) -> Path:
    """A published asset's files of one tab, as far as a shade needs them."""
    write_mesh(folder / "teeth" / "11" / "outer.ply", outer())
    write_mesh(folder / "teeth" / "11" / "dentin.ply", dentin())
    tables = {}
    for channel, tissue in zip(CHANNELS, tissues(name), strict=True):
        tables[channel] = {
            f"{part}.{leaf}": {
                "value": value, "se": relative_se * abs(value), "unit": "1", "determined": True,
            }
            for part in ("enamel", "dentin")
            for leaf, value in numbers(getattr(tissue, part)).items()
        }  # fmt: skip
    (folder / "parameters.json").write_text(json.dumps(tables))
    view = camera_at(EYE).model_dump(mode="json", exclude={"name"})
    rig = {"channels": CHANNELS, "cameras": ["c0"], "views": {"c0": view}, "boundary": "matched", "ior": 1.631}
    (folder / "rig.json").write_text(json.dumps(rig))
    return folder


def numbers(medium: Medium) -> dict[str, float]:
    own = {leaf: getattr(medium, leaf) for leaf in MEDIUM_FIELDS}
    return own | {"sigma_s_reduced": medium.sigma_s_reduced, "sigma_a": (1 - medium.alpha) * medium.sigma}
