"""Tables and readings as other programs write them: encodings, separators, scales and lights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from services.calibrate.colour.chart import read_reference
from services.core.errors import CaptureInputError
from services.core.files.scans import read_sidecar
from services.slab.sphere.invert import fit_readings
from services.slab.sphere.readings import read_readings
from tests.support.shared_data import shared_path

D50, D65 = np.array([0.9642, 1.0, 0.8251]), np.array([0.9504, 1.0, 1.0888])
GREYS = np.array([90.0, 59.1, 36.2, 19.8, 9.0, 3.1])


def chart(white: np.ndarray = D50, scale: float = 1.0) -> np.ndarray:
    """XYZ of 24 patches whose neutrals are grey under a light."""
    xyz = np.random.default_rng(0).uniform(5, 60, (24, 3))
    xyz[18:] = GREYS[:, None] * white
    return xyz * scale


def text_of(xyz: np.ndarray, separator: str = ",") -> str:
    rows = [separator.join(f"{one:.4f}" for one in row) for row in xyz]
    return "\n".join([separator.join("XYZ"), *rows]) + "\n"


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-be"])
@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_a_chart_is_read_in_every_encoding_and_with_every_separator(
    encoding: str, separator: str, tmp_path: Path
) -> None:
    text = text_of(chart(), separator)
    if separator == ";":
        text = text.replace(".", ",")
    mark = "\ufeff" if encoding == "utf-16-be" else ""
    (tmp_path / "chart.csv").write_bytes((mark + text).encode(encoding))
    np.testing.assert_allclose(read_reference(tmp_path / "chart.csv", "c"), chart() / 100, atol=1e-6)


REFUSED: dict[str, tuple[str | bytes, str]] = {
    "Y from 0 to 1": (text_of(chart(scale=0.01)), "gives Y as a fraction of 1; give Y = 100"),
    "Y of white 100": (text_of(chart(scale=1 / 0.9)), "Y = 100 for its white patch 19"),
    "D65": (text_of(chart(D65)), r"chromaticity 0.313, 0.329 \(those of D65\).*give XYZ under D50"),
    "neutrals the other way": (text_of(np.vstack([chart()[:20], chart()[:19:-1]])), "do not darken one by one"),
    "no number": (text_of(chart()).replace("9.0000", "nan", 1), "not finite"),
    "Latin letters": ("X,Y,Zé\n".encode("latin-1"), "no text in UTF-8"),
    "bytes": (b"X,Y,Z\n\0\0", "no text"),
    "without columns": ("a,b\n1,2\n", "no columns X, Y and Z"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_another_scale_or_light_is_refused(case: str, tmp_path: Path) -> None:
    text, words = REFUSED[case]
    (tmp_path / "chart.csv").write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(CaptureInputError, match=words):
        read_reference(tmp_path / "chart.csv", "c")


@pytest.mark.parametrize(
    ("file", "words"),
    [("unit.csv", "Y as a fraction of 1"), ("good.csv", None), ("semi.csv", None), ("utf16.csv", None)],
)
def test_charts_of_strangers(file: str, words: str | None) -> None:
    path = shared_path("data/strangers-files/chart-csv") / file
    if words is not None:
        with pytest.raises(CaptureInputError, match=words):
            read_reference(path, "c")
    else:
        np.testing.assert_allclose(
            read_reference(path, "c"), read_reference(path.with_name("good.csv"), "c"), atol=1e-6
        )


def test_labels_are_read_in_every_encoding(tmp_path: Path) -> None:
    (tmp_path / "labels.csv").write_text("1;2\n3, 4\n", encoding="utf-16")
    np.testing.assert_array_equal(read_sidecar(tmp_path / "labels.csv"), [1, 2, 3, 4])


SPHERE = "203.2 25.4 12.7 1 0.96"
HEADER = f"IAD1\n1.34\n1.5\n1\n1\n5\n0.96\n1\n{SPHERE}\n{SPHERE}\n"


def rxt(folder: Path, text: str) -> Path:
    (folder / "x.rxt").write_text(text)
    return folder / "x.rxt"


def test_one_wall_reflectance_is_that_of_both_spheres(tmp_path: Path) -> None:
    four = fit_readings(read_readings(rxt(tmp_path, f"{HEADER}4\n925 0.47248 0.47882 0 0.97\n")))
    five = fit_readings(read_readings(rxt(tmp_path, f"{HEADER}5\n925 0.47248 0.47882 0 0.97 0.97\n")))
    assert [one.fit for one in four] == [one.fit for one in five]
    (reading,) = read_readings(rxt(tmp_path, f"{HEADER}4\n925 0.47248 0.47882 0 0.97\n")).totals
    assert (reading.reflection_wall, reading.transmission_wall) == (0.97, 0.97)


def test_all_numbers_may_stand_on_one_line(tmp_path: Path) -> None:
    line = " ".join(f"{HEADER}2".split()) + " 0.168 0.249 900 0.162 0.264"
    found = read_readings(rxt(tmp_path, line)).totals
    assert [(one.wavelength_nm, one.R, one.T) for one in found] == [(None, 0.168, 0.249), (900, 0.162, 0.264)]


RXT_REFUSED = {
    "decimal commas": (HEADER.replace(".", ",") + "2\n800 0,1 0,2\n", "1,34.*write decimal points"),
    "a wavelength that is none": (f"{HEADER}2\n0.5 0.1 0.2\n", "line 12: the first of 3 numbers is 0.5"),
    "a reading far below zero": (f"{HEADER}2\n800 0.1 -0.3\n", "line 12: T: "),
    "half a reading": (f"{HEADER}2\n800 0.1 0.2 900 0.1\n", "5 numbers where 2 readings"),
}


@pytest.mark.parametrize("case", RXT_REFUSED)
def test_readings_that_are_not_understood_are_refused(case: str, tmp_path: Path) -> None:
    text, words = RXT_REFUSED[case]
    with pytest.raises(CaptureInputError, match=words):
        read_readings(rxt(tmp_path, text))


def test_readings_of_strangers_with_decimal_commas_are_refused() -> None:
    with pytest.raises(CaptureInputError, match="write decimal points"):
        read_readings(shared_path("data/strangers-files/sphere-rxt") / "comma.rxt")


@pytest.mark.parametrize(
    "file", ["basic_A", "basic_F", "combo_0", "fairway_A", "four", "homa", "il_A", "sample_D", "terse_A", "x_bad_data"]
)
def test_readings_of_strangers_that_are_read(file: str) -> None:
    assert len(read_readings(shared_path("data/strangers-files/sphere-rxt") / f"{file}.rxt").totals) >= 2
