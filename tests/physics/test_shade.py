"""Shades by the engine against a guide that stock Mitsuba measured: ``python -m tests.benchmarks.shade_guide``."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from services.anatomy.dentin_shape import DentinShape
from services.assets.appearance.guide import Guide, read_guide
from services.assets.appearance.instrument import placed
from services.assets.appearance.shade import NOT_FOR, Shade, relative_radiance, shade_of
from services.core.errors import InputError
from services.core.results import Estimate
from services.transport.engine import Engine
from services.transport.optics.parameters import Tissue
from services.transport.scene.recipe import single_tooth
from tests.support.shade_tabs import NAMES, dentin, numbers, outer, spot, tissues, write_tab

GUIDE = Path(__file__).parents[1] / "data" / "shade" / "guide.csv"
MAX_TO_RIGHT_TAB = 0.8
"""ΔE00 that half of observers just see (ISO/TR 28642); the tabs lie at least 2.9 from each other."""


@pytest.fixture(scope="module")
def guide() -> Guide:
    return read_guide(GUIDE)


def nearest(folder: Path, name: str, guide: Guide, samples: int) -> Shade:
    return shade_of(write_tab(folder / name, name), guide, samples=samples)


@pytest.mark.parametrize("name", ["P1", "S4"])
def test_the_engine_finds_the_tab_that_stock_mitsuba_measured(tmp_path: Path, guide: Guide, name: str) -> None:
    shade = nearest(tmp_path, name, guide, 512)
    (tooth,) = shade.teeth
    assert tooth.fdi == 11
    first, second = tooth.tabs[:2]
    assert first.tab == name
    assert first.delta_e_2000 < MAX_TO_RIGHT_TAB
    assert second.delta_e_2000 > 2
    assert [one.delta_e_2000 for one in tooth.tabs] == sorted(one.delta_e_2000 for one in tooth.tabs)
    assert len(tooth.tabs) == len(NAMES)
    assert shade.sentences[0] == NOT_FOR == "Not for choosing or making restorations."
    assert (shade.geometry, shade.illuminant) == ("45/0", "D65")
    assert "sRGB" in shade.colours


@pytest.mark.slow
@pytest.mark.dear("sixteen tabs of three channels are rendered")
def test_sixteen_of_sixteen_tabs_are_found(tmp_path: Path, guide: Guide) -> None:
    found = {name: nearest(tmp_path, name, guide, 1024).teeth[0].tabs[0] for name in NAMES}
    assert {name: one.tab for name, one in found.items()} == {name: name for name in NAMES}
    assert max(one.delta_e_2000 for one in found.values()) < MAX_TO_RIGHT_TAB


def test_errors_of_the_fit_are_errors_of_the_shade() -> None:
    at = placed("45/0", spot())
    shape = DentinShape.known(dentin())
    recipe = single_tooth(outer(), shape, at.light_positions_mm, at.light_intensities)
    engine = Engine(recipe)
    tissue = tissues("R2")[1]

    def measured(tissue: Tissue, relative_se: float = 0.0) -> tuple[float, float]:
        table = {
            f"{part}.{leaf}": Estimate(value=value, se=relative_se * value, unit="1", determined=True)
            for part in ("enamel", "dentin")
            for leaf, value in numbers(getattr(tissue, part)).items()
        }
        return relative_radiance(engine, table, at, 512, layered=True)

    value, noise = measured(tissue)
    _, variance = measured(tissue, 0.1)
    # The same by differences, as each coefficient in turn is a tenth larger at the same random numbers.
    changes = []
    for part in ("enamel", "dentin"):
        medium = getattr(tissue, part)
        scattering, absorption = medium.alpha * medium.sigma, (1 - medium.alpha) * medium.sigma
        for factors in ((1.1, 1.0), (1.0, 1.1)):
            more = factors[0] * scattering, factors[1] * absorption
            moved = replace(medium, sigma=sum(more), alpha=more[0] / sum(more))
            changes.append(measured(replace(tissue, **{part: moved}))[0] - value)
    # A derivative from 512 paths a pixel is known to 8 %, and a step of a tenth is of second order by up to 10 %.
    assert np.sqrt(variance - noise) == pytest.approx(np.linalg.norm(changes), rel=0.25)
    assert noise < 0.01**2


def test_other_channels_have_no_shade(tmp_path: Path, guide: Guide) -> None:
    folder = write_tab(tmp_path / "tab", "P1")
    rig = json.loads((folder / "rig.json").read_text())
    (folder / "rig.json").write_text(json.dumps(rig | {"channels": ["green"]}))
    with pytest.raises(InputError, match="has other channels than red, green, blue, so it has no colour"):
        shade_of(folder, guide)
