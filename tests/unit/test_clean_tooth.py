"""The stored photographs of the full-size tooth are what the script that rendered them says."""

from __future__ import annotations

import numpy as np

from services.bench.fits.tooth_scale import LIGHTS
from tests.benchmarks.render_clean_tooth import PACKED, STEPS_PER_ERROR


def test_stored_photographs_have_the_stated_noise() -> None:
    squares = np.zeros(2)
    with np.load(PACKED) as stored:
        cameras = sorted(name.removesuffix("_mean") for name in stored.files if name.endswith("_mean"))
        for camera in cameras:
            mean = stored[f"{camera}_mean"].astype(np.float64)
            assert mean.shape == stored[f"{camera}_error"].shape
            assert mean.shape[0] == LIGHTS
            assert mean.shape[1] > 20_000
            assert np.isfinite(mean).all()
            error = mean * stored[f"{camera}_error"] / STEPS_PER_ERROR
            squares += (error**2).sum(), (mean**2).sum()
    assert cameras == ["c0", "c1", "c2"]
    # 5.0 % by the passes; stored errors are rounded up to the next 256th of the value, by 0.2 % on average.
    assert 0.048 < np.sqrt(squares[0] / squares[1]) < 0.053
