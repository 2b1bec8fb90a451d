"""Colour matrices, compared with colour-science, with OpenCV's own, and with photographs of charts."""

from __future__ import annotations

import numpy as np
import pytest

from services.calibrate.colour.transform import fit_colour, least_squares_matrix
from services.core.calibration.colours import root_terms
from services.core.colour.cie import D65, delta_e_2000, lab_from_xyz
from services.core.errors import CaptureInputError
from tests.support.shared_data import shared_path

XYZ_FROM_SRGB = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
SHARMA = np.array(
    [
        line.split()
        for line in """
50 2.6772 -79.7751 50 0 -82.7485 2.0425
50 3.1571 -77.2803 50 0 -82.7485 2.8615
50 2.8361 -74.02 50 0 -82.7485 3.4412
50 -1.3802 -84.2814 50 0 -82.7485 1.0
50 -1.1848 -84.8006 50 0 -82.7485 1.0
50 -0.9009 -85.5211 50 0 -82.7485 1.0
50 0 0 50 -1 2 2.3669
50 -1 2 50 0 0 2.3669
50 2.49 -0.001 50 -2.49 0.0009 7.1792
50 2.49 -0.001 50 -2.49 0.001 7.1792
50 2.49 -0.001 50 -2.49 0.0011 7.2195
50 2.49 -0.001 50 -2.49 0.0012 7.2195
50 -0.001 2.49 50 0.0009 -2.49 4.8045
50 -0.001 2.49 50 0.001 -2.49 4.8045
50 -0.001 2.49 50 0.0011 -2.49 4.7461
50 2.5 0 50 0 -2.5 4.3065
50 2.5 0 73 25 -18 27.1492
50 2.5 0 61 -5 29 22.8977
50 2.5 0 56 -27 -3 31.903
50 2.5 0 58 24 15 19.4535
50 2.5 0 50 3.1736 0.5854 1.0
50 2.5 0 50 3.2972 0 1.0
50 2.5 0 50 1.8634 0.5757 1.0
50 2.5 0 50 3.2592 0.335 1.0
60.2574 -34.0099 36.2677 60.4626 -34.1751 39.4387 1.2644
63.0109 -31.0961 -5.8663 62.8187 -29.7946 -4.0864 1.263
61.2901 3.7196 -5.3901 61.4292 2.248 -4.962 1.8731
35.0831 -44.1164 3.7933 35.0232 -40.0716 1.5901 1.8645
22.7233 20.0904 -46.694 23.0331 14.973 -42.5619 2.0373
36.4612 47.858 18.3852 36.2715 50.5065 21.2231 1.4146
90.8027 -2.0831 1.441 91.1528 -1.6435 0.0447 1.4441
90.9257 -0.5406 -0.9208 88.6381 -0.8985 -0.7239 1.5381
6.7747 -0.2908 -2.4247 5.8714 -0.0985 -2.2286 0.6377
2.0776 0.0795 -1.135 0.9033 -0.0636 -0.5514 0.9082
""".strip().splitlines()
    ],
    dtype=float,
)
"""All pairs of L*a*b* of the published table, and their ΔE2000 to four digits (Sharma, Wu & Dalal 2005, table 1)."""


def test_colour_differences_are_those_of_the_published_table() -> None:
    one, two, expected = SHARMA[:, :3], SHARMA[:, 3:6], SHARMA[:, 6]
    assert len(SHARMA) == 34
    for pair in ((one, two), (two, one)):
        np.testing.assert_allclose(delta_e_2000(*pair), expected, rtol=0, atol=5e-5)


def test_matrices_are_those_of_colour_science() -> None:
    colour = pytest.importorskip("colour", reason="colour-science is not installed", exc_type=ImportError)
    random = np.random.default_rng(0)
    rgb = random.uniform(0.05, 0.9, (24, 3))
    xyz = rgb @ XYZ_FROM_SRGB.T + random.normal(0, 0.01, (24, 3))
    theirs = colour.characterisation
    plain = theirs.matrix_colour_correction_Cheung2004(rgb, xyz, terms=3)
    assert least_squares_matrix(rgb, xyz) == pytest.approx(plain, abs=1e-6)
    roots = theirs.matrix_colour_correction_Finlayson2015(rgb, xyz, degree=2, root_polynomial_expansion=True)
    assert least_squares_matrix(root_terms(rgb), xyz) == pytest.approx(roots, abs=1e-6)
    lab = [lab_from_xyz(random.uniform(0, 1, (500, 3))) for _ in range(2)]
    assert delta_e_2000(*lab) == pytest.approx(colour.difference.delta_E_CIE2000(*lab), abs=1e-6)


def test_the_loss_of_opencvs_matrix_on_a_photographed_chart_is_its_own() -> None:
    import cv2

    folder = shared_path("data/ccm-reference")
    values = np.genfromtxt(folder / "mcc_ccm_test_values.csv", delimiter=",", skip_header=2)[:, 1:]
    expected = np.genfromtxt(folder / "mcc_ccm_test_expected.csv", delimiter=",")
    model = cv2.ccm.ColorCorrectionModel((values / 255).reshape(-1, 1, 3), cv2.ccm.COLORCHECKER_MACBETH)
    model.compute()
    assert model.getColorCorrectionMatrix() == pytest.approx(expected, abs=1e-12)
    linear, reference = (np.reshape(one, (-1, 3)) for one in (model.getSrcLinearRGB(), model.getRefLinearRGB()))
    labs = (lab_from_xyz(one @ XYZ_FROM_SRGB.T, D65) for one in (linear @ expected, reference))
    # The published loss is the rms of ΔE2000, to four digits.
    assert np.sqrt(np.mean(delta_e_2000(*labs) ** 2)) == pytest.approx(4.6387, abs=1e-4)


def test_a_real_chart_is_fitted_as_well_as_by_plain_least_squares() -> None:
    from scipy.io import loadmat

    table = loadmat(shared_path("data/colorchecker-raw") / "color_correction" / "CalibrateColorCorrectionData.mat")
    rgb, xyz = (np.asarray(table[key], dtype=np.float64) for key in ("patch_means_rgb", "reflectances_xyz"))
    fit = fit_colour(rgb, xyz, "camera", D65)
    plain = delta_e_2000(lab_from_xyz(rgb @ fit.matrix.T, D65), lab_from_xyz(xyz, D65))
    told = (plain.mean(), np.median(plain), plain.max())
    # Its source states mean 5.56, median 5.05, largest 14.8.
    assert told == pytest.approx((5.56, 5.05, 14.8), abs=0.05)
    assert fit.held_out.mean() == min(fit.held_out_by_model.values()) or fit.root_polynomial is None


def test_left_out_patches_are_those_of_separate_fits() -> None:
    random = np.random.default_rng(1)
    rgb = random.uniform(0.05, 0.9, (24, 3))
    xyz = rgb @ XYZ_FROM_SRGB.T + random.normal(0, 0.02, (24, 3))
    fit = fit_colour(rgb, xyz, "camera", D65)
    assert fit.root_polynomial is None
    drawn = []
    for patch in range(24):
        others = np.arange(24) != patch
        drawn.append(least_squares_matrix(rgb[others], xyz[others]) @ rgb[patch])
    expected = delta_e_2000(lab_from_xyz(np.array(drawn), D65), lab_from_xyz(xyz, D65))
    assert fit.held_out == pytest.approx(expected, abs=1e-9)


def test_a_root_polynomial_is_taken_where_channels_bend() -> None:
    random = np.random.default_rng(2)
    rgb = random.uniform(0.02, 0.9, (24, 3))
    true = random.uniform(0.1, 0.5, (3, 6))
    fit = fit_colour(rgb, root_terms(rgb) @ true.T, "camera", D65)
    assert fit.root_polynomial == pytest.approx(true, abs=1e-9)
    assert fit.xyz(2 * rgb) == pytest.approx(2 * fit.xyz(rgb))


def test_a_saturated_chart_is_named() -> None:
    with pytest.raises(CaptureInputError, match="Camera left shows 5 patches"):
        fit_colour(np.ones((5, 3)), np.ones((5, 3)), "left")
