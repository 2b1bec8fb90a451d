"""Darkness is read from what the lights emit, not from what they were told."""

from __future__ import annotations

import pytest

from services.capture.dome import registers as reg
from services.capture.dome.flashes import Flashes
from services.core.errors import ReadbackError
from tests.support.model_dome import Clock, Controller, ModelDome


def test_a_light_that_stays_on_after_all_off_is_told() -> None:
    controller = Controller(lights=3, clock=Clock())
    with ModelDome(controller, Flashes.of_no_real_light()) as dome:
        dome.light(1, 0.5, 1.0)
        controller.model._stuck[1] = reg.FULL_SCALE
        with pytest.raises(ReadbackError, match="light 1 still emits after all-off"):
            dome.dark()
        assert not any(controller.model.values(reg.LEVELS))
        controller.model._stuck.clear()
