"""A subject that is stated not to move is left where it is, and tracking frames that are asked for must be there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from services.core.errors import SettingsError
from services.preprocess.raw.source import RawSource
from services.preprocess.views.subject import read_subject
from tests.support.mouth import write_mouth
from tests.support.raw_captures import write_raw_capture
from tests.support.raw_sensor import Sensor


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A raw folder without tracking frames, whose images differ from light to light."""
    root = tmp_path_factory.mktemp("still")
    write_mouth(root / "mouth", lights=3, sizes=((72, 56),))
    write_raw_capture(root / "raw", root / "mouth", Sensor(), (0.05,), tracking=0)
    return root / "raw"


def test_a_subject_that_cannot_move_is_not_moved(raw: Path) -> None:
    source = RawSource(raw, None, 0.01, 0.002, motion="off")
    view = read_subject(source.root, whole=False).view_of(0, source.description.cameras[0])
    assert source.matched_frames(0) == ()
    assert source.flow_comparison(view, {}) is None
    for _, image in source.images(view, source.lights_of(0), {}):
        assert (image.motion_px, image.motion_error_px, image.warped) == (0.0, 0.0, False)
        assert image.displacement is not None
        assert not np.any(image.displacement)
    assert not any("tracking" in note for note in source.notes)


def test_without_tracking_frames_the_option_is_named(raw: Path) -> None:
    assert any("motion = 'off'" in note for note in RawSource(raw, None, 0.01, 0.002).notes)


def test_tracking_frames_that_are_asked_for_must_be_there(raw: Path) -> None:
    source = RawSource(raw, None, 0.01, 0.002, motion="tracking")
    with pytest.raises(SettingsError, match="needs two tracking frames of every camera, and one has 0; give 'off'"):
        source.matched_frames(0)
