"""Search for the slab that gives a sphere's readings: none is missed that they determine, and what they leave open is
said.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer

from services.cli.sphere import PROGRESS_S, notes_once, progress, sphere_command
from services.core.verdict import NOT_CONVERGED_STATUS
from services.slab.sphere.invert import fit_readings, interface_of
from services.slab.sphere.records import SphereFile
from services.slab.sphere.spectrometer import expected
from services.transport.optics.slab_totals import Optics, slab_totals
from tests.support.drawn_slabs import Drawn, drawn, is_at_truth, is_determined, outcome, random_slab

THICK = [(1.234, 42.7, 0.9405, 0.594), (1.039, 40.1, 0.9469, 0.613), (1.128, 12.6, 0.9127, 0.264)]
"""Index, optical width, albedo and g of slabs at which a search from one start ended at a far thicker one."""
PLAIN: dict[str, Any] = {
    "kind": "sphere",
    "units": "mm",
    "cell": {"width_mm": 2, "index": 1.5},
    "totals": [{"R": 0.3, "T": 0.4}],
}


def in_the_missed_region(count: int) -> list[Drawn]:
    """Slabs with R of 0.22 to 0.28 and T up to 0.10, where one start missed one of thirty."""
    random = np.random.default_rng(2)
    slabs: list[Drawn] = []
    while len(slabs) < count:
        slab = random_slab(random)
        reading = slab.file.totals[0]
        if 0.22 <= reading.R <= 0.28 and reading.T is not None and reading.T <= 0.1:
            slabs.append(slab)
    return slabs


def test_what_the_readings_determine_is_found_and_all_else_said_to_be_open() -> None:
    outcomes = [(outcome(slab)[0], is_determined(slab)) for slab in in_the_missed_region(4)]
    assert {("found", True), ("open", False)} == set(outcomes)


@pytest.mark.parametrize("slab", THICK)
def test_thick_slabs_are_not_taken_for_thicker_ones(slab: tuple[float, float, float, float]) -> None:
    one = drawn(*slab)
    (fitted,) = fit_readings(one.file)
    fit = fitted.fit
    assert fit.converged
    assert not fit.sigma_s_reduced.determined
    ratio = one.coefficients[0] / one.coefficients[1]
    if fit.absorption_ratio is None:
        assert is_at_truth(one, fitted.optics)
    else:
        # Light that still comes through, less than a hundredth, is what the ratio leaves out.
        assert fit.absorption_ratio.value == pytest.approx(ratio, rel=1e-2)


def readings_of(optics: Optics, **changes: Any) -> SphereFile:
    file = SphereFile.model_validate(PLAIN | changes)
    told = expected(slab_totals(optics, 2, interface_of(file.cell)), file, file.totals[0])
    reading = file.totals[0].model_copy(update={"R": told.R, "T": told.T})
    return file.model_copy(update={"totals": (reading,)})


def test_two_slabs_that_read_the_same_are_both_told() -> None:
    # Without the unscattered light little comes through a thin slab, as it does through a thick one.
    truth = Optics(0.0713, 0.0159, 0.0)
    (fitted,) = fit_readings(readings_of(truth, unscattered_included=False))
    fit = fitted.fit
    (other,) = fit.other_slabs
    first = readings_of(Optics(other.sigma_a, other.sigma_s_reduced, 0.0), unscattered_included=False).totals[0]
    assert pytest.approx((fit.R, fit.T), abs=1e-6) == (first.R, first.T)
    assert other.sigma_a > 10 * truth.absorption_per_mm
    assert not fit.sigma_a.determined
    assert not fit.sigma_s_reduced.determined
    assert "Another slab reads the same" in " ".join(fit.notes)


@pytest.mark.parametrize("through", [{"T": 0}, {"T": -0.0003}, {"T": 1e-7}, {}])
def test_where_no_light_comes_through_the_ratio_is_told_and_no_coefficient(through: dict[str, float]) -> None:
    (fitted,) = fit_readings(SphereFile.model_validate(PLAIN | {"totals": [{"R": 0.3} | through]}))
    fit = fitted.fit
    assert fit.converged
    assert (fit.sigma_a.value, fit.sigma_a.se, fit.sigma_s_reduced.value) == (None, None, None)
    assert fit.absorption_ratio is not None
    assert fit.absorption_ratio.value is not None
    thick = slab_totals(Optics(50 * fit.absorption_ratio.value, 50, 0), 2, interface_of(SphereFile(**PLAIN).cell))
    assert thick.reflectance == pytest.approx(0.3, abs=1e-6)
    assert fit.absorption_ratio.determined


def test_noise_beyond_the_range_of_slabs_is_no_failure() -> None:
    # R + T = 1.002 with ± 0.005 each: a white slab is 0.3 of these away.
    (fitted,) = fit_readings(SphereFile.model_validate(PLAIN | {"totals": [{"R": 0.7, "T": 0.302}]}))
    assert fitted.fit.converged
    assert 0 < fitted.fit.distance_se < 1
    assert "noise explains it" in fitted.fit.notes[0]


def told(tmp_path: Path, totals: list[dict[str, float]]) -> Path:
    path = tmp_path / "sphere.json"
    path.write_text(json.dumps(PLAIN | {"totals": totals}))
    return path


def test_the_command_ends_with_a_status_where_no_slab_is_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(typer.Exit) as ended:
        sphere_command(told(tmp_path, [{"R": 0.3, "T": 0.4}, {"R": 0.02, "T": 0.5}]), tmp_path / "out")
    assert ended.value.exit_code == NOT_CONVERGED_STATUS
    output = capsys.readouterr()
    assert "No slab was found for 1 of 2 readings: 2." in output.err
    assert "2: No slab of this width and index reads so" in output.out
    assert "which would read R 0.0508 and not 0.0200, T 0.4987 and not 0.5000" in output.out
    parameters = json.loads((tmp_path / "out" / "parameters.json").read_text())
    assert not parameters["2"]["sigma_a"]["determined"]


def test_no_number_without_meaning_is_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sphere_command(told(tmp_path, [{"R": 0.25, "T": 1e-9}]), tmp_path / "out")
    (line, *_) = capsys.readouterr().out.splitlines()
    assert line.startswith("1: σa not determined, σs′ not determined, σa/σs′ 0.1")
    parameters = json.loads((tmp_path / "out" / "parameters.json").read_text())["1"]
    assert parameters["sigma_s_reduced"] == {"value": None, "se": None, "unit": "1/mm", "determined": False}
    assert parameters["absorption_ratio"]["determined"]


def test_progress_is_told_every_few_seconds(capsys: pytest.CaptureFixture[str]) -> None:
    now = 0.0
    tell = progress(200, lambda: now)
    for done in range(1, 201):
        now += PROGRESS_S / 64
        tell(done)
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["64 of 200 readings done", "128 of 200 readings done", "192 of 200 readings done"]


def test_a_note_stands_once_with_the_readings_that_have_it() -> None:
    totals = [{"R": 0.3, "T": 0.4}, {"R": 0.3, "T": 0}, {"R": 0.02, "T": 0.5}, {"R": 0.02, "T": 0.6}]
    notes = notes_once([fitted.fit for fitted in fit_readings(SphereFile.model_validate(PLAIN | {"totals": totals}))])
    assert sum("No slab" in note for note in notes) == 1
    assert any(note.startswith("3, 4: No slab") for note in notes)
    assert sum("without a standard error" in note for note in notes) == 1
    assert any(note.startswith("2: No light comes through") for note in notes)
