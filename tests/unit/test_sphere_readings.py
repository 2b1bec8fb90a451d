"""Readings of an integrating sphere: both formats, what is derived from them, and the sentence for bad ones."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.cli.sphere import sphere_command
from services.core.colour.cie import lab_from_xyz
from services.core.errors import CaptureInputError, SettingsError
from services.slab.sphere.invert import Fitted, fit_readings, interface_of
from services.slab.sphere.readings import read_readings
from services.slab.sphere.records import SphereFile
from services.slab.sphere.results import SphereQuantity
from services.slab.sphere.spectrometer import expected
from services.slab.sphere.translucency import over_backing, translucency_of
from services.transport.optics.slab_totals import Optics, slab_totals
from tests.support.shared_data import shared_path

RXT = """IAD1
1.40   # index of the sample
1.50   # of the slides
1.0 1.0 0.1 1.00   # sample, slides, beam, mm; standard
{spheres}   # spheres
203.2 25.4 12.7 1.00 0.96
203.2 25.4 12.7 1.00 0.96
{columns}
"""
ROWS = """0.18744404560482633 0.5762005443502255  0.0056059263111615  #  5 0.1 0.9
0.06135333777430316 0.2084620482128875  0.0025189012963516  #  5 0.9 0.9
0.16010187736822423 0.06857093492328084 6.34122291893490e-12 # 25 0.7 0.9
"""
"""Lines of the calculated readings basic-C of iadpython 0.5.3: R, T, unscattered T of mu_s, mu_a, g."""
TRUTHS = [(5, 0.1, 0.9), (5, 0.9, 0.9), (25, 0.7, 0.9)]
PLAIN: dict[str, Any] = {
    "kind": "sphere",
    "units": "mm",
    "cell": {"width_mm": 2, "index": 1.5, "glass": None},
    "totals": [{"wavelength_nm": 550, "R": 0.3, "R_se": 0.002, "T": 0.4, "T_se": 0.003}],
}
FEW = 12
"""Number of nodes where the same model makes the readings and evaluates them, so that its own error cancels."""
SPHERE = {
    "diameter_mm": 100,
    "sample_port_mm": 20,
    "third_port_mm": 10,
    "detector_port_mm": 5,
    "wall_reflectance": 0.97,
}


def rxt(folder: Path, rows: str, spheres: float = 0, columns: float = 3) -> Path:
    path = folder / "readings.rxt"
    path.write_text(RXT.format(spheres=spheres, columns=columns) + rows)
    return path


def known(quantity: SphereQuantity) -> tuple[float, float]:
    """Value and standard error of a quantity that is shown."""
    assert quantity.value is not None
    assert quantity.se is not None
    return quantity.value, quantity.se


def test_calculated_readings_give_their_coefficients_back(tmp_path: Path) -> None:
    fits = fit_readings(read_readings(rxt(tmp_path, ROWS)))
    for fitted, (scattering, absorption, g) in zip(fits, TRUTHS, strict=True):
        fit = fitted.fit
        assert fit.converged
        # The listed inversion is right within 1.1 % and 0.001; the error from 16 points is below 0.1 %.
        assert fit.sigma_a.value == pytest.approx(absorption, rel=1.1e-2)
        assert fit.sigma_s_reduced.value == pytest.approx(scattering * (1 - g), rel=1e-3)
        assert fit.g.value == pytest.approx(g, abs=1e-3)
        assert fit.sigma_s is not None
        assert fit.sigma_s.value == pytest.approx(scattering, rel=1e-3)


@pytest.mark.slow
def test_all_calculated_readings_of_the_shared_data_give_their_coefficients_back() -> None:
    path = shared_path("data/integrating-sphere/basic-C.rxt")
    truths = [
        [float(word) for word in line.split("#")[1].split()]
        for line in path.read_text().splitlines()
        if line[:3] in {"0.0", "0.1", "0.2", "0.3"} and line.count(".") > 3
    ]
    fits = fit_readings(read_readings(path))
    assert len(fits) == len(truths) == 24
    for fitted, (scattering, absorption, g) in zip(fits, truths, strict=True):
        assert fitted.fit.sigma_a.value == pytest.approx(absorption, rel=1.1e-2)
        assert fitted.fit.sigma_s_reduced.value == pytest.approx(scattering * (1 - g), rel=1.1e-2)
        assert fitted.fit.g.value == pytest.approx(g, abs=1e-3)


def written(file: dict[str, Any], optics: Optics, **reading: Any) -> SphereFile:
    """The file with the readings that the instrument gives for a medium."""
    known = SphereFile.model_validate(file)
    totals = slab_totals(optics, known.cell.width_mm, interface_of(known.cell), FEW)
    first = known.totals[0].model_copy(update=reading)
    told = expected(totals, known, first)
    return known.model_copy(update={"totals": (first.model_copy(update={"R": told.R, "T": told.T}),)})


@pytest.mark.parametrize(
    "changes",
    [
        {"reflection_sphere": SPHERE, "transmission_sphere": SPHERE, "standard_reflectance": 0.9},
        {"reflection_sphere": SPHERE | {"baffle": False}, "specular_included": False, "unscattered_included": False},
    ],
)
@pytest.mark.parametrize("source", ["normal", "diffuse"])
def test_readings_through_any_instrument_give_the_medium_back(changes: dict[str, Any], source: str) -> None:
    optics = Optics(0.05, 4, 0.8)
    (fitted,) = fit_readings(written(PLAIN | {"g": 0.8} | changes, optics, source=source), FEW)
    assert fitted.fit.sigma_a.value == pytest.approx(0.05, rel=1e-5)
    assert fitted.fit.sigma_s_reduced.value == pytest.approx(0.8, rel=1e-5)
    assert not fitted.fit.g.determined  # g was given, not measured
    assert fitted.fit.sigma_s is None


def test_standard_errors_are_those_of_repeated_readings() -> None:
    file = SphereFile.model_validate(PLAIN)
    (plain,) = fit_readings(file, FEW)
    fit = plain.fit
    moved = []
    for name in ("R", "T"):
        first = file.totals[0]
        step = getattr(first, f"{name}_se")
        changed = first.model_copy(update={name: getattr(first, name) + step})
        (other,) = fit_readings(file.model_copy(update={"totals": (changed,)}), FEW)
        pairs = ((other.fit.sigma_a, fit.sigma_a), (other.fit.sigma_s_reduced, fit.sigma_s_reduced))
        moved.append([known(one)[0] - known(two)[0] for one, two in pairs])
    expected_se = np.sqrt(np.square(moved).sum(axis=0))
    # Readings are changed by one standard error, over which the coefficients are linear to 3 %.
    assert [fit.sigma_a.se, fit.sigma_s_reduced.se] == pytest.approx(expected_se, rel=3e-2)


def test_an_error_of_the_collimated_reading_reaches_g() -> None:
    optics = Optics(0.2, 2, 0.7)
    file = written(PLAIN, optics)
    through = slab_totals(optics, 2, interface_of(file.cell)).transmittance_unscattered
    told = [through, through * 1.02]
    readings = [
        file.totals[0].model_copy(update={"T_unscattered": t, "T_unscattered_se": 0.02 * through}) for t in told
    ]
    plain, other = (fit_readings(file.model_copy(update={"totals": (reading,)}), FEW)[0].fit for reading in readings)
    assert plain.g.value == pytest.approx(0.7, abs=1e-5)
    assert plain.sigma_t is not None
    assert other.sigma_t is not None
    assert known(plain.sigma_t)[1] == pytest.approx(known(plain.sigma_t)[0] - known(other.sigma_t)[0], rel=3e-2)
    from_readings = fit_readings(
        file.model_copy(update={"totals": (readings[0].model_copy(update={"T_unscattered_se": 1e-9}),)}), FEW
    )[0].fit.g
    g, g_se = known(plain.g)
    assert g_se**2 - known(from_readings)[1] ** 2 == pytest.approx((known(other.g)[0] - g) ** 2, rel=6e-2)


def test_readings_of_no_slab_are_told_and_not_believed(tmp_path: Path) -> None:
    file = SphereFile.model_validate(PLAIN | {"totals": [{"R": 0.02, "T": 0.5}, {"R": 0.7, "T": 0.6}]})
    for fitted in fit_readings(file, FEW):
        assert not fitted.fit.converged
        assert "No slab of this width and index reads" in fitted.fit.notes[0]


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "unknown key": ({"colour": "red"}, "colour"),
    "no readings": ({"totals": []}, "totals"),
    "no index": ({"cell": {"width_mm": 1, "index": None}}, "give the sample's index"),
    "a sample thinner than its surroundings": (
        {"cell": {"width_mm": 1, "index": 1.2, "index_outside": 1.33}},
        "below index_outside",
    ),
    "a wavelength twice": ({"totals": 2 * PLAIN["totals"]}, "550 nm is listed twice"),
    "a reading above all light": ({"totals": [{"R": 3, "T": 0.1}]}, "totals.0.R"),
    "a port larger than its sphere": ({"reflection_sphere": SPHERE | {"sample_port_mm": 120}}, "below diameter_mm"),
    "a wall that keeps all light": ({"reflection_sphere": SPHERE | {"wall_reflectance": 1}}, "wall_reflectance"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_wrong_file_gets_a_sentence(name: str, tmp_path: Path) -> None:
    changes, words = BAD[name]
    path = tmp_path / "sphere.json"
    path.write_text(json.dumps(PLAIN | changes))
    with pytest.raises(CaptureInputError, match=r"; [^;]+\.$") as told:
        read_readings(path)
    assert words in str(told.value)


@pytest.mark.parametrize(
    ("rows", "header", "words"),
    [
        ("0.1 0.2 x", {}, "line 9: 0.1 0.2 x is not a list of numbers"),
        ("0.1 nan 0.2", {}, "line 9: 0.1 nan 0.2 holds a number that is not finite"),
        (ROWS, {"spheres": float("inf")}, "line 5: inf holds a number that is not finite"),
        ("0.1", {}, "line 9: 1 numbers where 3 readings"),
        (ROWS, {"spheres": 2}, "2 spheres at once"),
        (ROWS, {"columns": 8}, "8 readings a line"),
        ("", {}, "no readings behind its legend"),
    ],
)
def test_a_wrong_rxt_file_gets_a_sentence(rows: str, header: dict[str, float], words: str, tmp_path: Path) -> None:
    with pytest.raises(CaptureInputError) as told:
        read_readings(rxt(tmp_path, rows, **header))
    assert words in str(told.value)


def test_what_is_no_rxt_file_is_told(tmp_path: Path) -> None:
    with pytest.raises(CaptureInputError, match="does not exist"):
        read_readings(tmp_path / "none.rxt")
    other = tmp_path / "other.rxt"
    other.write_text("M_R, M_T\n")
    with pytest.raises(CaptureInputError, match="begin with IAD1"):
        read_readings(other)


def test_the_command_writes_by_wavelength(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "sphere.json"
    file.write_text(json.dumps(PLAIN))
    sphere_command(file, tmp_path / "out")
    told = json.loads((tmp_path / "out" / "parameters.json").read_text())["550"]
    assert set(told) == {"sigma_a", "sigma_s_reduced", "g"}
    assert told["sigma_a"]["se"] > 0
    readings = json.loads((tmp_path / "out" / "readings.json").read_text())["550"]
    assert readings["R_fitted"] == pytest.approx(0.3, abs=1e-6)
    assert "550: σa" in capsys.readouterr().out
    # One wavelength gives no colour.
    assert not (tmp_path / "out" / "translucency.json").exists()
    with pytest.raises(SettingsError, match="darker backing"):
        sphere_command(file, tmp_path / "out", black=0.5, white=0.5)


def test_a_grey_slab_over_black_and_white() -> None:
    nm = range(400, 701, 20)
    file = SphereFile.model_validate(PLAIN | {"totals": [PLAIN["totals"][0] | {"wavelength_nm": w} for w in nm]})
    optics = Optics(0.1, 1.5, 0)
    (fitted,) = fit_readings(file.model_copy(update={"totals": file.totals[:1]}), FEW)
    fits = [Fitted(fitted.fit, optics, 1e-6 * np.eye(2))] * len(nm)
    totals = slab_totals(optics, 2, interface_of(file.cell))
    told = translucency_of(file, fits, 0.05, 0.9)
    assert told is not None
    # A spectrum without colour has X, Y, Z in the ratio of the light's: Y is the reflectance, a and b are 0.
    dark, bright = over_backing(totals, 0.05), over_backing(totals, 0.9)
    assert told.contrast_ratio == pytest.approx(dark / bright, rel=1e-9)
    lightness = [116 * y ** (1 / 3) - 16 for y in (dark, bright)]
    assert told.translucency_parameter == pytest.approx(lightness[1] - lightness[0], rel=1e-9)
    assert (told.over_white.L, told.over_white.a, told.over_white.b) == pytest.approx((lightness[1], 0, 0), abs=1e-9)
    wider = translucency_of(file, [Fitted(fitted.fit, optics, 4e-6 * np.eye(2))] * len(nm), 0.05, 0.9)
    assert wider is not None
    assert wider.translucency_parameter_se == pytest.approx(2 * told.translucency_parameter_se, rel=1e-6)
    # Independent errors of sixteen wavelengths have less effect than one error that all share, and at least a quarter
    # of it.
    shared = [lightness_gain(Optics(0.101, 1.5, 0), file), lightness_gain(Optics(0.1, 1.501, 0), file)]
    common = float(np.hypot(*(np.array(shared) - told.translucency_parameter)))
    assert common / 4 < told.translucency_parameter_se < common


def lightness_gain(optics: Optics, file: SphereFile) -> float:
    """Difference of lightness of a slab without colour over black and over white: its translucency parameter."""
    totals = slab_totals(optics, file.cell.width_mm, interface_of(file.cell))
    return 116 * (over_backing(totals, 0.9) ** (1 / 3) - over_backing(totals, 0.05) ** (1 / 3))


def test_lab_of_a_known_colour() -> None:
    # sRGB's red primary under D65: L 53.24, a 80.09, b 67.20 by the standard's matrix.
    red, white = np.array([0.4124564, 0.2126729, 0.0193339]), np.array([0.95047, 1, 1.08883])
    assert lab_from_xyz(red, white) == pytest.approx([53.24, 80.09, 67.20], abs=0.01)
    assert lab_from_xyz(white, white) == pytest.approx([100, 0, 0], abs=1e-12)


def test_a_backing_sends_light_back_through_the_slab() -> None:
    totals = slab_totals(Optics(0, 2, 0), 1, interface_of(SphereFile.model_validate(PLAIN).cell))
    assert over_backing(totals, 0) == totals.reflectance
    # A white slab over a white backing absorbs nothing.
    assert over_backing(totals, 1) == pytest.approx(1, abs=1e-6)
    assert math.isclose(totals.reflectance + totals.transmittance, 1, abs_tol=1e-6)
