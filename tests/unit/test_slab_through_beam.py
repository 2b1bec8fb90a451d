"""The index of refraction from the beam through the cell: found again from shifts that Snell's law gives, and refused
where no index gives such shifts.
"""

from __future__ import annotations

import math
from typing import Any

import pytest
from pydantic import ValidationError

from services.core.errors import CaptureInputError
from services.core.slab.folder import SlabFolder
from services.slab.cell.interface import Interface
from services.slab.dictionaries.through_beam import index_of
from tests.support.small_slab import WAVELENGTH_NM, description

WIDTH_MM = 2.5
LIGHTS = {"l0": 5.0, "l1": -20.0}
GLASS = {"index": 1.52, "thickness_mm": 1.2}


def peak_mm(index: float, angle_deg: float, glass: dict[str, float] | None) -> float:
    """Where a beam leaves the cell, computed with the forward model's own faces."""
    faces = Interface(index, 1.0, *((glass["index"], glass["thickness_mm"]) if glass else ()))
    sine = faces.inside_sine(angle_deg)
    return WIDTH_MM * sine / math.sqrt(1 - sine**2) + 2 * faces.glass_shift_mm(sine)


def folder(
    shifts_mm: dict[str, float], se_mm: float = 0.002, glass: dict[str, float] | None = None, **beam: Any
) -> SlabFolder:
    """A folder of a cell of unknown index with these peaks."""
    cell = {"width_mm": WIDTH_MM, "index": None, "glass": glass}
    lights = [{"name": name, "side": "front", "angle_deg": angle} for name, angle in LIGHTS.items()]
    beams = [{"light": name, "peak_x_mm": shift, "se_mm": se_mm} | beam for name, shift in shifts_mm.items()]
    return SlabFolder.model_validate(description(cell=cell, lights=lights, through_beam=beams))


@pytest.mark.parametrize("index", [1.33, 1.47, 2.2])
@pytest.mark.parametrize("glass", [None, GLASS], ids=["bare", "glass"])
def test_the_index_comes_back_from_the_shifts_it_makes(index: float, glass: dict[str, float] | None) -> None:
    shifts = {name: peak_mm(index, angle, glass) for name, angle in LIGHTS.items()}
    found = index_of(folder(shifts, glass=glass), WAVELENGTH_NM)
    assert found.value == pytest.approx(index, rel=1e-12)


def test_its_error_is_that_of_the_peak() -> None:
    exact = peak_mm(1.4, -20.0, GLASS)
    told = index_of(folder({"l1": exact}, glass=GLASS), WAVELENGTH_NM)
    moved = [index_of(folder({"l1": exact + k * 1e-5}, glass=GLASS), WAVELENGTH_NM).value for k in (-1, 1)]
    assert told.se == pytest.approx(0.002 * abs(moved[1] - moved[0]) / 2e-5, rel=1e-6)
    both = {name: peak_mm(1.4, angle, GLASS) for name, angle in LIGHTS.items()}
    assert index_of(folder(both, glass=GLASS), WAVELENGTH_NM).se < told.se


def test_a_given_index_has_no_error() -> None:
    assert index_of(SlabFolder.model_validate(description()), WAVELENGTH_NM) == (1.33, 0.0)


@pytest.mark.parametrize(
    ("shifts_mm", "sentence"),
    [
        (
            {"l0": -0.1},
            "peaks at x = -0.1 mm, with which the beam would be bent to the other side; correct its peak_x_mm",
        ),
        ({"l1": -5.0}, "with which the sample's index would be 0.382; correct its peak_x_mm"),
        ({"l0": peak_mm(1.33, 5.0, None), "l1": peak_mm(1.5, -20.0, None)}, "measure its peak_x_mm again"),
    ],
)
def test_shifts_that_belong_to_no_index_are_refused(shifts_mm: dict[str, float], sentence: str) -> None:
    with pytest.raises(CaptureInputError) as told:
        index_of(folder(shifts_mm, se_mm=0.0005), WAVELENGTH_NM)
    assert sentence in told.value.message


@pytest.mark.parametrize(
    ("beam", "sentence"),
    [
        (
            {"wavelength_nm": 700.0},
            "cell.index is null, and no through_beam at 532 nm tells it; add one, or give the sample's index",
        ),
        ({"light": "l7"}, "a through_beam names light l7, which is not among the lights; correct the name"),
        ({"se_mm": 0.0}, "greater than 0"),
    ],
)
def test_through_beams_that_tell_nothing_are_refused(beam: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValidationError, match=sentence):
        folder({"l1": -0.6}, **beam)


def test_a_beam_that_is_not_bent_is_refused() -> None:
    lights = [{"name": "l0", "side": "front", "angle_deg": 0.0}]
    beams = [{"light": "l0", "peak_x_mm": 0.0, "se_mm": 0.01}]
    with pytest.raises(ValidationError, match="meets the cell at 0 degrees and is not bent"):
        SlabFolder.model_validate(description(lights=lights, through_beam=beams))
