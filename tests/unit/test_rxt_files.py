"""Files of Prahl's IAD as its version 4 reads them: columns by letters or by their count, on any lines."""

from __future__ import annotations

from pathlib import Path

import pytest

from services.core.errors import CaptureInputError
from services.slab.sphere.invert import fit_readings
from services.slab.sphere.readings import read_readings
from services.slab.sphere.records import SphereFile, TotalsReading
from services.slab.sphere.spectrometer import expected
from services.transport.optics.slab_totals import Totals
from tests.support.shared_data import shared_path

SPHERE = "203.2 25.4 12.7 1 0.96"
CLOSED = "203.2 25.4 0 1 0.96"
HEADER = f"IAD1\n1.34\n1.5\n1\n1\n5\n0.96\n1\n{SPHERE}\n{SPHERE}\n"


def read(folder: Path, text: str) -> SphereFile:
    path = folder / "x.rxt"
    path.write_text(text)
    return read_readings(path)


def test_columns_named_by_letters_are_each_readings_own(tmp_path: Path) -> None:
    text = "L r t u w W R T n N d D g i c C\n650 .3 .2 .01 .97 .98 .95 .99 1.4 1.45 2 0.5 0.8 8 0 0.5\n"
    (reading,) = read(tmp_path, HEADER + text).totals
    told = reading.model_dump(exclude_none=True)
    assert told == {
        "wavelength_nm": 650, "R": 0.3, "T": 0.2, "T_unscattered": 0.01, "reflection_wall": 0.97,
        "transmission_wall": 0.98, "standard_reflectance": 0.95, "transmission_standard": 0.99, "g": 0.8,
        "incidence_deg": 8, "specular_share": 0, "unscattered_share": 0.5, "source": "normal", "without_sphere": False,
        "cell": {
            "width_mm": 2, "index": 1.4, "index_outside": 1, "boundary": "smooth",
            "glass": {"index": 1.45, "thickness_mm": 0.5},
        },
    }  # fmt: skip


def test_a_readings_own_sample_is_the_one_that_is_fitted(tmp_path: Path) -> None:
    rows = "r t d S\n0.3 0.2 1 0\n0.3 0.2 2 0\n0.3 0.2 2 1\n"
    thin, thick, through_sphere = (one.fit for one in fit_readings(read(tmp_path, HEADER + rows)))
    assert thin.sigma_a.value == pytest.approx(2 * (thick.sigma_a.value or 0), rel=1e-6)
    assert through_sphere.sigma_a.value != pytest.approx(thick.sigma_a.value, rel=0.05)


def test_one_wall_letter_is_that_of_both_spheres(tmp_path: Path) -> None:
    (reading,) = read(tmp_path, f"{HEADER}r t w\n0.3 0.2 0.97\n").totals
    assert (reading.reflection_wall, reading.transmission_wall) == (0.97, 0.97)


def pairs(file: SphereFile) -> list[tuple[float | None, float, float | None]]:
    return [(one.wavelength_nm, one.R, one.T) for one in file.totals]


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("Lrt\n800 0.1 0.2\n", [(800, 0.1, 0.2)]),
        ("L r t # legend\n\n800 0.1 0.2 # one\n", [(800, 0.1, 0.2)]),
        ("L r t 800 0.1 0.2 810 0.2 0.3", [(800, 0.1, 0.2), (810, 0.2, 0.3)]),
        ("L r t\n800\n0.1\n0.2\n810\n0.2\n0.3\n", [(800, 0.1, 0.2), (810, 0.2, 0.3)]),
        ("2\n0.1\n0.2\n0.2\n0.3\n", [(None, 0.1, 0.2), (None, 0.2, 0.3)]),
        ("1\n0.1\n0.2\n", [(None, 0.1, None), (None, 0.2, None)]),
        ("1\n800 0.1\n810 0.2\n", [(800, 0.1, None), (810, 0.2, None)]),
        ("r\n0.1\n0.2\n", [(None, 0.1, None), (None, 0.2, None)]),
        ("2\n800 0.1 0\n", [(800, 0.1, None)]),
        ("2\n800 0.1 -0.0003\n", [(800, 0.1, -0.0003)]),
    ],
)
def test_readings_stand_on_any_lines(
    text: str, found: list[tuple[float | None, float, float | None]], tmp_path: Path
) -> None:
    assert pairs(read(tmp_path, HEADER + text)) == found


def test_the_whole_file_may_stand_on_one_line_with_letters(tmp_path: Path) -> None:
    line = " ".join(HEADER.split()) + " L r t 800 0.1 0.2 810 0.2 0.3"
    assert pairs(read(tmp_path, line)) == [(800, 0.1, 0.2), (810, 0.2, 0.3)]


def test_a_wavelength_that_comes_again_keeps_its_own_name(tmp_path: Path) -> None:
    file = read(tmp_path, f"{HEADER}L r t\n650 0.1 0.2\n757 0.1 0.2\n650 0.2 0.3\n")
    assert [name for name, _ in file.named()] == ["650", "757", "650 (2)"]


def test_seven_readings_give_both_standards(tmp_path: Path) -> None:
    (reading,) = read(tmp_path, f"{HEADER}7\n365 0.19 0.002 0 0.94 0.95 0.98 0.99\n").totals
    assert (reading.reflection_wall, reading.transmission_wall) == (0.94, 0.95)
    assert (reading.standard_reflectance, reading.transmission_standard) == (0.98, 0.99)
    assert reading.T_unscattered is None  # 0 means that it was not measured


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("L r t x\n800 0.1 0.2 1\n", "line 11: x is no letter of a column"),
        ("L r r\n800 0.1 0.2\n", "column r is named twice"),
        ("L t\n800 0.1\n", "no column is r"),
        ("r t a\n0.1 0.2 0.9\n", "column a keeps a coefficient at a value"),
        ("r t M\n0.1 0.2 1\n", "M is no letter of a column"),
        ("r t E\n0.1 0.2 0.1\n", "line 12: column E says that the slides absorb"),
        ("r t S\n0.1 0.2 2\n", "line 12: 2 spheres at once"),
        ("L r t\n0.8 0.1 0.2\n", "line 12: 0.8 is no wavelength in nm"),
        ("L r t\n800 0.1 0.2\n810 0.1\n", "line 13: 2 numbers where 3 columns were named"),
        ("r t i\n0.1 0.2 95\n", "line 12: incidence_deg"),
        ("r t n\n0.1 0.2 0.9\n", "line 12: index"),
        ("", "ends before the legend"),
    ],
)
def test_a_wrong_legend_or_line_gets_a_sentence(text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(CaptureInputError, match=r"; [^;]+\.$") as told:
        read(tmp_path, HEADER + text)
    assert words in str(told.value)


def test_a_header_that_ends_early_is_told(tmp_path: Path) -> None:
    with pytest.raises(CaptureInputError, match="17 numbers and the legend come before the readings, this file has 5"):
        read(tmp_path, "IAD1 1.34 1.5 1 1 5\nL r t\n800 0.1 0.2\n")


def test_a_closed_port_is_wall(tmp_path: Path) -> None:
    # Behind a baffle scattered light meets the wall first, and without a port the straight beam meets it, too. So light
    # is read alike, scattered or not: that the file takes 0 or 100 % of the straight beam differs by that beam alone.
    file = read(tmp_path, f"{HEADER.replace(SPHERE, CLOSED)}r t\n0.3 0.2\n")
    scattered, straight = Totals(0.1, 0.4, 0.0, 0.0, 0.1, 0.4), Totals(0.1, 0.4, 0.0, 0.4, 0.1, 0.4)
    told = [expected(totals, file, file.totals[0]).T for totals in (scattered, straight)]
    assert told[0] == pytest.approx(told[1], rel=1e-12)


def as_iad_reads(file: SphereFile, reading: TotalsReading) -> TotalsReading:
    """The reading with R as this project defines it: IAD counts the first bounce behind the baffle for the sample and
    not for the standard.
    """
    sphere = file.reflection_sphere
    if sphere is None:
        return reading
    bounce = (reading.reflection_wall or sphere.wall_reflectance) * (
        1 - (sphere.third_port_mm / sphere.diameter_mm / 2) ** 2
    )
    return reading.model_copy(update={"R": reading.R / bounce})


@pytest.mark.parametrize("name", ["fairway_A", "basic_F", "combo_0", "homa", "il_A"])
def test_readings_of_strangers_give_what_iad_gives(name: str) -> None:
    """Letters, several samples at one wavelength, 8° of incidence, seven columns and a closed port."""
    folder = shared_path("data/strangers-files/sphere-rxt")
    file = read_readings(folder / f"{name}.rxt")
    answers = [
        line.split()
        for line in (folder / "iad-4.0.0-M0" / f"{name}.txt").read_text().splitlines()
        if line.strip() and not line.startswith("#")
    ]
    assert len(answers) == len(file.totals)
    compared = [
        (reading, row) for reading, row in zip(file.totals, answers, strict=True) if row[-1] == "*" and reading.T
    ][:3]
    own = file.model_copy(update={"totals": tuple(as_iad_reads(file, reading) for reading, _ in compared)})
    for fitted, (_, row) in zip(fit_readings(own), compared, strict=True):
        # IAD inverts with 8 points and to four digits, which moves both by up to 0.8 %.
        assert fitted.fit.sigma_a.value == pytest.approx(float(row[5]), rel=1e-2)
        assert fitted.fit.sigma_s_reduced.value == pytest.approx(float(row[6]), rel=1e-2)


def test_one_reading_a_line_gives_the_ratio_that_iad_gives() -> None:
    folder = shared_path("data/strangers-files/sphere-rxt")
    fits = [fitted.fit for fitted in fit_readings(read_readings(folder / "basic_A.rxt"))]
    # The file was calculated with these ratios of absorption to scattering, and stands beside each line.
    ratios = [fit.absorption_ratio.value for fit in fits if fit.absorption_ratio]
    assert ratios == pytest.approx([0.1, 0.3, 0.5, 0.7, 0.9], rel=1e-3)
