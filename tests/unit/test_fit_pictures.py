"""Pictures of a fit: lists of pixels become images again."""

from __future__ import annotations

import numpy as np
import pytest

from services.fit.export.previews import spacing


@pytest.mark.parametrize("every", [1, 2, 5])
def test_the_spacing_of_a_subset_is_found_whatever_is_missing(every: int) -> None:
    y, x = (axis.ravel() for axis in np.mgrid[0:40:every, 0:60:every])
    kept = np.random.default_rng(every).random(len(x)) < 0.7
    assert spacing(np.stack([x, y], axis=1)[kept].astype(np.int32)) == every


def test_too_few_pixels_have_no_spacing() -> None:
    assert spacing(np.array([[3, 4]], dtype=np.int32)) == 1
    assert spacing(np.zeros((0, 2), dtype=np.int32)) == 1
