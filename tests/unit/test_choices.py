"""An unknown name is never taken for a known one."""

from __future__ import annotations

import numpy as np
import pytest

from services.core.choices import chosen
from services.core.errors import SettingsError
from services.fit.solve.losses import weights


def test_what_is_known_is_chosen() -> None:
    assert chosen("Colour", "red", {"red": 1, "green": 2}) == 1


def test_what_is_not_known_is_told_with_what_is() -> None:
    with pytest.raises(SettingsError, match="Colour 'blue' is not known; known are green, red"):
        chosen("Colour", "blue", {"red": 1, "green": 2})


def test_an_unknown_loss_is_no_relative_one() -> None:
    ones = np.ones(3)
    with pytest.raises(SettingsError, match="Loss 'cauchy' is not known; known are l1, l2"):
        weights("cauchy", ones, ones, ones, ones)  # type: ignore[arg-type]  # the loss is unknown on purpose
