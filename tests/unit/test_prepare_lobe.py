"""How far reflections reach from the mirror direction, found from known profiles."""

from __future__ import annotations

import numpy as np
import pytest

from services.preprocess.masking.lobe import PROFILE_DEG, LobeProfile

PIXELS = 40_000
NOISE = 0.01
WIDEST_DEG = 40.0


def half_angle_deg(
    reflected_of: np.ndarray, brightness: np.ndarray, angle_deg: np.ndarray, tolerated: float = 0.02
) -> float:
    random = np.random.default_rng(3)
    profile = LobeProfile()
    profile.add(
        np.cos(np.radians(angle_deg)).astype(np.float32),
        brightness.astype(np.float32),
        (reflected_of + NOISE * random.standard_normal(len(angle_deg))).astype(np.float32),
        np.full(len(angle_deg), 1 / NOISE**2, dtype=np.float32),
    )
    return 0.0 if (lobe := profile.lobe(tolerated, WIDEST_DEG)) is None else float(np.degrees(lobe.half_angle))


def ggx(angle_deg: np.ndarray, roughness: float) -> np.ndarray:
    """Distribution of microfacets by Walter et al. 2007, 1 at the mirror direction."""
    tangent = np.tan(np.radians(angle_deg)) ** 2
    return 1 / (np.cos(np.radians(angle_deg)) ** 4 * (1 + tangent / roughness**2) ** 2)


def angles() -> np.ndarray:
    """Angles of normals that are spread evenly over the sphere."""
    low = np.cos(np.radians(PROFILE_DEG - 0.01))
    return np.degrees(np.arccos(np.random.default_rng(1).uniform(low, 1, PIXELS)))


@pytest.mark.parametrize("roughness", [0.1, 0.15, 0.2])
@pytest.mark.parametrize("learned_from", [0.0, 0.02])
def test_half_angle_is_where_the_lobe_falls_below_what_is_tolerated(roughness: float, learned_from: float) -> None:
    """Exact to one degree of the profile and half a step of the roughness, 5.5 % of the angle: ± 2 degrees at 13 to 28,
    also where the diffuse colour was learned from pixels that reflect a fiftieth of their light."""
    angle = angles()
    lobe = 0.8 * ggx(angle, roughness)
    fine = np.arange(0, 90, 0.01)
    expected = fine[np.argmax(0.8 * ggx(fine, roughness) < 0.02)]
    assert 12 < expected < WIDEST_DEG
    estimate = (1 + learned_from) * lobe - learned_from * (1 + lobe)
    assert half_angle_deg(estimate, 1 + lobe, angle) == pytest.approx(expected, abs=2)


def test_a_broad_lobe_is_cut_at_the_widest() -> None:
    angle = angles()
    lobe = 1.2 * ggx(angle, 0.3)
    assert half_angle_deg(lobe, 1 + lobe, angle) == WIDEST_DEG


@pytest.mark.parametrize("wrong_shading", [0.0, 0.05, -0.1])
def test_errors_of_the_shading_are_no_lobe(wrong_shading: float) -> None:
    """The light is flat. At the mirror direction a quadratic fit is wrong by less than a reflection adds, and by far
    more where the surface turns away.
    """
    angle = angles()
    error = wrong_shading * np.cos(np.radians(3 * angle)) + np.maximum(angle - 42, 0) * 0.1
    assert half_angle_deg(error, np.ones(PIXELS), angle) == 0


def test_too_few_angles_tell_nothing() -> None:
    angle = np.full(PIXELS, 4.0)
    assert half_angle_deg(np.ones(PIXELS), np.full(PIXELS, 2.0), angle) == 0


def test_pixels_without_an_estimate_tell_nothing() -> None:
    """A few dim pixels of a tooth at the end of a jaw, for which neither colour nor shading was learned."""
    profile, angle = LobeProfile(), angles().astype(np.float32)
    none = np.zeros_like(angle)
    profile.add(np.cos(np.radians(angle)), none + np.float32(1e-10), none, none)
    assert profile.lobe(0.02, WIDEST_DEG) is None


def test_light_far_from_the_mirror_direction_tells_nothing() -> None:
    """Beyond 30 degrees, the narrow distributions are zero in every digit."""
    angle = angles()
    angle = angle[angle > 30]
    assert half_angle_deg(np.zeros(len(angle)), np.ones(len(angle)), angle) == 0
