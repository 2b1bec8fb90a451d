"""Exposures of one light are compared only where both counted light, and the one that is empty is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from services.core.errors import CaptureInputError
from services.core.raw.merge import Exposure
from services.core.raw.records import RawFrame
from services.preprocess.raw.checks import require_like_exposures

HERE = Path("raw")
FULL = 255


def frame(name: str, exposure_s: float) -> RawFrame:
    return RawFrame(camera="c", file=name, kind="light", light="l", exposure_s=exposure_s)


def counted(rate: np.ndarray, exposure_s: float, seed: int, read_counts: float = 0.8) -> Exposure:
    """An 8-bit frame whose black level is cut at zero."""
    random = np.random.default_rng(seed)
    signal = rate * exposure_s + read_counts * random.standard_normal(rate.shape)
    counts = np.clip(np.rint(signal), 0, FULL).astype(np.float32)
    return Exposure(counts, 0.0, FULL - counts, exposure_s, 1.0)


SCENE = np.full((96, 96, 3), 1.0)
SCENE[30:60, 30:60] = 100.0
"""Counts per second: a bright square before a dim ground."""


def checked(first: Exposure, second: Exposure) -> list[RawFrame]:
    frames = [frame("short.png", first.factor), frame("long.png", second.factor)]
    return require_like_exposures(HERE, frames, [first, second], ("red", "green", "blue"))


def test_a_frame_too_short_to_count_is_no_contradiction() -> None:
    """In 0.02 s the ground gives 0.02 and the square 2 counts, and black that is cut at zero raises the ground to
    0.3: sixteen times that is far above the longer exposure's.
    """
    first, second = counted(SCENE, 0.02, 1), counted(SCENE, 0.32, 2)
    assert first.signal.mean() > 2 * (SCENE * 0.02).mean()
    assert [one.file for one in checked(first, second)] == ["short.png"]


def test_ground_that_counts_nothing_is_not_compared() -> None:
    first, second = counted(SCENE, 0.15, 3), counted(SCENE, 2.4, 4)
    assert (first.signal[:20, :20].mean() * 16) / second.signal[:20, :20].mean() > 2
    assert checked(first, second) == []


def test_an_empty_frame_where_light_was_due_is_named_as_empty() -> None:
    dark = counted(0 * SCENE, 2.4, 5)
    with pytest.raises(CaptureInputError, match=r"long\.png .* is empty: it counts nothing .* short\.png lets expect"):
        checked(counted(SCENE, 0.5, 6), dark)
    dark = counted(0 * SCENE, 0.5, 7)
    with pytest.raises(CaptureInputError, match=r"short\.png .* is empty: .* long\.png lets expect 50"):
        checked(dark, counted(SCENE, 2.0, 8))


def test_frames_that_count_light_are_still_compared() -> None:
    wrong = counted(SCENE, 0.5, 9)
    with pytest.raises(CaptureInputError, match=r"long\.png .* is clearly darker than short\.png"):
        checked(counted(SCENE, 0.5, 10), Exposure(wrong.signal, 0.0, wrong.headroom, 2.0, 1.0))
