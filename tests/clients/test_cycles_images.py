"""Cycles shows of an asset what stock Mitsuba shows of the same surfaces and numbers.

The limits are those that ``python -m tests.benchmarks.cycles`` reaches with more paths; each test states the standard
error that it needs of its own ones.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from services.transport.platform import prepare_device
from tests.benchmarks.cycles import cases
from tests.support.clients import client_python
from tests.support.cycles_scenes import Case, Ratio, cycles_image, mitsuba_image, ratio_of, write_case
from tests.support.shared_data import shared_path

CASES = cases()
QUICK = ["ball, sky", "nested balls, sky", "nested balls, thin, sky", "glass ball, sky"]
SEEDS = 3
NO_GAP = ("GAP_MM = 1e-4", "GAP_MM = 0.0")


def ratio(folder: Path, case: Case, paths: int, changed: tuple[str, str] | None = None) -> Ratio:
    """Cycles ÷ Mitsuba of a case, of ``SEEDS`` renders each; ``changed`` replaces a text of the script by another."""
    client_python("bpy")
    prepare_device()
    write_case(folder, case)
    if changed:
        script = folder / "blender" / "blender_scene.py"
        assert changed[0] in script.read_text()
        script.write_text(script.read_text().replace(*changed))
    seeds = range(1, SEEDS + 1)
    cycles, mitsuba = (
        np.stack([image(folder, case, paths, seed) for seed in seeds]) for image in (cycles_image, mitsuba_image)
    )
    return ratio_of(cycles, mitsuba, case.covered())


@pytest.mark.dear("paths of hundreds of scattering events in two programs")
@pytest.mark.parametrize("name", QUICK)
def test_balls_agree_under_a_sky(name: str, tmp_path: Path) -> None:
    case, *_, limit = CASES[name]
    found = ratio(tmp_path, case(), 512)
    # The limit is at least three standard errors, so that a correct run in 400 fails and a wrong index does not pass.
    assert found.se.max() < limit / 3
    assert np.abs(found.value - 1).max() < limit


@pytest.mark.dear("paths of hundreds of scattering events in two programs")
def test_faces_at_the_same_place_are_noticed(tmp_path: Path) -> None:
    case = replace(CASES["nested balls, lamp"][0](), words=())
    found = ratio(tmp_path, case, 256, NO_GAP)
    assert np.abs(found.value - 1).max() > 0.05 + 3 * found.se.max()


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in CASES if name not in {*QUICK, "coincident"}])
def test_every_case_agrees(name: str, tmp_path: Path) -> None:
    if name.startswith("incisor"):
        shared_path("data/tooth-ur1-truth")
    case, paths, _, limit = CASES[name]
    found = ratio(tmp_path, case(), paths)
    assert found.se.max() < limit / 2
    assert np.abs(found.value - 1).max() < limit
