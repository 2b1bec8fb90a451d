"""Highlights of a translucent tooth, whose own light is brightest and whitest around the mirror direction."""

from __future__ import annotations

import numpy as np
import pytest

from services.preprocess.masking.highlights import highlight_mask
from services.preprocess.masking.lobe import Distribution, FoundLobe
from services.preprocess.masking.shading import lobe_explains_light

SIZE = 81
NOISE = 0.01
LIGHT = (1.0, 1.0, 1.0)


@pytest.fixture(scope="module")
def tooth() -> dict[str, np.ndarray]:
    """A rounded front surface, lit and seen from the front, so that the half vector is +z everywhere.

    Light that has travelled far through a tooth leaves it away from the light, weaker and more yellow. A smooth
    fall-off from the half vector stands for that, which no quadratic in the normal is, with patches of 10 %.
    """
    x, y = np.meshgrid(np.linspace(-1, 1, SIZE), np.linspace(-1, 1, SIZE))
    inside = x**2 + y**2 < 0.95
    z = np.sqrt(np.maximum(1 - 0.9 * (x**2 + y**2), 0.05))
    normal = np.stack([0.9 * x, 0.9 * y, z], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    cosine = normal[..., 2]
    level = np.exp(2 * (cosine - 1)) * (1 + 0.1 * np.cos(3 * x + 1) * np.cos(4 * y))
    yellow = 0.02 + 0.2 * (1 - cosine)
    radiance = level[..., None] * np.stack([1 + yellow, np.ones_like(yellow), 1 - 2 * yellow], axis=-1)
    return {"inside": inside, "normal": normal, "cosine": cosine, "radiance": radiance}


def ggx(cosine: np.ndarray, roughness: float) -> np.ndarray:
    """Distribution of microfacets by Walter et al. 2007, 1 at the mirror direction."""
    return (roughness**2 / (cosine**2 * (roughness**2 - 1) + 1)) ** 2


def mask_of(tooth: dict[str, np.ndarray], radiance: np.ndarray) -> np.ndarray:
    random = np.random.default_rng(1)
    return highlight_mask(
        (radiance * (1 + NOISE * random.standard_normal(radiance.shape))).astype(np.float32),
        ((NOISE * radiance) ** 2).astype(np.float32),
        tooth["inside"],
        np.zeros_like(tooth["inside"]),
        np.where(tooth["inside"], tooth["cosine"], -1).astype(np.float32),
        tooth["normal"].astype(np.float32),
        LIGHT,
    )


def test_a_translucent_tooth_without_a_reflection_is_not_masked(tooth: dict[str, np.ndarray]) -> None:
    """0.44 of the tooth was masked when its colour was taken as even to 5 %. A percent is allowed."""
    assert mask_of(tooth, tooth["radiance"]).sum() < 0.01 * tooth["inside"].sum()


@pytest.mark.parametrize("roughness", [0.1, 0.2])
def test_its_reflection_is_masked(tooth: dict[str, np.ndarray], roughness: float) -> None:
    """At least 90 % of the reflected light, as is asked of renders."""
    reflected = 0.8 * ggx(tooth["cosine"], roughness)
    masked = mask_of(tooth, tooth["radiance"] + reflected[..., None])
    assert reflected[masked].sum() > 0.9 * reflected[tooth["inside"]].sum()


@pytest.mark.parametrize(
    ("roughness", "amplitude", "expected"), [(0.3, 0.3, True), (0.1, 0.3, True), (0.3, 0.0, False)]
)
def test_a_lobe_must_explain_light_that_shading_does_not(
    tooth: dict[str, np.ndarray], roughness: float, amplitude: float, expected: bool
) -> None:
    """A lobe three times stronger than the patches does, a broad one too; the fall-off alone needs none."""
    brightness = tooth["radiance"][..., 1] + amplitude * ggx(tooth["cosine"], roughness)
    given = (one.astype(np.float32) for one in (tooth["normal"], tooth["cosine"]))
    lobe = FoundLobe(Distribution(roughness, False), np.radians(30))
    found = lobe_explains_light(lobe, brightness.astype(np.float32), tooth["inside"], *given)
    assert found is expected
