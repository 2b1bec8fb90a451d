"""A laboratory's guide is read as it was measured, and what is wrong with one is said in one sentence."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from services.assets.appearance.guide import read_guide
from services.assets.appearance.white import camera_white
from services.assets.colour.develop import CapturedColours, rig_colours, xyz_from_assumed
from services.assets.content import RGB
from services.core.calibration.cameras_and_lights import CameraColour
from services.core.colour.cie import D50, lab_from_xyz
from services.core.errors import CaptureInputError
from services.phantom.files import XYZ_FROM_CAMERA

GOOD = "tab,geometry,illuminant,L,a,b,se\nA,45/0,D65,72.1,1.9,17.4,0.3\nB,45/0,D65,70,2.5,19,\n"


def guide(folder: Path, text: str) -> Path:
    path = folder / "own.csv"
    path.write_text(text)
    return path


def test_tabs_are_read_with_their_geometry_and_errors(tmp_path: Path) -> None:
    found = read_guide(guide(tmp_path, GOOD))
    assert (found.name, found.geometry, found.illuminant) == ("own", "45/0", "D65")
    assert [(tab.name, tab.lab.tolist(), tab.se) for tab in found.tabs] == [
        ("A", [72.1, 1.9, 17.4], 0.3), ("B", [70.0, 2.5, 19.0], 0.0),
    ]  # fmt: skip


def test_spectra_give_the_colours_that_colour_science_finds(tmp_path: Path) -> None:
    colour = pytest.importorskip("colour", reason="colour-science is not installed", exc_type=ImportError)
    nodes = np.arange(400, 701, 10)
    shares = np.stack([0.3 + 0.3 * (nodes - 400) / 300, np.full(31, 0.5)])
    lines = [",".join(["tab", "geometry", *map(str, nodes)])]
    lines += [",".join([name, "d/0", *map(str, row)]) for name, row in zip("AB", shares, strict=True)]
    found = read_guide(guide(tmp_path, "\n".join(lines)))
    shape = colour.SpectralShape(400, 700, 10)
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(shape)
    light = colour.SDS_ILLUMINANTS["D65"].copy().align(shape)
    white = colour.sd_to_XYZ(colour.sd_ones(shape), observer, light, method="Integration") / 100
    for tab, row in zip(found.tabs, shares, strict=True):
        spectrum = colour.SpectralDistribution(dict(zip(nodes.tolist(), row.tolist(), strict=True)))
        xyz = colour.sd_to_XYZ(spectrum, observer, light, method="Integration") / 100
        # Both leave out the light beyond 400 and 700 nm, and divide by the white of what is left.
        expected = colour.XYZ_to_Lab(xyz / white, colour.XYZ_to_xy(np.ones(3)))
        np.testing.assert_allclose(tab.lab, expected, atol=0.02)  # tables of D65 differ in their last digit


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (GOOD.replace("72.1,1.9,17.4", "72.1,1.9,"), "misses tab A: it has no value of b; measure the tab, or remove"),
        (GOOD.replace("B,45/0,D65,70,2.5,19,", "B,45/0,D65"), "misses tab B: it has no value of L"),
        (GOOD.replace("B,45/0", ",45/0"), "names no tab in line 3"),
        (GOOD.replace("B,45/0", "A,45/0"), "lists tab A twice"),
        (GOOD.replace("B,45/0", "B,d/0"), "mixes geometry 45/0 and d/0"),
        (GOOD.replace("45/0", "8/d"), "geometry '8/d'; known are 45/0, d/0"),
        (GOOD.replace("D65", "A"), "illuminant 'A'; known are D65, D50"),
        (GOOD.replace("72.1", "bright"), "gives tab A L = 'bright', which is no number"),
        (GOOD.replace("72.1", "172.1"), "L = 172.1, which lies between 0 and 100"),
        (GOOD.replace("0.3", "-1"), "a standard error below 0"),
        (GOOD.partition("B,")[0], "lists 1 tabs, and 2 are the fewest"),
        (GOOD.replace("tab,", "shade,"), "has no column tab"),
        (GOOD.replace("L,a,b", "x,y,z"), "neither columns L, a, b nor columns named by wavelengths"),
        ("tab,geometry,450,650\nA,45/0,0.5,0.6\nB,45/0,0.5,0.6\n", "wavelengths from 450 to 650 nm; a colour"),
        ("tab,geometry,420,440,460,480,500,520,540,560,580,600,620,640,660,680\nA,45/0" + ",50" * 14 + "\nB,45/0"
         + ",50" * 14 + "\n", "a reflectance of 50; write shares between 0 and 1"),
        ("", "has no column tab"),
    ],
)  # fmt: skip
def test_a_wrong_guide_is_one_sentence(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(CaptureInputError, match=said.replace("(", r"\(")) as refused:
        read_guide(guide(tmp_path, text))
    assert refused.value.message.startswith(f"Guide {tmp_path / 'own.csv'}")
    assert refused.value.message.count(". ") == 0
    assert refused.value.message.endswith(".")


def test_an_absent_guide_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(CaptureInputError, match="does not exist"):
        read_guide(tmp_path / "none.csv")


def test_channels_without_a_matrix_are_taken_for_srgb_and_white_stays_white(tmp_path: Path) -> None:
    # The matrix of sRGB adapted to D50, as ICC profiles hold it (IEC 61966-2-1 with the Bradford adaptation).
    np.testing.assert_allclose(
        xyz_from_assumed(),
        [[0.43607, 0.38515, 0.14307], [0.22249, 0.71687, 0.06061], [0.01392, 0.09708, 0.71410]],
        atol=2e-4,
    )
    np.testing.assert_allclose(xyz_from_assumed().sum(axis=1), D50, atol=1e-9)
    (tmp_path / "rig.json").write_text('{"channels": ["red", "green", "blue"], "cameras": ["c0"]}')
    white = camera_white(tmp_path)
    assert white is not None
    assert "sRGB" in white.source
    for illuminant in ("D50", "D65"):
        np.testing.assert_allclose(white.lab(np.ones((1, 3)), illuminant), [[100, 0, 0]], atol=1e-6)
    (tmp_path / "rig.json").write_text('{"channels": ["green"], "cameras": ["c0"]}')
    assert camera_white(tmp_path) is None
    (tmp_path / "rig.json").unlink()
    assert camera_white(tmp_path) is None


def test_a_cameras_root_polynomial_counts_before_its_matrix(tmp_path: Path) -> None:
    roots = ((0.6, 0.2, 0.1, 0.02, 0.02, 0.02422), (0.3, 0.6, 0.02, 0.04, 0.02, 0.02), (0, 0.1, 0.65, 0, 0.05, 0.02521))
    own = CameraColour(xyz_from_rgb=XYZ_FROM_CAMERA, root_polynomial=roots)
    told = rig_colours(CapturedColours(RGB, {"c0": own}), RGB, ("c0",), (0.0, 0.0, 0.0))
    (tmp_path / "rig.json").write_text(json.dumps({"channels": RGB, "cameras": ["c0"], "colour": told}))
    white = camera_white(tmp_path)
    assert white is not None
    assert "sRGB" not in white.source
    colours = np.array([[0.6, 0.4, 0.2], [0.1, 0.2, 0.3]])
    red, green, blue = colours.T
    terms = np.stack([red, green, blue, np.sqrt(red * green), np.sqrt(green * blue), np.sqrt(red * blue)], axis=1)
    np.testing.assert_allclose(white.lab(colours), lab_from_xyz(terms @ np.array(roots).T), rtol=1e-12)
    np.testing.assert_allclose(white.lab(np.ones((1, 3)), "D65"), [[100, 0, 0]], atol=1e-6)
