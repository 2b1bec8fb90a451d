"""Media of an asset in linear sRGB, in ACEScg and as spectra: exact where they must be, and images by stock Mitsuba."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from services.assets.colour.media import (
    MAX_REFLECTANCE,
    ReducedMedium,
    acescg_from_srgb,
    matrix_between,
    smooth_spectrum,
    srgb_of_spectrum,
    upsampled,
)
from services.assets.colour.spaces import ACESCG, LINEAR_SRGB
from services.core.colour.observer import observer_under_d65
from services.phantom.files import XYZ_FROM_CAMERA
from services.phantom.tooth import TRUE_TISSUE
from services.transport.optics.half_space import albedo_of_reflectance, half_space_reflectance
from services.transport.optics.parameters import Medium
from tests.support.mitsuba_variants import variant

CHANNELS = ("red", "green", "blue")
ENAMEL, DENTIN = ([TRUE_TISSUE[channel].medium(part) for channel in CHANNELS] for part in ("enamel", "dentin"))


def test_a_reflectance_goes_to_an_albedo_and_back() -> None:
    reflectances = np.linspace(0.0, 1.0, 21)
    back = [half_space_reflectance(Medium(1.0, float(albedo))) for albedo in albedo_of_reflectance(reflectances)]
    np.testing.assert_allclose(back, reflectances, atol=1e-12)


@pytest.mark.parametrize("media", [ENAMEL, DENTIN])
def test_a_half_space_has_the_colour_that_the_matrix_gives(media: list[Medium]) -> None:
    camera = ReducedMedium.of(media)
    for space in (LINEAR_SRGB, ACESCG):
        matrix = matrix_between(np.array(XYZ_FROM_CAMERA), space)
        np.testing.assert_allclose(matrix.sum(axis=1), 1.0)
        there = camera.transformed(matrix)
        np.testing.assert_allclose(there.reflectance, matrix @ camera.reflectance, rtol=1e-12)
        found = [
            half_space_reflectance(Medium(s + a, s / (s + a)))
            for s, a in zip(there.sigma_s_reduced, there.sigma_a, strict=True)
        ]
        np.testing.assert_allclose(found, there.reflectance, rtol=1e-9)
        back = there.transformed(np.asarray(np.linalg.inv(matrix), dtype=np.float64))
        np.testing.assert_allclose(back.sigma_s_reduced, camera.sigma_s_reduced, rtol=1e-9)
        np.testing.assert_allclose(back.sigma_a, camera.sigma_a, rtol=1e-9)


def test_equal_channels_stay_as_they_are_in_every_space() -> None:
    grey = ReducedMedium.of([ENAMEL[1]] * 3)
    for space in (LINEAR_SRGB, ACESCG):
        there = grey.transformed(matrix_between(np.array(XYZ_FROM_CAMERA), space))
        np.testing.assert_allclose(there.sigma_s_reduced, grey.sigma_s_reduced, rtol=1e-9)
        np.testing.assert_allclose(there.sigma_a, grey.sigma_a, rtol=1e-9)


def test_a_colour_outside_of_the_gamut_is_clipped_to_it() -> None:
    strong = ReducedMedium.of([Medium(1.0, 1.0), Medium(1.0, 0.5), Medium(1.0, 0.5)])
    there = strong.transformed(np.array([[2.0, -0.5, -0.5], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]))
    assert there.reflectance[0] == MAX_REFLECTANCE
    assert (there.sigma_a >= 0).all()


def test_acescg_is_reached_from_linear_srgb_by_the_published_matrix() -> None:
    # Academy's matrix from linear sRGB (BT.709) to AP1 by Bradford, as published with ACES 1.2 to ten digits; sRGB's
    # white of four digits leaves 1e-4.
    published = [
        [0.6130973, 0.3395229, 0.0473793],
        [0.0701942, 0.9163556, 0.0134526],
        [0.0206156, 0.1095698, 0.8698151],
    ]
    np.testing.assert_allclose(acescg_from_srgb(), published, atol=1e-4)


@pytest.mark.parametrize("media", [ENAMEL, DENTIN])
def test_a_spectrum_has_the_colour_and_the_extinction_of_its_channels(media: list[Medium]) -> None:
    camera = ReducedMedium.of(media)
    srgb = camera.transformed(matrix_between(np.array(XYZ_FROM_CAMERA), LINEAR_SRGB))
    nm, found = upsampled(srgb)
    np.testing.assert_allclose(srgb_of_spectrum(found.reflectance), srgb.reflectance, atol=1e-9)
    for primary, extinction in zip((611.4, 549.1, 464.2), srgb.extinction, strict=True):
        # 10 nm of the interpolated logarithm are 0.5 % at most.
        assert np.interp(primary, nm, found.extinction) == pytest.approx(extinction, rel=0.005)
    assert (found.sigma_a > 0).all()


def test_spectra_are_those_of_colour_science() -> None:
    colour = pytest.importorskip("colour", reason="colour-science is not installed", exc_type=ImportError)
    for rgb in ([0.81, 0.76, 0.71], [0.65, 0.3, 0.1], [0.2, 0.5, 0.7]):
        shape = colour.SpectralShape(400, 700, 10)
        theirs = colour.recovery.XYZ_to_sd_Jakob2019(
            LINEAR_SRGB.xyz_from_rgb() @ rgb,
            colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(shape),
            colour.SDS_ILLUMINANTS["D65"].copy().align(shape),
        )
        # Their optimiser stops at a colour difference below what is seen, which leaves a few parts in a thousand.
        np.testing.assert_allclose(smooth_spectrum(np.array(rgb)), theirs.values, atol=0.01)


@pytest.mark.parametrize("seed", range(4))
def test_any_colour_has_a_smooth_spectrum(seed: int) -> None:
    rgb = np.random.default_rng(seed).uniform(0.02, 0.98, 3)
    found = smooth_spectrum(rgb)
    np.testing.assert_allclose(srgb_of_spectrum(found), rgb, atol=1e-9)
    assert ((found >= 0) & (found <= 1)).all()
    assert (np.diff(np.sign(np.diff(found))) != 0).sum() <= 1


def test_white_under_d65_is_white() -> None:
    np.testing.assert_allclose(srgb_of_spectrum(np.ones((1, 31))), [[1.0, 1.0, 1.0]], rtol=1e-9)
    assert observer_under_d65().shape == (31, 5)


def slab_images(medium: dict[str, Any], light: Any) -> np.ndarray:
    """Mean linear sRGB that stock Mitsuba shows of a thick slab under a white sky."""
    import mitsuba as mi

    scene = {
        "type": "scene",
        "integrator": {"type": "volpathmis", "max_depth": 400, "rr_depth": 50},
        "slab": {
            "type": "cube", "to_world": mi.ScalarTransform4f().scale([40.0, 40.0, 10.0]), "bsdf": {"type": "null"},
            "interior": medium,
        },
        "sky": {"type": "constant", "radiance": light},
        "sensor": {
            "type": "perspective", "fov": 0.1, "film": {"type": "hdrfilm", "width": 4, "height": 4},
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 200], [0, 0, 0], [0, 1, 0]),
        },
    }  # fmt: skip
    return np.array(mi.render(mi.load_dict(scene), spp=2048), dtype=np.float64).mean(axis=(0, 1))


def spectrum(nm: np.ndarray, values: np.ndarray, scale: float = 1.0) -> dict[str, Any]:
    # Mitsuba takes a table as 0 beyond its ends, and samples 360 to 830 nm.
    pairs = [(360.0, values[0]), *zip(nm, values, strict=True), (830.0, values[-1])]
    return {"type": "spectrum", "value": [(float(a), float(b) / scale) for a, b in pairs]}


def test_stock_mitsuba_shows_a_spectral_medium_in_the_colour_of_its_channels() -> None:
    srgb = ReducedMedium.of(DENTIN).transformed(matrix_between(np.array(XYZ_FROM_CAMERA), LINEAR_SRGB))
    nm, found = upsampled(srgb)
    largest = float(srgb.extinction.max())
    one = {
        "type": "homogeneous", "scale": largest, "phase": {"type": "isotropic"},
        "sigma_t": {"type": "rgb", "value": (srgb.extinction / largest).tolist()},
        "albedo": {"type": "rgb", "value": (srgb.sigma_s_reduced / srgb.extinction).tolist()},
    }  # fmt: skip
    other = one | {
        "sigma_t": spectrum(nm, found.extinction, largest),
        "albedo": spectrum(nm, found.sigma_s_reduced / found.extinction),
    }
    with variant("llvm_ad_rgb"):
        in_rgb = slab_images(one, {"type": "rgb", "value": [1.0, 1.0, 1.0]})
    with variant("llvm_ad_spectral"):
        in_spectra = slab_images(other, {"type": "d65"})
    # Thirty thousand paths leave 0.3 %, and four standard errors of the difference are 1.7 %.
    np.testing.assert_allclose(in_spectra, in_rgb, rtol=0.017)
