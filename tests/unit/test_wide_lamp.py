"""The wide lamp under which renderers are compared."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.cycles_scenes import LAMP, ROOM, WIDE_LAMP_DEG, wide_lamp


def test_the_wide_lamp_stands_where_the_point_does_and_a_diffuser_tells_its_light() -> None:
    picture, white = wide_lamp()
    height, width = picture.shape
    assert (width, picture.max(), picture.min()) == (2 * height, 1.0, ROOM)
    # Of a radiance f that depends on the angle alone a diffuser that faces its middle has the radiance 2 int f c dc;
    # between the lamp's angles f rises linearly in c. Pixels of 1.4 degrees are off by some 1e-4.
    inner, outer = np.cos(np.radians(WIDE_LAMP_DEG))
    rising = 2 / (inner - outer) * ((inner**3 - outer**3) / 3 - outer * (inner**2 - outer**2) / 2)
    assert white == pytest.approx(ROOM + (1 - ROOM) * (rising + 1 - inner**2), rel=1e-3)
    # The brightest part is about the point's direction: up from the horizon at row 0 to down, and x in the middle.
    row, column = (axis.mean() for axis in np.nonzero(picture == 1.0))
    x, y, z = np.array(LAMP.position_mm) / np.linalg.norm(LAMP.position_mm)
    assert column + 0.5 == pytest.approx(width * (0.5 - np.arctan2(y, x) / (2 * np.pi)), abs=1.0)
    # Away from the horizon a cone covers more columns above its middle than below.
    assert row + 0.5 == pytest.approx(height * (0.5 - np.arcsin(z) / np.pi), abs=4.0)
