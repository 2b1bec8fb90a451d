"""A tooth with gums and neighbours that have its media renders as a mouth in which every tooth has those media, path by
path, and its derivatives are the sums over the teeth.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from services.core.errors import InputError
from services.core.records import Boundary
from services.fit.coordinates.domain import similar_tissue
from services.transport.engine import Engine
from services.transport.optics.parameters import MEDIUM_FIELDS, Mouth
from services.transport.scene.names import parameter_names
from services.transport.scene.recipe import SceneRecipe
from services.transport.scene.recipe_files import read_recipe, write_recipe
from tests.support.small_mouth import MOUTH, mouth_recipe
from tests.support.small_tooth import camera_at, whole_view

TISSUE = replace(MOUTH.teeth[0], gums=MOUTH.gums)
ALIKE = Mouth((MOUTH.teeth[0], MOUTH.teeth[0]), MOUTH.gums)
VIEW = whole_view(camera_at((0.1, 1, 0.2), size=10, span_mm=9.0))
ROUNDING = 1e-4
"""Largest relative difference of sums over a few hundred thousand paths in single precision, whose order is free."""


def mouth(boundary: Boundary) -> SceneRecipe:
    return replace(mouth_recipe(boundary), cavity=None)


def tooth_with_neighbour(boundary: Boundary) -> SceneRecipe:
    own, other = mouth(boundary).teeth
    return replace(mouth(boundary), teeth=(own,), neighbours=(other,))


@pytest.mark.parametrize("boundary", ["matched", "thin"])
def test_images_and_derivatives_are_those_of_a_mouth_of_equal_teeth(boundary: Boundary) -> None:
    names = tuple(f"{part}.{field}" for part in ("enamel", "dentin", "gums") for field in ("sigma", "alpha"))
    alone = Engine(tooth_with_neighbour(boundary)).jacobian(TISSUE, VIEW, names, seed=3, samples=64)
    of_each = tuple(
        name
        for own in names
        for name in ((own,) if own.startswith("gums") else (f"0.{own}", f"1.{own}"))
        if name not in {"1.dentin.sigma", "1.dentin.alpha"}  # the neighbour has no dentin
    )
    together = Engine(mouth(boundary)).jacobian(ALIKE, VIEW, of_each, seed=3, samples=64)
    np.testing.assert_allclose(alone.mean, together.mean, rtol=0, atol=ROUNDING * together.mean.max())
    for name, slope in zip(names, alone.jacobian, strict=True):
        parts = [one for own, one in zip(of_each, together.jacobian, strict=True) if own.endswith(name)]
        np.testing.assert_allclose(slope, sum(parts), rtol=0, atol=ROUNDING * np.abs(slope).max(), err_msg=name)
    # The neighbour and the gums matter: without them the images differ by far more than rounding.
    own = Engine(replace(mouth(boundary), teeth=mouth(boundary).teeth[:1], gums=None))
    bare = own.images(MOUTH.teeth[0], VIEW, seed=3, samples=64)
    assert np.abs(bare.mean - alone.mean).max() > 0.1 * alone.mean.max()


def test_the_names_are_those_of_a_single_tooth_and_its_gums() -> None:
    expected = {f"{part}.{field}" for part in ("enamel", "dentin", "gums") for field in MEDIUM_FIELDS}
    assert set(parameter_names(tooth_with_neighbour("thin"))) == expected
    changed = TISSUE.with_values({"gums.alpha": 0.7, "enamel.sigma": 3.0})
    assert (changed.value("gums.alpha"), changed.value("enamel.sigma")) == (0.7, 3.0)
    assert (changed.dentin, changed.shape) == (TISSUE.dentin, TISSUE.shape)
    similar = similar_tissue(TISSUE, 0.0)
    assert similar.gums is not None
    assert MOUTH.gums is not None
    assert similar.gums.sigma_s_reduced == pytest.approx(MOUTH.gums.sigma_s_reduced)


def test_a_stored_recipe_keeps_the_neighbours(tmp_path: Path) -> None:
    again = read_recipe(write_recipe(tmp_path, tooth_with_neighbour("thin")))
    assert (len(again.teeth), len(again.neighbours)) == (1, 1)
    np.testing.assert_array_equal(again.vertices_mm(), tooth_with_neighbour("thin").vertices_mm())


def test_neighbours_of_several_teeth_are_refused() -> None:
    recipe = mouth("thin")
    with pytest.raises(InputError, match="neighbours of 2 teeth"):
        Engine(replace(recipe, neighbours=recipe.teeth[1:]))


def test_gums_without_a_medium_are_refused() -> None:
    with pytest.raises(InputError, match="gums"):
        Engine(tooth_with_neighbour("thin")).images(MOUTH.teeth[0], VIEW, seed=1, samples=16)
