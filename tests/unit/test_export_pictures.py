"""Tone curve, colour maps and the bytes of PNG files."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from services.core.pages.pictures import (
    DIVERGING,
    MASKED,
    Picture,
    colour_map,
    enlarge,
    png_bytes,
    scalar_map,
    signed_map,
    tone_map,
    white_level,
)


def luminance(rgb: tuple[int, int, int] | np.ndarray) -> float:
    linear = np.where(
        np.asarray(rgb) / 255 <= 0.04045,
        np.asarray(rgb) / 255 / 12.92,
        ((np.asarray(rgb) / 255 + 0.055) / 1.055) ** 2.4,
    )
    return float(linear @ [0.2126, 0.7152, 0.0722])


def test_tone_curve_is_srgb() -> None:
    # IEC 61966-2-1: half of white is 188, a thousandth lies on the linear part, above white clips.
    picture = tone_map(np.array([[0.0, 0.0005, 0.5, 1.0, 7.0, np.nan]]), white=1.0)
    assert picture[0, :, 0].tolist() == [0, 2, 188, 255, 255, 0]
    assert picture.shape == (1, 6, 3)


def test_three_channels_stay_apart_and_two_are_padded() -> None:
    assert tone_map(np.full((2, 2, 3), [1.0, 0.5, 0.0]), 1.0)[0, 0].tolist() == [255, 188, 0]
    assert tone_map(np.full((2, 2, 2), 1.0), 1.0)[0, 0].tolist() == [255, 255, 0]


def test_white_ignores_masked_and_broken_pixels() -> None:
    radiance = np.full((10, 10), 0.2)
    radiance[0, 0], radiance[1, 1] = 1e6, np.nan
    valid = np.ones((10, 10), dtype=bool)
    valid[0, 0] = False
    assert white_level(radiance, valid) == pytest.approx(0.2)
    assert white_level(radiance, np.zeros_like(valid)) == 1.0


def test_residual_colours_have_a_sign_and_a_neutral_zero() -> None:
    residual = np.array([[-1.0, -0.5, 0.0, 0.5, 1.0, 9.0]])
    picture = signed_map(residual, 1.0, np.array([[True, True, True, True, True, False]]))
    assert picture[0, 2].tolist() == [247, 247, 247]
    assert picture[0, 0, 2] > picture[0, 0, 0]
    assert picture[0, 4, 0] > picture[0, 4, 2]
    assert tuple(picture[0, 5]) == MASKED
    # Both arms get darker away from zero, so that magnitudes can be read without colour.
    steps = [luminance(colour) for colour in colour_map(np.linspace(0, 1, 9), DIVERGING)]
    assert steps[:5] == sorted(steps[:5])
    assert steps[4:] == sorted(steps[4:], reverse=True)


def test_both_arms_differ_for_missing_cones() -> None:
    # Red-blind and green-blind observers confuse colours that differ only in red minus green, so the arms differ in
    # blue minus yellow.
    ends = colour_map(np.array([0.1, 0.9]), DIVERGING).astype(float)
    yellowness = ends[:, :2].mean(axis=1) - ends[:, 2]
    assert yellowness[1] - yellowness[0] > 150


def test_scalar_map_greys_out_what_is_unknown() -> None:
    picture = scalar_map(np.array([[0.0, 1.0, np.nan]]), (0.0, 1.0))
    assert picture[0].tolist() == [[68, 1, 84], [253, 231, 37], list(MASKED)]


def test_png_round_trip_and_enlarging_by_whole_pixels() -> None:
    image = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    large = enlarge(image, 20)
    assert large.shape == (15, 21, 3)
    assert np.array_equal(large[::3, ::3], image)
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(png_bytes(large)))), large)


def test_residual_is_render_minus_photo_on_valid_pixels() -> None:
    picture = Picture("c0", "l0", False, np.full((1, 2, 1), 0.5), np.full((1, 2, 1), 0.75), np.array([[True, False]]))
    assert picture.residual[..., 0].tolist() == [[0.25, 0.0]]
