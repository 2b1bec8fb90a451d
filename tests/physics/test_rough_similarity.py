"""Media of equal reduced scattering show a rough object nearly as its own do, so that a fit may begin in them."""

from __future__ import annotations

from dataclasses import replace

import pytest

from services.core.records import Boundary
from services.fit.coordinates.domain import similar_tissue
from services.fit.stages.tooth.schedule import SIMILAR_G
from services.transport.engine import Engine
from services.transport.optics.parameters import Medium, Tissue
from tests.support.rough_truths import scene_recipe, view

FORWARD = Tissue(Medium(6.0, 0.995, g1=0.8), Medium(6.0, 0.995, g1=0.8))
"""Media that scatter forward, as enamel does: those for which similar media err most."""
SAMPLES = 8192


def squared_error(boundary: Boundary) -> float:
    """Squared difference of the images in similar media, relative to those in their own, without the renders' noise."""
    engine = Engine(replace(scene_recipe(0.3, 1.63), boundary=boundary, multiple_scattering=True))
    own = engine.images(FORWARD, view(), samples=SAMPLES, seed=1)
    similar = engine.images(similar_tissue(FORWARD, SIMILAR_G), view(), samples=SAMPLES, seed=2)
    noise = (own.variance + similar.variance).sum()
    return float((((similar.mean - own.mean) ** 2).sum() - noise) / (own.mean**2).sum())


@pytest.mark.dear("Noise of a rough surface needs many paths.")
def test_similar_media_err_less_behind_a_rough_surface_than_behind_a_thin_one() -> None:
    # 0.024 and 0.155 with four times the paths; with these, one standard error is 0.003 by the spread of five seeds.
    assert squared_error("rough") < 0.5 * squared_error("thin")
