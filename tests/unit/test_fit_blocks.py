"""A block of the fit renders only the lights under which it compares something; a stored scene reads back whole."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.core.files.content_files import StoredFile
from services.core.records import Device
from services.fit.measurements.blocks import BlockTask, PixelBlock, read_block, write_block
from services.fit.passes.derivatives import Differentiation
from services.fit.passes.evaluate import evaluate_task
from services.fit.passes.passes import compare_task, image_task, jacobian_task, orders_task
from services.transport.optics.parameters import Medium, Tissue
from services.transport.scene.recipe import JacobianEstimate, SceneRecipe, StackEstimate, ToothSurfaces, View
from services.transport.scene.recipe_files import read_recipe, write_recipe
from tests.support.small_tooth import INTENSITY, LIGHTS_MM, SEMI_AXES_MM, camera_at, dentin_shape, ellipsoid, sphere


def block_with(weights: list[list[float]]) -> PixelBlock:
    weight = np.array(weights)
    pixels = np.stack([np.arange(weight.shape[1]), np.zeros(weight.shape[1], dtype=int)], axis=1).astype(np.int32)
    held_out = np.zeros(weight.shape, dtype=bool)
    held_out[0, 1] = True
    return PixelBlock(
        View(camera_at((0, 1, 0)), pixels), np.ones(weight.shape), np.ones(weight.shape), weight, held_out
    )


@pytest.mark.parametrize(
    ("weights", "lights"),
    [([[0, 0], [2, 0], [0, 2]], (1, 2)), ([[0, 0], [0, 3], [0, 0]], (1,)), ([[1, 1], [0, 1], [1, 0]], None)],
)
def test_only_fitted_lights_are_rendered_for_the_fit(
    tmp_path: Path, weights: list[list[float]], lights: tuple[int, ...] | None
) -> None:
    block = read_block(write_block(tmp_path, block_with(weights)))
    assert block.fitted_view.lights == lights
    np.testing.assert_array_equal(block.fitted_view.pixels, block.view.pixels)
    assert block.view.lights is None


@pytest.mark.parametrize("device", [None, "llvm", "cuda"])
def test_a_stored_scene_reads_back_whole(tmp_path: Path, device: Device | None) -> None:
    teeth = (
        ToothSurfaces(ellipsoid(SEMI_AXES_MM), dentin_shape()),
        ToothSurfaces(sphere(2.0), stain_uv=np.ones((len(sphere(2.0).faces), 3, 2))),
    )
    scene = SceneRecipe(
        teeth, LIGHTS_MM, np.full(len(LIGHTS_MM), INTENSITY), "thin", 1.5, device, sphere(5.0), 1.4, sphere(9.0)
    )
    stored = read_recipe(write_recipe(tmp_path, scene))
    assert (stored.boundary, stored.ior, stored.device, stored.gums_ior) == ("thin", 1.5, device, 1.4)
    np.testing.assert_equal(asdict(stored), asdict(scene))


def test_a_stored_scene_holds_what_it_always_held(tmp_path: Path) -> None:
    # Fits find their checkpoints by the digests of their scenes, and a digest is of these arrays in this order.
    scene = SceneRecipe((ToothSurfaces(sphere(2.0)),), LIGHTS_MM, np.ones(len(LIGHTS_MM)))
    arrays = write_recipe(tmp_path, scene).load()
    assert list(arrays) == [
        "teeth", "neighbours", "light_positions", "light_intensities", "boundary", "ior", "gums_ior", "border_width_mm",
        "device", "outer0_vertices", "outer0_faces",
    ]  # fmt: skip
    assert arrays["border_width_mm"] == np.array(0.0)


@pytest.mark.parametrize("missing", ["gums", "cavity", "dentin"])
def test_what_a_scene_lacks_stays_absent(tmp_path: Path, missing: str) -> None:
    whole = SceneRecipe(
        (ToothSurfaces(sphere(2.0), dentin_shape()),),
        LIGHTS_MM,
        np.ones(len(LIGHTS_MM)),
        gums=sphere(5.0),
        cavity=sphere(9.0),
    )
    absent: dict[str, Any] = {missing: None}
    scene = replace(whole, teeth=(ToothSurfaces(sphere(2.0)),)) if missing == "dentin" else replace(whole, **absent)
    stored = read_recipe(write_recipe(tmp_path, scene))
    assert (stored.gums is None, stored.cavity is None, stored.teeth[0].dentin is None) == tuple(
        missing == part for part in ("gums", "cavity", "dentin")
    )


class Recorder:
    """A host that renders zeros and remembers which lights it was asked for, and in how many batches."""

    def __init__(self) -> None:
        self.asked: list[tuple[int, ...] | None] = []
        self.batches: list[int] = []

    def call(self, method: str, recipe: StoredFile, tissue: Tissue, view: View, *names: Any, **options: Any) -> Any:  # noqa: ARG002 - signature of the host
        self.asked.append(view.lights)
        self.batches.append(options.get("batches", 0))
        shape = (3, len(view))
        if method == "images":
            return StackEstimate(np.zeros(shape), np.zeros(shape))
        if method == "order_images":
            return np.zeros((len(options["bin_edges"]) - 1, *shape))
        return JacobianEstimate(
            names[0], np.zeros(shape), np.zeros(shape), np.zeros((1, *shape)), np.zeros((1, *shape))
        )

    def close(self) -> None:
        """Nothing to release."""


@pytest.fixture
def task(tmp_path: Path) -> BlockTask:
    stored = write_block(tmp_path, block_with([[0, 0], [2, 0], [0, 2]]))
    tissue = Tissue(Medium(1, 0.9), Medium(1, 0.9))
    return BlockTask(stored, 0, stored, "step", tissue, 16)


def test_every_task_of_the_fit_asks_for_fitted_lights_alone(task: BlockTask) -> None:
    host = Recorder()
    residual = image_task(host, task, (1, 2))
    jacobian_task(host, task, Differentiation(("enamel.sigma",), np.ones((1, 1))), (1, 2), residual, None)
    compare_task(host, task, task.tissue, (1, 2))
    orders_task(host, task, np.array([0, 2, 9]), 1)
    assert host.asked == [(1, 2)] * 9


def test_what_needs_no_variance_of_its_own_is_rendered_as_one_batch(task: BlockTask) -> None:
    # More batches than one round the paths up, and each ends with paths for which other lanes wait.
    host = Recorder()
    residual = image_task(host, task, (1, 2))
    jacobian_task(host, task, Differentiation(("enamel.sigma",), np.ones((1, 1))), (1, 2), residual, None)
    compare_task(host, task, task.tissue, (1, 2))
    evaluate_task(host, task, (1, 2), ())
    assert host.batches == [1] * 10


def test_the_evaluation_adds_what_is_held_out(task: BlockTask) -> None:
    # Light 0 is held out in one pixel, so all three count.
    host = Recorder()
    evaluate_task(host, task, (1, 2), ())
    assert host.asked == [None] * 2


def test_the_evaluation_renders_the_pictures_it_shows(tmp_path: Path) -> None:
    block = block_with([[0, 0], [2, 0], [0, 0]])
    block.held_out[:] = False
    stored = write_block(tmp_path, block)
    task = BlockTask(stored, 0, stored, "step", Tissue(Medium(1, 0.9), Medium(1, 0.9)), 16)
    for shown, lights in (((), (1,)), ((("c0", 2),), (1, 2)), ((("another camera", 2),), (1,))):
        host = Recorder()
        evaluate_task(host, task, (1, 2), shown)
        assert host.asked == [lights] * 2
