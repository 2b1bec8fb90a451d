"""Radiometry of raw frames of a sensor whose numbers are known."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from services.core.calibration.cameras_and_lights import CalibratedCamera
from services.core.raw.merge import Exposure, merge
from services.core.raw.noise import LitPair, NoiseModel, read_noise, shot_noise
from services.core.raw.records import Mosaic
from services.preprocess.raw.demosaic import demosaic, demosaic_variance
from services.preprocess.raw.lens import Lens, Sampler, fitted_vignetting
from services.preprocess.raw.response import Series, measure_linearity
from services.preprocess.views.window import Window
from tests.support.raw_sensor import Sensor, taken_through

SHAPE = (250, 400, 1)
RAMP = np.broadcast_to(np.linspace(100, 3300, SHAPE[1])[None, :, None], SHAPE)


def signal(
    sensor: Sensor, seed: int, radiance: np.ndarray = RAMP, exposure_s: float = 1.0, gain: float = 1.0
) -> np.ndarray:
    """Counts above black, NaN where the sensor is full."""
    counts = sensor.counts(radiance, exposure_s, np.random.default_rng(seed), gain).astype(np.float32)
    return np.where(counts < sensor.full, counts - np.float32(sensor.black), np.nan).astype(np.float32)


@pytest.mark.parametrize(
    ("read", "per_electron", "gain"), [(2.0, 0.5, 1.0), (0.7, 0.1, 1.0), (6.0, 1.7, 1.0), (1.5, 0.25, 4.0)]
)
def test_photon_transfer_finds_gain_and_read_noise_to_two_per_cent(
    read: float, per_electron: float, gain: float
) -> None:
    """A variance from 100,000 pixels in each pair is known to 0.45 %, from four pairs to half of that, so 2 % is nine
    standard errors.
    """
    sensor = Sensor(read_counts=read, counts_per_electron=per_electron)
    dark = [signal(sensor, k, 0 * RAMP, gain=gain) for k in range(5)]
    found_read = read_noise(dark, gain)
    assert found_read == pytest.approx(read, rel=0.02)
    lit = [signal(sensor, 10 + k, RAMP / gain, gain=gain) for k in range(5)]
    found = shot_noise([LitPair(a, b, gain) for a, b in pairwise(lit)], found_read)
    assert found is not None
    assert found[0] == pytest.approx(per_electron, rel=0.02)


def test_pairs_of_two_exposures_and_a_flickering_light_tell_the_gain_too() -> None:
    sensor = Sensor()
    pairs = [LitPair(signal(sensor, k, RAMP, 0.25), signal(sensor, 50 + k, RAMP * 1.03, 0.5), 1.0) for k in range(4)]
    found = shot_noise(pairs, 2.0)
    assert found is not None
    assert found[0] == pytest.approx(0.5, rel=0.02)


def test_frames_without_light_tell_no_gain() -> None:
    sensor = Sensor()
    dark = [signal(sensor, k, 0 * RAMP + 0.5) for k in range(2)]
    assert shot_noise([LitPair(dark[0], dark[1], 1.0)], 2.0) is None
    assert read_noise(dark[:1], 1.0) is None


def exposure(sensor: Sensor, radiance: np.ndarray, exposure_s: float, seed: int) -> Exposure:
    counts = sensor.counts(radiance, exposure_s, np.random.default_rng(seed)).astype(np.float32)
    return Exposure(counts - np.float32(sensor.black), 0.0, sensor.full - counts, exposure_s, 1.0)


def test_merged_exposures_are_unbiased_and_as_uncertain_as_they_say() -> None:
    """100,000 pixels from near read noise to beyond full scale of the longest exposure.

    In each of 20 levels of 5,000 pixels, the mean is within 5 standard errors of the truth (1e-5 false alarms in all),
    and the scatter is within 5 standard errors, 10 %, of the mean stated variance.
    """
    sensor, radiance = Sensor(), np.broadcast_to(np.geomspace(2, 12_000, SHAPE[1])[None, :, None], SHAPE)
    exposures = [exposure(sensor, radiance, seconds, k) for k, seconds in enumerate((0.2, 1.0, 5.0))]
    rate, variance, lost = merge(exposures, NoiseModel(2.0, 0.5))
    assert not lost.any()
    for columns in np.array_split(np.arange(SHAPE[1]), 20):
        error, told = (rate - radiance)[:, columns], variance[:, columns]
        assert abs(error.mean()) < 5 * np.sqrt(told.mean() / error.size)
        assert abs(error.var() / told.mean() - 1) < 5 * np.sqrt(2 / error.size)


def test_what_is_full_in_every_exposure_is_lost() -> None:
    sensor = Sensor()
    bright = np.full((4, 4, 1), 1e6)
    rate, variance, lost = merge(
        [exposure(sensor, bright, 0.2, 1), exposure(sensor, bright, 1.0, 2)], NoiseModel(2.0, 0.5)
    )
    assert lost.all()
    assert not rate.any()
    assert not variance.any()


def test_a_bent_response_is_found_and_straightened() -> None:
    """The sensor loses 6 % at full scale; corrected exposures agree to 0.3 %, a twentieth of that."""
    sensor = Sensor(bend=-0.06, black=0.0)
    ladder = [signal(sensor, k, RAMP, seconds) for k, seconds in enumerate((0.125, 0.25, 0.5, 1.0))]
    series = [Series(a, b, 2.0) for a, b in pairwise(ladder)]
    found = measure_linearity(series, sensor.full)
    assert np.median(found.ratios) < 0.995
    straight = [found.linearised(one) for one in ladder]
    for shorter, longer in pairwise(straight):
        seen = np.isfinite(longer)
        assert longer[seen].sum() / shorter[seen].sum() == pytest.approx(2.0, rel=0.003)


def test_a_linear_camera_is_left_as_it_is() -> None:
    sensor = Sensor(black=0.0)
    ladder = [signal(sensor, k, RAMP, seconds) for k, seconds in enumerate((0.25, 0.5, 1.0))]
    found = measure_linearity([Series(a, b, 2.0) for a, b in pairwise(ladder)], sensor.full)
    assert found.is_linear
    assert np.median(found.ratios) == pytest.approx(1.0, abs=0.002)


@pytest.mark.parametrize("mosaic", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_demosaicing_keeps_what_is_linear_in_place(mosaic: Mosaic) -> None:
    """Away from the border the filters are exact where every channel is a plane, whatever its level."""
    y, x = np.mgrid[0:20, 0:30].astype(float)
    image = np.stack([50 + x, 200 + 2 * y, 100 + x - y], axis=-1)
    found = demosaic(taken_through(image, mosaic).astype(np.float32), mosaic)
    # Scaled to the same mean, the channels still have unequal slopes, to which the filters' second differences are
    # blind.
    np.testing.assert_allclose(found[4:-4, 4:-4], image[4:-4, 4:-4], rtol=2e-5)


def test_sums_over_a_demosaiced_image_have_the_error_that_they_say() -> None:
    """With 400 draws of noise the variance of a sum over 40 x 40 pixels is known to 7 %, so a ratio from 0.75 to 1.3 is
    within 4 standard errors.
    """
    rng, variance = np.random.default_rng(4), np.full((60, 60), 9.0, dtype=np.float32)
    told = demosaic_variance(variance, "GRBG")[10:50, 10:50].sum(axis=(0, 1))
    sums = [
        demosaic((100 + 3 * rng.standard_normal((60, 60))).astype(np.float32), "GRBG")[10:50, 10:50].sum(axis=(0, 1))
        for _ in range(400)
    ]
    ratio = np.var(sums, axis=0) / told
    assert ((ratio > 0.75) & (ratio < 1.3)).all(), ratio


def camera(**more: object) -> CalibratedCamera:
    tree = {"name": "c", "size": (160, 120), "K": ((200.0, 0, 83.0), (0, 205.0, 58.0), (0, 0, 1))}
    return CalibratedCamera.model_validate(tree | {"camera_from_world": np.eye(4).tolist()} | more)


def test_one_resampling_takes_distortion_and_fall_of_light_out() -> None:
    """A scene known in every direction is drawn through the lens with OpenCV's own projection, and recovered.

    Linear interpolation of a wave of 40 pixels has an error of its curvature times 1/8: 0.3 % of the wave.
    """
    import cv2

    distortion, vignetting = (-0.25, 0.08, 0.002, -0.001, 0.0), (-0.4, 0.1, 0.0)
    lens_camera = camera(distortion=distortion, vignetting=vignetting)
    K = np.asarray(lens_camera.K)

    def scene(x_px: np.ndarray, y_px: np.ndarray) -> np.ndarray:
        return 100 + 30 * np.sin(x_px / 6.4) * np.cos(y_px / 6.4)

    y, x = np.mgrid[0:120, 0:160] + 0.5
    # The pinhole pixel that each pixel of the photograph shows
    pinhole = cv2.undistortPoints(np.stack([x, y], axis=-1).reshape(-1, 1, 2), K, np.array(distortion), None, None, K)
    pinhole = np.asarray(pinhole).reshape(120, 160, 2)
    q = ((x - K[0, 2]) ** 2 + (y - K[1, 2]) ** 2) / (80**2 + 60**2)
    relative_brightness = 1 + vignetting[0] * q + vignetting[1] * q**2
    photograph = (scene(pinhole[..., 0], pinhole[..., 1]) * relative_brightness).astype(np.float32)

    # A window of the image, and a subject that has moved by 3 and -2 pixels in it
    window, moved = Window(20, 100, 30, 130), np.array([3.0, -2.0], dtype=np.float32)
    lens = Lens(lens_camera, lens_camera.vignetting or (0.0, 0.0, 0.0))
    sampler = Sampler(lens, window)
    own_y, own_x = np.mgrid[5:75, 5:95].astype(np.float32)
    positions = sampler.positions(np.stack([own_x, own_y]) + moved[:, None, None])
    dimmed = lens.relative_brightness(positions[0], positions[1])
    assert dimmed is not None
    found = sampler.sampled(photograph[sampler.region.rows, sampler.region.columns, None], positions)[..., 0] / dimmed
    np.testing.assert_allclose(found, scene(own_x + 30.5 + 3, own_y + 20.5 - 2), atol=0.35)
    assert not sampler.beyond(positions).any()
    assert sampler.beyond(np.full((2, 1, 1), -1, dtype=np.float32)).all()


def test_the_fall_of_light_is_fitted_to_a_flat_frame() -> None:
    told = (-0.5, 0.2, -0.05)
    y, x = np.mgrid[0:120, 0:160] + 0.5
    q = ((x - 83.0) ** 2 + (y - 58.0) ** 2) / (80**2 + 60**2)
    flat = (1000 * (1 + told[0] * q + told[1] * q**2 + told[2] * q**3))[..., None].astype(np.float32)
    a, b, c = fitted_vignetting(camera(), flat)
    relative_brightness = 1 + q * (a + q * (b + q * c))
    # Single precision and every eighth pixel: the curve is determined, its coefficients are not.
    np.testing.assert_allclose(relative_brightness, flat[..., 0] / 1000, rtol=1e-4)
