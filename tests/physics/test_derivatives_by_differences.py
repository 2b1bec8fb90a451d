"""Every derivative compared to central differences with common random numbers, on a small tooth.

Each is compared on a scalar with a strong signal: the image projected on the derivative's own image from another seed.
The differences' bias grows as the square of the step, so Richardson extrapolation (4 fd(h/2) - fd(h)) / 3 of two steps
leaves an error of fourth order. The wider step enters with a quarter of the other's weight and has less noise, so a
quarter of the paths is enough for it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from services.core.records import Boundary
from services.transport.engine import Engine
from services.transport.optics.parameters import Medium, Mouth, Tissue
from services.transport.scene.recipe import SceneRecipe
from tests.support.one_sided_border import leave_out_scattering
from tests.support.small_mouth import MOUTH, mouth_recipe
from tests.support.small_tooth import camera_at, recipe, whole_view

SEEDS = 8
LARGEST_ERROR = 0.05
"""Largest standard error of the score and of the extrapolated difference, as a fraction of the derivative."""
FAMILY_FALSE_ALARM = 1e-3
"""Chance that any t-test of a group fails a correct engine (Bonferroni)."""
STEPS = {
    "sigma": 0.3,
    "alpha": 0.04,
    "beta": 0.2,
    "g1": 0.12,
    "g2": 0.2,
    "shape": 0.3,
    "reflectance": 0.2,
    "gums.sigma": 1.0,
    "1.enamel.sigma": 0.7,
}


@dataclass(frozen=True)
class Group:
    """Derivatives tested at one tissue, with the paths per pixel, seed and image that a standard error of 5 % needs."""

    tissue: Tissue | Mouth
    samples: dict[str, int]
    score_samples: int
    scene: Callable[[Boundary], SceneRecipe] = recipe
    span_mm: float = 9.0


MEDIA = Group(
    Tissue(Medium(1, 0.95, 0.6, 0.6, -0.3), Medium(2, 0.8, 0.5, 0.6, -0.3), (0.5, 0.4)),
    {
        f"{part}.{field}": 1536 if part == "enamel" else 3072
        for part in ("enamel", "dentin")
        for field in ("sigma", "g1", "g2")
    }
    | {f"{part}.{field}": 1024 for part in ("enamel", "dentin") for field in ("alpha", "beta")}
    | {"shape.0": 1024},
    2048,
)
SHAPE = Group(
    Tissue(Medium(2, 0.8, 0.8, 0.6, -0.3), Medium(0.5, 0.9, 0.7, 0.6, -0.3), (0.5, 0.4)),
    {"shape.0": 1024, "shape.1": 2048},
    4096,
)
"""Group with dentin clearer than enamel: for both modes, Eq. 32 alone gives 2.5 times the derivative, with little
noise."""
IN_A_MOUTH = Group(
    MOUTH,
    {
        "0.dentin.alpha": 384,
        "1.enamel.alpha": 128,
        "1.enamel.sigma": 5120,
        "gums.alpha": 128,
        "gums.sigma": 2048,
        "cavity.reflectance": 64,
    },
    3072,
    mouth_recipe,
    14.0,
)


def compare(group: Group, boundary: Boundary) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Scores and extrapolated central differences (S,) over seeds by name, both relative to the mean score."""
    engine, view, names = (
        Engine(group.scene(boundary)),
        whole_view(camera_at((0.2, 1, 0.1), span_mm=group.span_mm), 1),
        tuple(group.samples),
    )
    pictures = engine.jacobian(group.tissue, view, names, samples=4 * group.score_samples, seed=10_000).jacobian
    slopes = [
        engine.jacobian(group.tissue, view, names, samples=group.score_samples, seed=11_000 + seed).jacobian
        for seed in range(SEEDS)
    ]
    compared = {}
    for name, picture, slope in zip(names, pictures, np.stack(slopes, axis=1), strict=True):
        scores = np.einsum("sln,ln->s", slope, picture)
        middle, step = group.tissue.value(name), STEPS.get(name, STEPS.get(name.split(".")[-1], STEPS["shape"]))

        def value(
            parameter: float, samples: int, seed: int, name: str = name, picture: NDArray[np.float64] = picture
        ) -> float:
            tissue = group.tissue.with_values({name: parameter})
            return float((engine.images(tissue, view, samples=samples, seed=12_000 + seed).mean * picture).sum())

        # Render all seeds at one value before the next value, because a new value may need new surfaces.
        up, down = (
            {
                h: np.array([value(middle + sign * h, samples, seed) for seed in range(SEEDS)])
                for h, samples in ((step, group.samples[name] // 4), (step / 2, group.samples[name]))
            }
            for sign in (1, -1)
        )
        differences = [(up[h] - down[h]) / (2 * h) for h in (step, step / 2)]
        extrapolated = (4 * differences[1] - differences[0]) / 3
        compared[name] = scores / scores.mean(), extrapolated / scores.mean()
    return compared


def standard_error(values: NDArray[np.float64]) -> float:
    return float(values.std(ddof=1) / np.sqrt(len(values)))


@pytest.mark.dear("Differences of images need many paths.")
@pytest.mark.parametrize(
    ("group", "boundary"),
    [
        pytest.param(MEDIA, "matched", id="media-matched", marks=pytest.mark.slow),
        pytest.param(
            replace(MEDIA, samples={"enamel.g1": 256, "dentin.alpha": 64}, score_samples=256),
            "matched",
            id="two-media-matched",
        ),
        pytest.param(
            replace(SHAPE, samples={"shape.0": 128, "shape.1": 1024}, score_samples=1024), "matched", id="shape-matched"
        ),
        pytest.param(MEDIA, "thin", id="media-thin", marks=pytest.mark.slow),
        pytest.param(SHAPE, "thin", id="shape-thin", marks=pytest.mark.slow),
        pytest.param(
            replace(
                IN_A_MOUTH,
                samples={"0.dentin.alpha": 256, "gums.alpha": 128, "cavity.reflectance": 32},
                score_samples=256,
            ),
            "thin",
            id="albedos-in-a-mouth-thin",
        ),
        pytest.param(IN_A_MOUTH, "thin", id="mouth-thin", marks=pytest.mark.slow),
    ],
)
def test_scores_are_the_images_derivatives(group: Group, boundary: Boundary) -> None:
    compared = compare(group, boundary)
    limit = stats.t.isf(FAMILY_FALSE_ALARM / (2 * len(compared)), SEEDS - 1)
    for name, (scores, differences) in compared.items():
        assert standard_error(scores) <= LARGEST_ERROR, name
        assert standard_error(differences) <= LARGEST_ERROR, name
        # Seeds are unrelated, so their pairing is arbitrary: a paired t-test with seven degrees of freedom.
        gap = scores - differences
        assert abs(gap.mean()) <= limit * standard_error(gap), name


def test_equation_32_alone_is_no_derivative(monkeypatch: pytest.MonkeyPatch) -> None:
    leave_out_scattering(monkeypatch)
    fewer = replace(SHAPE, samples={"shape.0": 128, "shape.1": 512}, score_samples=512)
    for name, (scores, differences) in compare(fewer, "matched").items():
        assert standard_error(scores) <= LARGEST_ERROR, name
        assert abs((scores - differences).mean()) > 10 * standard_error(scores - differences), name


def test_what_a_second_lobe_would_bring_is_told_where_there_is_none() -> None:
    engine, view = Engine(recipe()), whole_view(camera_at((0.2, 1, 0.1)), 2)
    none, hardly = (
        engine.jacobian(
            Tissue(Medium(2, 0.95, beta, 0.6, -0.3), Medium(3, 0.8, beta, 0.6, -0.3), (0.5, 0.5)),
            view,
            ("enamel.beta",),
            samples=64,
            seed=1,
        ).jacobian
        for beta in (1.0, 1 - 1e-6)
    )
    # Only one path in some thousands samples the other lobe.
    assert np.linalg.norm(none - hardly) < 0.02 * np.linalg.norm(hardly)
