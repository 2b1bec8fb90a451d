"""Pictures of a fit: lists of pixels become images again."""

from __future__ import annotations

from unittest.mock import Mock

import numpy as np
import pytest

from services.fit.measurements.view_stack import ViewStack
from services.fit.stages.previews import pictures_of, spacing
from tests.support.prepared import camera, lights


@pytest.mark.parametrize("every", [1, 2, 5])
def test_the_spacing_of_a_subset_is_found_whatever_is_missing(every: int) -> None:
    y, x = (axis.ravel() for axis in np.mgrid[0:40:every, 0:60:every])
    kept = np.random.default_rng(every).random(len(x)) < 0.7
    assert spacing(np.stack([x, y], axis=1)[kept].astype(np.int32)) == every


def test_too_few_pixels_have_no_spacing() -> None:
    assert spacing(np.array([[3, 4]], dtype=np.int32)) == 1
    assert spacing(np.zeros((0, 2), dtype=np.int32)) == 1


def test_pictures_are_cropped_about_the_tooth_alike_in_all_channels() -> None:
    # The tooth's pixels lie at 8 to 17 and 4 to 13 of an image of 20 x 24, so the frame is one pixel wide.
    manifest = Mock(lights=lights(1))
    y, x = (axis.ravel() for axis in np.mgrid[4:14, 8:18])
    pixels = np.stack([x, y], axis=1).astype(np.int32)
    stack = np.arange(100.0)[None]
    valid, held_out = np.ones((1, 100), dtype=bool), np.zeros(1, dtype=bool)
    whole = ViewStack(camera("c0"), pixels, stack, stack, valid, held_out)
    views = {"red": (whole,), "green": (whole.of(np.arange(100) < 90),)}
    evaluations = {
        name: Mock(renders={("c0", 0): (own[0].pixels, own[0].reference[0] + 1)}) for name, own in views.items()
    }
    (picture,) = pictures_of(evaluations, manifest, views)
    assert picture.photo.shape == (12, 12, 2)
    np.testing.assert_array_equal(picture.photo[1:11, 1:11, 0], stack.reshape(10, 10))
    np.testing.assert_array_equal(picture.render[1:10, 1:11, 1], stack.reshape(10, 10)[:9] + 1)
    assert picture.valid.sum() == 100
