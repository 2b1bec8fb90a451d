"""A curve for a camera's counts is applied only where it betters exposures that it was not fitted to."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from services.core.raw.records import RawFrame
from services.preprocess.raw.camera import _even_choice
from services.preprocess.raw.response import Series, measure_linearity
from tests.support.chart_frames import BANDS_NM, FULL, TIMES_MS, as_counted, bent, pairs, patch_ratios


@pytest.mark.parametrize(
    ("times_ms", "bands_nm"),
    [((25, 100, 2000), BANDS_NM), ((25, 100, 500), (450,)), ((25, 100, 500, 2000), (650,)), ((25, 100), BANDS_NM)],
)
def test_counts_of_a_real_linear_sensor_stay(times_ms: tuple[int, ...], bands_nm: tuple[int, ...]) -> None:
    """Of each of these sets a curve that is fitted to all of it shifts the median ratio of patches by 1 to 3 %."""
    found = measure_linearity(pairs(times_ms, bands_nm), FULL)
    assert found.ratios.size
    assert found.is_linear
    assert "taken as they are" in found.verdict()


@pytest.mark.parametrize("share", [-0.1, 0.1])
def test_a_real_scene_seen_by_a_bent_sensor_is_straightened(share: float) -> None:
    """Fitted to four bands, the curve brings the patches of three others nearer to the ratios of their times."""
    found = measure_linearity(pairs(TIMES_MS, BANDS_NM[::2], bent(share)), FULL)
    assert found.left_out is not None
    assert found.left_out.is_better
    assert found.left_out.curved < found.left_out.plain / 2
    bend = bent(share)
    off = [
        float(np.median(np.abs(np.log(patch_ratios(TIMES_MS, BANDS_NM[1::2], correct)))))
        for correct in (as_counted, bend, lambda signal: found.linearised(bend(signal)))
    ]
    plain, curved, straightened = off
    assert straightened < 0.7 * curved
    # A linear sensor's own ratios are off by what edges and shutter times leave.
    assert straightened < 1.3 * plain


def ladder(random: np.random.Generator, times_s: list[float], told_s: list[float]) -> list[Series]:
    """Pairs of exposures of a linear ramp with 0.2 % of noise a pixel."""
    ramp = np.broadcast_to(np.linspace(100, 3500, 320)[None, :, None], (96, 320, 1))
    frames = [(ramp * one * (1 + 0.002 * random.standard_normal(ramp.shape))).astype(np.float32) for one in times_s]
    own = pairwise(zip(frames, told_s, strict=True))
    return [Series(a, b, second / first, (first, second)) for (a, first), (b, second) in own]


def test_a_shutter_time_that_is_off_bends_no_counts() -> None:
    """Four lights whose middle exposure is 4 % longer than told: every pair of a step is off alike."""
    random = np.random.default_rng(1)
    series = [pair for _ in range(4) for pair in ladder(random, [0.25, 0.52, 1.0], [0.25, 0.5, 1.0])]
    found = measure_linearity(series, 4095)
    assert found.is_linear
    assert found.left_out is not None
    assert found.left_out.curved > found.left_out.plain


def test_with_one_step_of_exposures_the_counts_stay() -> None:
    random = np.random.default_rng(2)
    found = measure_linearity([pair for _ in range(4) for pair in ladder(random, [0.5, 1.0], [0.5, 1.0])], 4095)
    assert found.is_linear
    assert "two steps of exposures" in found.verdict()


def test_pairs_are_chosen_evenly_from_all_steps() -> None:
    """Of 16 lights in three exposures a stride of four takes pairs of one step alone."""
    frames = [
        [
            RawFrame(camera="c", file=f"{light}-{k}.png", kind="light", light=f"l{light}", exposure_s=seconds)
            for k, seconds in enumerate((0.1, 0.2, 0.4))
        ]
        for light in range(16)
    ]
    chosen = _even_choice([pair for own in frames for pair in pairwise(own)], 8)
    steps = [(one.exposure_s, other.exposure_s) for one, other in chosen]
    assert steps.count((0.1, 0.2)) == steps.count((0.2, 0.4)) == 4
    assert len({one.light for one, _ in chosen}) == 4
