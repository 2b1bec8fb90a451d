from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.capture.cameras.motion import SubjectMotion, resample


@given(motion_px=st.floats(0.1, 5.0), seed=st.integers(0, 1000), frame=st.integers(0, 40), camera=st.integers(0, 3))
def test_displacement_is_bounded_and_zero_at_the_reference(
    motion_px: float, seed: int, frame: int, camera: int
) -> None:
    motion = SubjectMotion(motion_px, reference=2, last=40, seed=seed)
    length = np.linalg.norm(motion.flow_px(frame, camera, 17, 23), axis=-1)
    assert length.max() <= motion_px
    if frame <= 2:
        assert length.max() == 0


@given(seed=st.integers(0, 1000))
def test_motion_is_slow_and_no_pure_shift(seed: int) -> None:
    motion = SubjectMotion(2.0, reference=2, last=40, seed=seed)
    fields = np.stack([motion.flow_px(frame, 0, 20, 30) for frame in range(2, 41)])
    assert np.ptp(fields[-1], axis=(0, 1)).max() > 0.05 * 2.0
    # d/dt of the drift is at most (π/2 + 0.3·2π)·0.8 + π/2·0.2 = 3.1 motions per capture, hence per 38 frames:
    assert np.linalg.norm(np.diff(fields, axis=0), axis=-1).max() <= 3.1 * 2.0 / 38
    # The far end of the drift keeps at least (1/√1.09)·0.8 - 0.2 = 0.56 of the bound.
    assert np.linalg.norm(fields[-1], axis=-1).min() >= 0.56 * 2.0


def test_resampling_a_known_function_matches_it() -> None:
    y, x = np.mgrid[:40, :50].astype(np.float64)

    def scene(x_px: np.ndarray, y_px: np.ndarray) -> np.ndarray:
        return (2 + np.sin(2 * np.pi * x_px / 20) * np.cos(2 * np.pi * y_px / 25))[..., None]

    flow = SubjectMotion(1.7, reference=0, last=10, seed=3).flow_px(7, 1, 40, 50)
    sampled = resample(scene(x, y).astype(np.float32), flow)
    inside = np.s_[3:-3, 3:-3]
    # Exact for quadratics, so per axis the error is at most a sixth of the largest third derivative times sum_j
    # |w_j||x_j - t|^3, which is at most 0.5625 (at t = 1/2); along y it passes the x weights, whose absolute sum is at
    # most 1.25.
    bound = 0.5625 / 6 * ((2 * np.pi / 20) ** 3 + 1.25 * (2 * np.pi / 25) ** 3)
    moved = scene(x + flow[..., 0], y + flow[..., 1])
    assert np.abs(sampled - moved)[inside].max() < bound
    assert np.abs(scene(x, y) - moved)[inside].max() > 20 * bound


def test_integer_displacement_is_exact() -> None:
    image = np.random.default_rng(0).random((9, 11, 2), dtype=np.float32)
    flow = np.zeros((9, 11, 2))
    flow[..., 0] = 2
    assert resample(image, flow)[:, :9] == pytest.approx(image[:, 2:])
