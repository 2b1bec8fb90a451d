"""How a stage's images are differentiated: which columns are scores and which are differences, over what reach, and
with what share of the paths.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from services.core.files.content_files import StoredFile
from services.core.geometry import Camera
from services.fit.coordinates.domain import Coordinate, Domain, natural_derivative, to_dual
from services.fit.measurements.blocks import BlockTask, PixelParts
from services.fit.passes.derivatives import DIFFERENCE_STEPS, SCORES_DIVISOR, Differentiation
from services.fit.passes.neighbours import Neighbours
from services.fit.passes.passes import StackProblem
from services.transport.optics.parameters import Medium, Mouth, Tissue
from services.transport.scene.recipe import View

TISSUE = Tissue(Medium(5.0, 0.997, g1=0.72), Medium(14.0, 0.995, g1=0.8))
DOMAIN = Domain(
    tuple(
        Coordinate((name,))
        for name in ("enamel.sigma", "enamel.alpha", "dentin.sigma", "dentin.alpha", "enamel.cosine")
    )
)
NOWHERE = StoredFile(Path("nowhere"), "")
POSE = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
CAMERA = Camera(name="c", size=(1, 1), K=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), camera_from_world=POSE)
VIEW = View(CAMERA, np.zeros((1, 2), dtype=np.int32))


def problem(
    base: Tissue | Mouth = TISSUE, domain: Domain = DOMAIN, jacobian_g: float | None = 0.0
) -> StackProblem[Any]:
    return StackProblem(SimpleNamespace(), domain, base, "exact", jacobian_g=jacobian_g)  # type: ignore[arg-type]


def linear_value(tissue: Tissue) -> float:
    logs = np.log(tissue.enamel.sigma_s_reduced) + 2 * np.log(tissue.dentin.sigma_s_reduced)
    return float(logs + 3 * tissue.enamel.mean_cosine - 5 * (1 - tissue.enamel.alpha) * tissue.enamel.sigma)


@dataclass
class Linear:
    """An engine whose one image is linear in the logarithm of both reduced scatterings, in absorption and in the
    enamel's mean cosine.
    """

    asked: list[tuple[str, int]] = field(default_factory=list)

    def call(
        self,
        method: str,
        recipe: StoredFile,  # noqa: ARG002
        tissue: Tissue,
        view: View,  # noqa: ARG002
        names: tuple[str, ...] = (),
        *,
        samples: int,
        seed: int,  # noqa: ARG002
        batches: int,  # noqa: ARG002
    ) -> Any:
        self.asked.append((method, samples))
        if method == "images":
            return SimpleNamespace(mean=np.array([[linear_value(tissue)]]))
        step, rows = 1e-6, []
        for name in names:
            high, low = (linear_value(tissue.with_values({name: tissue.value(name) + sign * step})) for sign in (1, -1))
            rows.append((high - low) / (2 * step))
        return SimpleNamespace(jacobian=np.array(rows))

    def close(self) -> None:
        pass


def rendered(how: Differentiation, tissue: Tissue, engine: Linear, samples: int = 1024) -> np.ndarray:
    return how.render(engine, BlockTask(NOWHERE, 0, NOWHERE, "step", tissue, samples), VIEW, seeds=(1,))[0][:, 0]


def slope(x: np.ndarray, k: int) -> float:
    shift = 1e-6 * np.eye(len(x))[k]
    high, low = (linear_value(DOMAIN.tissue_at(x + sign * shift, TISSUE)) for sign in (1, -1))
    return (high - low) / 2e-6


def test_a_wide_difference_is_the_derivative_where_images_are_linear() -> None:
    # In ln sigma at constant albedo absorption is exponential, so a difference over +-0.7 overstates its small part, 5
    # sigma_a, by sinh(0.7) / 0.7 = 1.084.
    engine, x = Linear(), DOMAIN.x_of(TISSUE)
    _, similar, how = problem().jacobian_media(x)
    found, true = rendered(how, similar, engine), [slope(x, k) for k in range(len(x))]
    absorbed = -5 * (1 - TISSUE.enamel.alpha) * TISSUE.enamel.sigma
    assert found[0] == pytest.approx(true[0] + absorbed * (np.sinh(0.7) / 0.7 - 1), rel=1e-3)
    np.testing.assert_allclose(found[1:4], true[1:4], rtol=1e-3, atol=1e-6)
    # tanh bends by 40 % over the reach of a cosine, yet its column is the derivative.
    assert found[4] == pytest.approx(true[4], rel=1e-9)
    wide = (np.tanh(x[4]) - np.tanh(x[4] - DIFFERENCE_STEPS["cosine"].below)) / DIFFERENCE_STEPS["cosine"].below
    assert abs(wide / natural_derivative("cosine", float(x[4])) - 1) > 0.3


def test_every_column_gets_its_share_of_the_paths_and_a_common_image_is_rendered_once() -> None:
    engine, x = Linear(), DOMAIN.x_of(TISSUE)
    domain = Domain((*DOMAIN.coordinates, Coordinate(("dentin.cosine",))))
    _, similar, how = problem(domain=domain).jacobian_media(domain.x_of(TISSUE))
    rendered(how, similar, engine)
    counted = {one: engine.asked.count(one) for one in engine.asked}
    # Two ends for each sigma; for two cosines one end each and the image itself.
    assert counted == {
        ("images", 1024 // DIFFERENCE_STEPS["sigma"].path_divisor): 4,
        ("images", 1024 // DIFFERENCE_STEPS["cosine"].path_divisor): 3,
        ("jacobian", 1024 // SCORES_DIVISOR): 1,
    }
    assert how.parameters == ("enamel.sigma", "enamel.alpha", "dentin.sigma", "dentin.alpha")
    assert len(x) == 5


def test_in_exact_media_extinction_has_scores() -> None:
    domain = Domain(tuple(Coordinate((name,)) for name in ("enamel.sigma", "enamel.alpha")))
    how = problem(TISSUE, domain, None).jacobian_media(domain.x_of(TISSUE))[2]
    assert (how.secants, how.path_divisor) == ((), 1)


@dataclass
class Teeth:
    """A jaw's engine: a pixel for each tooth, brightened a little by both neighbours."""

    asked: list[tuple[str, int]] = field(default_factory=list)

    def call(
        self,
        method: str,
        recipe: StoredFile,  # noqa: ARG002
        tissue: Mouth,
        view: View,  # noqa: ARG002
        names: tuple[str, ...] = (),
        *,
        samples: int,
        seed: int,  # noqa: ARG002
        batches: int,  # noqa: ARG002
    ) -> Any:
        self.asked.append((method, samples))
        if method != "images":
            return SimpleNamespace(jacobian=np.zeros((len(names), 1, len(tissue.teeth))))
        own = np.array([linear_value(tooth) for tooth in tissue.teeth])
        return SimpleNamespace(mean=(own + 0.1 * np.append(own[1:], 0) + 0.1 * np.append(0, own[:-1]))[None])

    def close(self) -> None:
        pass


def test_teeth_that_stand_apart_are_moved_at_once_and_told_apart() -> None:
    fdi = (12, 11, 21, 22, 23)
    engine, mouth = Teeth(), Mouth(tuple(TISSUE.with_values({"enamel.sigma": 4.0 + k}) for k in range(len(fdi))))
    names = [f"{k}.{leaf}" for k in range(len(fdi)) for leaf in ("dentin.cosine", "enamel.cosine")]
    domain, neighbours = Domain(tuple(Coordinate((name,)) for name in names)), Neighbours.of(fdi)
    x = domain.x_of(mouth)
    _, similar, how = replace(problem(mouth, domain), neighbours=neighbours).jacobian_media(x)
    places = np.arange(len(fdi), dtype=np.int16)
    task = BlockTask(NOWHERE, 0, NOWHERE, "step", similar, 1024)
    (rows,) = how.render(engine, task, VIEW, seeds=(1,), parts=PixelParts(places, places))

    # Three colours of two cosines, one end each, and the image itself; changes beyond the neighbours are not counted.
    assert engine.asked == [("images", 1024 // DIFFERENCE_STEPS["cosine"].path_divisor)] * 7
    beside = np.abs(places[:, None] - places) <= 1
    slope = 3 * natural_derivative("cosine", float(x[1]))
    np.testing.assert_allclose(
        rows[1::2], slope * np.where(places[:, None] == places, 1.0, np.where(beside, 0.1, 0.0)), rtol=1e-9, atol=1e-9
    )
    assert not rows[::2].any()


def test_a_secant_keeps_inside_the_bounds() -> None:
    low, _ = (bound[4] for bound in DOMAIN.bounds)
    x = DOMAIN.x_of(TISSUE)
    x[4] = low
    (secant,) = (one for one in problem().jacobian_media(x)[2].secants if one.coordinates == (4,))
    assert isinstance(secant.low, Tissue)
    assert isinstance(secant.high, Tissue)
    ends = [to_dual("cosine", medium.enamel.mean_cosine) for medium in (secant.low, secant.high)]
    np.testing.assert_allclose(ends, [low, low + 0.5], atol=1e-9)
    assert secant.widths[0] > 0


def test_the_closing_measurement_takes_slopes_of_the_images_own_media() -> None:
    engine, x = Linear(), DOMAIN.x_of(TISSUE)
    slopes = problem().exact_differentiation(x)
    assert slopes.parameters == ("enamel.sigma", "enamel.alpha", "dentin.sigma", "dentin.alpha")
    np.testing.assert_allclose(rendered(slopes, TISSUE, engine), [slope(x, k) for k in range(5)], rtol=1e-4, atol=1e-6)
