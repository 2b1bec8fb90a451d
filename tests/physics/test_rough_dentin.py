"""A fit with a rough surface finds the dentin's shape, by differences of images and not by the gradient to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from services.anatomy.dentin_shape import DentinShape
from services.core.geometry import Mesh
from services.transport.engine import Engine
from services.transport.optics.parameters import Medium, Tissue
from tests.support.small_tooth import camera_at, dentin_shape, recipe, whole_view

ENAMEL, DENTIN = Medium(3.0, 0.99, g1=0.5), Medium(6.0, 0.9, g1=0.5)
SAMPLES = 1024


def test_a_scene_whose_dentin_has_moved_is_that_of_the_moved_dentin() -> None:
    scene, view = replace(recipe("rough"), roughness=0.3), whole_view(camera_at((0.1, 1, 0.1)))
    shape = dentin_shape()
    engine = Engine(scene)
    images = {
        weight: engine.images(Tissue(ENAMEL, DENTIN, (weight, 0.5)), view, samples=SAMPLES, seed=1)
        for weight in (0.0, 1.0)
    }
    (tooth,) = scene.teeth
    moved = DentinShape.known(Mesh(shape.vertices_mm((1.0, 0.5)), shape.base.faces))
    fixed = Engine(replace(scene, teeth=(replace(tooth, dentin=moved),)))
    expected = fixed.images(Tissue(ENAMEL, DENTIN), view, samples=SAMPLES, seed=2)
    totals = {name: one.mean.sum(axis=1) for name, one in (("near", images[0.0]), ("far", images[1.0]))}
    errors = [np.sqrt(one.variance.sum(axis=1)) for one in (images[1.0], expected)]
    z = (totals["far"] - expected.mean.sum(axis=1)) / np.hypot(*errors)
    # Five lights: |z| <= 4.5 fails one correct run in 30,000.
    assert np.abs(z).max() < 4.5
    # Dark dentin farther below the surface leaves more light, and the lights in front show it.
    assert totals["far"][0] > 1.2 * totals["near"][0]
