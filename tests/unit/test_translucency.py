"""TP00 of a layer, by a published table of totals and by its limits."""

from __future__ import annotations

import numpy as np
import pytest

from services.assets.appearance.differences import colour_difference
from services.assets.appearance.translucency import THICKNESS_MM, PolishedFace, ThinFace, translucencies
from services.assets.appearance.white import CameraWhite
from services.assets.colour.develop import xyz_from_assumed
from services.assets.content import RGB
from services.core.colour.cie import delta_e_2000, lab_from_xyz
from services.core.pages.pictures import Picture
from services.core.results import Estimate
from services.transport.optics.slab_totals import Optics, slab_totals

WHITE = CameraWhite(None)


def table(scattering: float, absorption: float, g: float = 0.0, relative_se: float = 0.0) -> dict[str, Estimate]:
    """Estimates of a tooth of enamel alone with these reduced scattering and absorption per mm."""
    sigma = scattering / (1 - g) + absorption
    values = {
        "sigma": sigma, "alpha": 1 - absorption / sigma, "beta": 1.0, "g1": g, "sigma_s_reduced": scattering,
        "sigma_a": absorption,
    }  # fmt: skip
    return {
        f"enamel.{name}": Estimate(value=value, se=relative_se * value, unit="1", determined=True)
        for name, value in values.items()
    }


def tp00(scattering: float, absorption: float, **more: float) -> tuple[float, float]:
    (found,) = translucencies(dict.fromkeys(RGB, table(scattering, absorption, **more)), "matched", 1.0, WHITE)
    assert found.tissue == "enamel"
    return found.tp00, found.se


def test_a_polished_face_sends_back_the_tabulated_share_of_diffuse_light() -> None:
    face = PolishedFace(1.5)
    nodes, weights = np.polynomial.legendre.leggauss(2000)
    cosines, weights = 0.5 * (nodes + 1), 0.5 * weights
    inside = sum(2 * w * c * face.transmittance(np.sqrt(1 - c**2)) for c, w in zip(cosines, weights, strict=True))
    angles_deg = np.degrees(np.arccos(cosines))
    outside = sum(
        2 * w * c * face.transmittance(face.inside_sine(a))
        for a, c, w in zip(angles_deg, cosines, weights, strict=True)
    )
    # Index 1.5 sends back 0.0918 of diffuse light from outside and 0.5963 from inside (Orchard 1969).
    assert (1 - outside, 1 - inside) == pytest.approx((0.0918, 0.5963), abs=2e-4)


def test_a_grey_layer_without_absorption_is_that_of_the_slab_formula() -> None:
    # Under diffuse light a white layer with isotropic scattering of optical thickness 1 reflects 0.4466: van de Hulst
    # (Multiple Light Scattering 1980, table 12) gives the transmittance 0.5534. Over white all light comes back.
    totals = slab_totals(Optics(0.0, 1.0, 0.0), THICKNESS_MM, ThinFace(1.0))
    assert totals.reflectance_diffuse == pytest.approx(0.4466, abs=5e-4)
    grey = np.full((1, 3), 0.4466)
    black, white = (lab_from_xyz(one @ xyz_from_assumed().T) for one in (grey, np.ones((1, 3))))
    assert tp00(1.0, 0.0)[0] == pytest.approx(float(delta_e_2000(black, white)[0]), abs=0.03)


def test_clear_layers_are_as_translucent_as_can_be_and_dense_ones_opaque() -> None:
    assert tp00(1e-6, 0.0)[0] == pytest.approx(100.0, abs=0.1)  # ΔE00 of black and white
    assert tp00(300.0, 3.0)[0] < 0.5
    assert tp00(1.0, 0.1)[0] > tp00(2.0, 0.1)[0] > tp00(4.0, 0.1)[0]


def test_the_mean_cosine_hardly_matters_at_equal_reduced_scattering() -> None:
    # Similarity: a few per cent of the difference for a layer of one transport mean free path.
    assert tp00(1.0, 0.05, g=0.8)[0] == pytest.approx(tp00(1.0, 0.05)[0], rel=0.1)


def test_its_error_is_that_of_the_coefficients() -> None:
    value, se = tp00(1.5, 0.1, relative_se=0.05)
    more, _ = tp00(1.5 * 1.05, 0.1)
    darker, _ = tp00(1.5, 0.1 * 1.05)
    # Channels moved together change lightness by the sum of their shares, and apart by the root of the sum of squares
    # (luminance of sRGB under D50: 0.22, 0.72, 0.06), besides hue, which is not changed when they move together.
    together = np.hypot(more - value, darker - value)
    assert 0.75 * together < se < 1.2 * together


def test_thin_faces_reflect_by_fresnel() -> None:
    assert 1 - ThinFace(1.631).transmittance(0.0) == pytest.approx((0.631 / 2.631) ** 2)
    assert ThinFace(1.0).transmittance(0.9) == pytest.approx(1.0)
    assert ThinFace(1.631).transmittance(1.0) == pytest.approx(0.0, abs=1e-9)
    (thin,) = translucencies(dict.fromkeys(RGB, table(1.0, 0.1)), "thin", 1.631, WHITE)
    assert thin.tp00 != pytest.approx(tp00(1.0, 0.1)[0], abs=1.0)


def test_colour_differences_are_told_of_compared_pixels_alone() -> None:
    photo = np.full((2, 3, 3), 0.4)
    render = photo * np.array([1.0, 1.1, 1.0])
    valid = np.ones((2, 3), dtype=bool)
    valid[0, 0] = False
    photo[1, 2] = np.nan
    found = colour_difference(Picture("c0", "l0", True, photo, render, valid), np.array([0.8, 0.8, 0.8]), WHITE)
    assert found is not None
    assert np.isnan(found.image).tolist() == [[True, False, False], [False, False, True]]
    one, two = (WHITE.lab(np.array([values])) for values in ([0.5, 0.5, 0.5], [0.5, 0.55, 0.5]))
    expected = float(delta_e_2000(one, two)[0])
    assert found.median == pytest.approx(expected)
    assert found.most == pytest.approx(expected)
    assert colour_difference(Picture("c", "l", True, photo, render, np.zeros((2, 3), bool)), np.ones(3), WHITE) is None


@pytest.mark.parametrize("shift", [0.0, 0.04])
def test_maps_of_colour_differences_say_more_than_noise(shift: float) -> None:
    random, valid = np.random.default_rng(3), np.ones((60, 50), dtype=bool)
    render = np.full((60, 50, 3), 0.5)
    photo = render * np.array([1 + shift, 1.0, 1.0]) * (1 + 0.04 * random.standard_normal(render.shape))
    found = colour_difference(Picture("c0", "l0", False, photo, render, valid), np.ones(3), WHITE)
    assert found is not None
    assert found.edge_px > 1
    assert found.noise <= 1
    assert found.image.shape == (-(-60 // found.edge_px), -(-50 // found.edge_px))
    one, two = (WHITE.lab(np.array([values])) for values in ([0.5, 0.5, 0.5], [0.5 * (1 + shift), 0.5, 0.5]))
    expected = float(delta_e_2000(one, two)[0])
    # At least 12 squares: a median of as many differences, each with a spread of half the noise's median, is known to
    # 0.18 of that median. Four of these.
    assert found.median == pytest.approx(np.hypot(expected, found.noise), abs=0.72 * found.noise)


def test_noise_that_pixels_share_is_told_too() -> None:
    render, valid = np.full((20, 20, 3), 0.5), np.ones((20, 20), dtype=bool)
    shared = np.diag([0.05**2, 0.0, 0.0])
    found = colour_difference(Picture("c0", "l0", False, render, render, valid), np.ones(3), WHITE, shared)
    assert found is not None
    # No square is large enough, so they stay small. |z| of a normal draw has the median 0.674.
    assert found.edge_px == 1
    one, two = (WHITE.lab(np.array([values])) for values in ([0.5, 0.5, 0.5], [0.5 * (1 + 0.674 * 0.05), 0.5, 0.5]))
    # 12,800 draws: a median's standard error is 1.3 % of it; ΔE00 is curved by some 3 % between up and down.
    assert found.noise == pytest.approx(float(delta_e_2000(one, two)[0]), rel=0.08)
