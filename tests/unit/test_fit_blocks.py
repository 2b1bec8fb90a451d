"""A block asks for the lights under which it has something to compare, and for no other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from services.fit.blocks import Block, read_block, write_block
from services.fit.transport.recipe import View
from tests.support.small_tooth import camera_at


def block_with(weights: list[list[float]]) -> Block:
    weight = np.array(weights)
    pixels = np.stack([np.arange(weight.shape[1]), np.zeros(weight.shape[1], dtype=int)], axis=1).astype(np.int32)
    held_out = np.zeros(weight.shape, dtype=bool)
    held_out[0, 1] = True
    return Block(View(camera_at((0, 1, 0)), pixels), np.ones(weight.shape), np.ones(weight.shape), weight, held_out)


@pytest.mark.parametrize(
    ("weights", "lights"),
    [([[0, 0], [2, 0], [0, 2]], (1, 2)), ([[0, 0], [0, 3], [0, 0]], (1,)), ([[1, 1], [0, 1], [1, 0]], None)],
)
def test_only_fitted_lights_are_rendered_for_the_fit(tmp_path: Path, weights: list[list[float]], lights: tuple[int, ...] | None) -> None:
    block = read_block(write_block(tmp_path, block_with(weights)))
    assert block.fitted_view.lights == lights
    np.testing.assert_array_equal(block.fitted_view.pixels, block.view.pixels)
    assert block.view.lights is None
