"""Sections of the report on colour: differences from the photographs, translucency, and shade."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from services.assets.appearance.differences import ACCEPTED, JUST_SEEN, ColourDifference
from services.assets.appearance.shade import Shade
from services.assets.appearance.translucency import THICKNESS_MM, Translucency
from services.core.pages.pictures import data_uri, enlarge, scalar_map

MAP_LIMIT = 6.0
"""ΔE00 at which the colours of the maps end: far beyond what observers accept."""


@dataclass(frozen=True)
class Appearance:
    """What a report shows of colour; empty where the channels are not red, green and blue."""

    source: str = ""
    """Where the camera's colours come from, in words."""
    differences: Sequence[ColourDifference] = ()
    translucencies: Sequence[tuple[str, Translucency]] = ()
    """Tooth and its tissues' translucencies."""
    shade: Shade | None = None


def appearance_sections(appearance: Appearance, *, with_photographs: bool) -> dict[str, Any]:
    """Variables of the report's template. Without photographs the maps are left out, as a render and its difference
    tell of the photograph.
    """
    shown = appearance.differences if with_photographs else ()
    return {
        "colour_source": appearance.source,
        "differences": [_map(one) for one in shown],
        "difference_limit": f"{MAP_LIMIT:g}",
        "just_seen": f"{JUST_SEEN:g}",
        "accepted": f"{ACCEPTED:g}",
        "translucencies": [
            (tooth, one.tissue, f"{one.tp00:.1f}", f"{one.se:.1f}") for tooth, one in appearance.translucencies
        ],
        "translucency_mm": f"{THICKNESS_MM:g}",
        "shade": None if appearance.shade is None else _shade(appearance.shade),
    }


def _map(one: ColourDifference) -> dict[str, Any]:
    image = scalar_map(one.image, (0.0, MAP_LIMIT))
    return {
        "camera": one.camera,
        "light": one.light,
        "held_out": one.held_out,
        "image": data_uri(enlarge(image, 200)),
        "width": image.shape[1],
        "height": image.shape[0],
        "edge": f"{one.edge_px} × {one.edge_px}" if one.edge_px > 1 else "",
        "noise": f"{one.noise:.1f}",
        "median": f"{one.median:.1f}",
        "most": f"{one.most:.1f}",
    }


def _shade(shade: Shade) -> dict[str, Any]:
    return {
        "guide": shade.guide,
        "illuminant": shade.illuminant,
        "sentences": shade.sentences,
        "teeth": [
            {
                "fdi": str(tooth.fdi),
                "lab": ", ".join(
                    f"{name} {value:.1f} ± {se:.1f}"
                    for name, value, se in zip(("L*", "a*", "b*"), tooth.lab, tooth.lab_se, strict=True)
                ),
                "tabs": [(one.tab, f"{one.delta_e_2000:.1f}", f"{one.se:.1f}") for one in tooth.tabs],
            }
            for tooth in shade.teeth
        ],
    }
