"""From counts to radiance, checked with the sensor model that the counts are drawn from."""

from __future__ import annotations

import numpy as np
import pytest

from services.core.geometry import Camera, Light
from services.core.records import FolderCapture
from services.core.results import CaptureManifest, FrameRecord
from services.preprocess.captures.radiometry import Merge, Radiometry

BLACK, BITS, PER_COUNT = 64, 12, 2e-3


def manifest() -> CaptureManifest:
    camera = Camera(
        name="c",
        size=(200, 200),
        K=((1, 0, 0), (0, 1, 0), (0, 0, 1)),
        camera_from_world=((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)),
    )
    return CaptureManifest(
        description=FolderCapture(
            units="mm",
            channels=("green",),
            cameras=(camera,),
            lights=(Light(name="l", position_mm=(0, 0, 1), intensity=(1.0,)),),
        ),
        frames=(),
        bits=BITS,
        black_level=BLACK,
        radiance_per_count=PER_COUNT,
        sensor_noise_relative=0.01,
        sensor_noise_floor=0.002,
        fdi=(11,),
    )


def frame(exposure_s: float = 0.05, level: float = 0.5) -> FrameRecord:
    return FrameRecord(
        index=3, kind="light", light="l", exposure_s=exposure_s, level=level, time_s=0, readback=(0, 0, 0)
    )


def expose(truth: np.ndarray, frame: FrameRecord, rng: np.random.Generator) -> np.ndarray:
    signal = truth * frame.level * frame.exposure_s / PER_COUNT
    noise = np.hypot(0.01 * signal, 0.002 * 4095) * rng.standard_normal(truth.shape)
    return np.clip(np.rint(BLACK + signal + noise), 0, 4095).astype(np.uint16)


def test_radiance_and_variance_describe_the_draw() -> None:
    """z-scores of 40,000 pixels: mean and mean square within 5 standard errors, 1e-6 false alarms each.

    Dividing by a variance that is itself estimated from the noisy value shifts mean z by -0.01 and mean z² by 3·0.01²
    at most, so z is formed with the true variance and the estimated one is compared to it: their ratio spreads by
    2·0.01.
    """
    rng = np.random.default_rng(2)
    truth = np.linspace(5, 250, 40_000).reshape(200, 200, 1)
    black = np.mean([expose(0 * truth, frame(), rng) for _ in range(4)], axis=0).astype(np.float32)
    radiance, variance, saturated = Radiometry(black, 4, manifest()).radiance(expose(truth, frame(), rng), frame())
    gain = PER_COUNT / (0.5 * 0.05)
    expected = (0.01 * truth) ** 2 + gain**2 * ((0.002 * 4095) ** 2 + 1 / 12) * 1.25
    z = (radiance - truth) / np.sqrt(expected)
    assert abs(z.mean()) < 5 / np.sqrt(z.size)
    assert abs((z**2).mean() - 1) < 5 * np.sqrt(2 / z.size)
    assert np.abs(variance / expected - 1).max() < 5 * 2 * 0.01 + 0.02
    assert not saturated.any()


def test_saturation_is_flagged() -> None:
    counts = np.full((2, 2, 1), 1000, dtype=np.uint16)
    counts[0, 1] = 4095
    _, _, saturated = Radiometry(np.full((2, 2, 1), 64, np.float32), 2, manifest()).radiance(counts, frame())
    np.testing.assert_array_equal(saturated, [[False, True], [False, False]])


def test_merge_of_two_exposures_is_better_than_either_and_survives_saturation() -> None:
    rng = np.random.default_rng(4)
    truth = np.full((200, 200, 1), 30.0)
    truth[:100] = 500.0  # beyond the long exposure's range of 322, within the short one's
    truth[:, :50] = 2000.0  # beyond both
    black = np.full(truth.shape, BLACK, dtype=np.float32)
    merged, single = Merge(), {}
    exact = 10**9  # number of averaged black frames, so that the black level has no noise
    for exposure_s in (0.05, 0.025):
        seen = Radiometry(black, exact, manifest()).radiance(expose(truth, frame(exposure_s), rng), frame(exposure_s))
        merged.add(*seen)
        single[exposure_s] = seen
    radiance, variance, lost = merged.result()
    assert lost[:, :50].all()
    assert not lost[:, 50:].any()
    assert (radiance[lost] == 0).all()
    bright, dark = np.s_[:100, 50:], np.s_[100:, 50:]
    assert radiance[bright].mean() == pytest.approx(500, rel=5 * 0.02 / np.sqrt(15_000))
    assert (variance[dark] < single[0.05][1][dark]).all()
    spread = radiance[dark].var()
    assert spread == pytest.approx(variance[dark].mean(), rel=5 * np.sqrt(2 / 15_000))
