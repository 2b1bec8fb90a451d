"""The final uncertainty estimate's images of displaced dentin are those of the displaced surface itself."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from services.anatomy.dentin_shape import DentinShape
from services.core.geometry import Mesh
from services.fit.measurements.blocks import BlockTask, PixelBlock, write_block
from services.fit.passes.final_uncertainty import DisplacedScene, displacements_task
from services.tasks.engine_host import InProcessHost
from services.transport.engine import Engine
from services.transport.optics.parameters import Medium, Tissue
from services.transport.scene.recipe import ToothSurfaces
from services.transport.scene.recipe_files import write_recipe
from tests.support.small_tooth import camera_at, dentin_shape, recipe, whole_view

WEIGHTS = (0.4, 0.2)
TISSUE = Tissue(Medium(4.0, 0.99, g1=0.8), Medium(9.0, 0.99, g1=0.8), WEIGHTS)
SAMPLES, SEEDS = 64, (3, 4)
ROUNDING = 1e-4
"""Largest relative difference of sums over some ten thousand paths in single precision, whose order is free."""


def test_changes_are_half_the_difference_of_images_of_both_displaced_surfaces(tmp_path: Path) -> None:
    scene, blend = recipe("matched"), dentin_shape()
    view = whole_view(camera_at((0, 1, 0.2), size=8, span_mm=9.0))
    outwards = blend.base.vertices_mm / np.linalg.norm(blend.base.vertices_mm, axis=1, keepdims=True)
    errors = 0.1 * np.stack([outwards, outwards * (outwards[:, 1:2] > 0)])
    longer = DentinShape(blend.base, np.concatenate([blend.modes_mm, errors, -errors]))
    displaced = write_recipe(tmp_path, replace(scene, teeth=(ToothSurfaces(scene.teeth[0].outer, longer),)))
    lights = len(scene.light_positions_mm)
    ones = np.ones((lights, len(view)))
    block = write_block(tmp_path, PixelBlock(view, ones, ones, ones, ones > 2))
    task = BlockTask(block, 0, write_recipe(tmp_path, scene), "closing", TISSUE, SAMPLES)

    found = displacements_task(InProcessHost(), task, TISSUE, DisplacedScene(displaced, len(errors)), SEEDS).values

    assert found.shape == (len(errors), len(SEEDS), lights, len(view))
    known = replace(TISSUE, shape=())
    for error, changes in zip(errors, found, strict=True):
        for seed, change in zip(SEEDS, changes, strict=True):
            images = []
            for sign in (1, -1):
                surface = Mesh(blend.vertices_mm(WEIGHTS) + sign * error, blend.base.faces)
                teeth = (ToothSurfaces(scene.teeth[0].outer, DentinShape.known(surface)),)
                images.append(Engine(replace(scene, teeth=teeth)).images(known, view, seed=seed, samples=SAMPLES).mean)
            expected = 0.5 * (images[0] - images[1])
            np.testing.assert_allclose(change, expected, rtol=0, atol=ROUNDING * images[0].max())
            # Paths that start alike soon part, so the change is far above rounding.
            assert np.abs(expected).max() > 10 * ROUNDING * images[0].max()
