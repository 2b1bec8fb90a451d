"""Standard errors are correct: 95 % intervals by Student's t contain the truth 95 times in a hundred, and a requested
error is the true one.

The lights of a pixel and the derivatives of its images share random walks. So every interval here comes from other
walks: one value per seed and pixel, with light and parameter drawn beforehand. Pixels lie inside the tooth's outline,
because few paths of a pixel at its edge hit the tooth, and a mean of so few is not normally distributed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from services.core.errors import InputError
from services.transport.engine import Engine
from services.transport.optics.parameters import Medium, Tissue
from tests.support.small_tooth import LIGHTS_MM, camera_at, recipe, whole_view

TISSUE = Tissue(Medium(2, 0.95, 0.8, 0.6, -0.3), Medium(3, 0.8, 0.7, 0.6, -0.3), (0.5, 0.4))
NAMES = ("enamel.sigma", "dentin.alpha", "enamel.g1", "dentin.beta", "shape.0")
VIEW = whole_view(camera_at((0.2, 1, 0.1), size=6, span_mm=4.0))
SEEDS, SAMPLES, TRUTH_SAMPLES = 56, 256, 16 * 1024
"""Number of seeds, paths per pixel of a run, and paths per pixel of the truth. The truth's own error must be small,
because it enters with the wide quantile of few batches: if it is a large part, intervals contain the truth too
often."""
LEVEL, LOWEST, HIGHEST = 0.95, 0.93, 0.97
"""Level of the intervals, and bounds on their coverage. Of 2016 independent intervals, correct ones cover 93 to 97 %
except once in 20,000 runs; the binomial's standard deviation is 0.49 %."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Intervals:
    """Independent values and their true values.

    Attributes:
        batches: number of batches from which a standard error was estimated.
    """

    offset: Array
    """Value minus truth."""
    error: Array
    """Standard error of ``offset``, including that of the truth."""
    batches: int

    def covered(self, scale: float = 1.0) -> NDArray[np.bool_]:
        """Which intervals contain the truth when every standard error is multiplied by ``scale``."""
        return np.abs(self.offset) <= stats.t.ppf((1 + LEVEL) / 2, self.batches - 1) * scale * self.error


@pytest.fixture(scope="module")
def engine() -> Engine:
    return Engine(recipe())


def intervals(
    means: Array, variances: Array, truth: Array, truth_variance: Array, batches: int, which: NDArray[np.int64]
) -> Intervals:
    """Select, from values (seed, K, N) and truths (K, N), the entry ``which`` (seed, N) at each seed and pixel."""
    rows, pixels = np.arange(len(means))[:, None], np.arange(means.shape[-1])
    offset = means[rows, which, pixels] - truth[which, pixels]
    error = np.sqrt(variances[rows, which, pixels] + truth_variance[which, pixels])
    return Intervals(offset.ravel(), error.ravel(), batches)


def require_honest(found: Intervals) -> None:
    assert len(found.offset) >= 2000
    assert LOWEST <= found.covered().mean() <= HIGHEST
    # The bounds are narrow enough to find standard errors that are too small or too large.
    assert found.covered(0.7).mean() < LOWEST
    assert found.covered(1.5).mean() > HIGHEST


@pytest.mark.dear("Fifty-six renders are compared with a long one.")
def test_errors_of_images_are_honest(engine: Engine) -> None:
    truth = engine.images(TISSUE, VIEW, samples=TRUTH_SAMPLES, seed=9000)
    runs = [engine.images(TISSUE, VIEW, samples=SAMPLES, seed=9001 + seed) for seed in range(SEEDS)]
    light = np.random.default_rng(1).integers(len(LIGHTS_MM), size=(SEEDS, len(VIEW)))
    means, variances = np.array([run.mean for run in runs]), np.array([run.variance for run in runs])
    require_honest(intervals(means, variances, truth.mean, truth.variance, 16, light))


@pytest.mark.slow
def test_errors_of_derivatives_are_honest(engine: Engine) -> None:
    truth = engine.jacobian(TISSUE, VIEW, NAMES, samples=TRUTH_SAMPLES, seed=9100, batches=16)
    runs = [engine.jacobian(TISSUE, VIEW, NAMES, samples=SAMPLES, seed=9101 + seed) for seed in range(SEEDS)]
    entries = len(NAMES) * len(LIGHTS_MM)
    means, variances, true_mean, true_variance = (
        np.reshape(table, (*np.shape(table)[:-3], entries, len(VIEW)))
        for table in (
            [run.jacobian for run in runs],
            [run.jacobian_variance for run in runs],
            truth.jacobian,
            truth.jacobian_variance,
        )
    )
    entry = np.random.default_rng(2).integers(entries, size=(SEEDS, len(VIEW)))
    found = intervals(means, variances, true_mean, true_variance, 4, entry)
    require_honest(found)
    # Each parameter has some 400 intervals; a correct one covers less than 90 % once in 70,000 runs.
    held, name = found.covered(), (entry // len(LIGHTS_MM)).ravel()
    assert {NAMES[k]: held[name == k].mean() for k in range(len(NAMES)) if held[name == k].mean() < 0.9} == {}


def test_an_error_asked_for_is_the_error_there_is(engine: Engine) -> None:
    asked = 0.1
    # The truth's own square error is subtracted, so a quarter of the paths is enough.
    truth = engine.images(TISSUE, VIEW, samples=TRUTH_SAMPLES // 4, seed=9200)
    runs = [engine.images(TISSUE, VIEW, rel_error=asked, seed=9201 + seed) for seed in range(12)]
    assert all(run.complete and run.rel_error <= asked and run.samples > 64 for run in runs)
    # Twelve images of 36 independent pixels give the mean square error to 7 % if the lights of a pixel are fully
    # correlated, and to 3 % if they are independent. The bounds are four times the former.
    squares = [np.sum((run.mean - truth.mean) ** 2) for run in runs]
    reached = (np.mean(squares) - truth.variance.sum()) / np.sum(truth.mean**2)
    assert 0.72 <= reached / np.mean([run.rel_error**2 for run in runs]) <= 1.28


def test_an_error_asked_of_derivatives_holds_for_each(engine: Engine) -> None:
    found = engine.jacobian(TISSUE, VIEW, NAMES[:3], rel_error=0.4, seed=9300)
    assert found.complete
    for mean, variance in ((found.mean, found.variance), *zip(found.jacobian, found.jacobian_variance, strict=True)):
        assert np.sqrt(variance.sum()) <= 0.4 * np.linalg.norm(mean)
    more = engine.jacobian(TISSUE, VIEW, NAMES[:3], rel_error=0.2, seed=9300)
    assert more.samples > 2 * found.samples


def test_a_limit_gives_the_result_as_it_stands(engine: Engine) -> None:
    few = engine.images(TISSUE, VIEW, rel_error=0.01, seed=9400, max_samples=200)
    assert not few.complete
    assert few.samples == 192
    assert few.rel_error > 0.01
    hurried = engine.images(TISSUE, VIEW, rel_error=0.01, seed=9400, max_seconds=0)
    assert not hurried.complete
    # The first round traces the same paths as a call with that number of samples.
    plain = engine.images(TISSUE, VIEW, samples=hurried.samples, seed=9400)
    np.testing.assert_array_equal(hurried.mean, plain.mean)
    assert plain.complete


def test_what_an_error_took_repeats_to_the_bit(engine: Engine) -> None:
    first, second = (engine.images(TISSUE, VIEW, rel_error=0.1, seed=9500) for _ in range(2))
    assert first.samples == second.samples
    np.testing.assert_array_equal(first.mean, second.mean)
    np.testing.assert_array_equal(first.variance, second.variance)


def test_a_dark_image_is_as_sure_as_it_gets(engine: Engine) -> None:
    beside = whole_view(camera_at((0.2, 1, 0.1), size=64, span_mm=36.0))
    corner = type(beside)(beside.camera, beside.pixels[:4])
    dark = engine.images(TISSUE, corner, rel_error=0.01, seed=9600)
    assert dark.complete
    assert not dark.mean.any()


@pytest.mark.parametrize(
    ("asked", "named"),
    [
        ({}, ("samples = None", "rel_error = None", "exactly one")),
        ({"samples": 16, "rel_error": 0.01}, ("samples = 16", "rel_error = 0.01", "exactly one")),
        ({"rel_error": 0.0}, ("rel_error = 0 ",)),
        ({"rel_error": float("nan")}, ("rel_error = nan",)),
        ({"rel_error": 1.0}, ("rel_error = 1 ",)),
        ({"rel_error": 0.01, "batches": 1}, ("batches = 1",)),
        ({"rel_error": 0.01, "max_seconds": -1.0}, ("max_seconds = -1",)),
        ({"rel_error": 0.01, "max_seconds": float("nan")}, ("max_seconds = nan",)),
        ({"rel_error": 0.01, "max_samples": 3}, ("max_samples = 3",)),
    ],
)
def test_what_cannot_be_reached_is_refused(
    engine: Engine, monkeypatch: pytest.MonkeyPatch, asked: dict[str, Any], named: tuple[str, ...]
) -> None:
    from services.transport.paths.walk import Walk

    monkeypatch.setattr(Walk, "run", lambda *_: pytest.fail("a kernel was started"))
    for call in (
        lambda: engine.images(TISSUE, VIEW, seed=1, **asked),
        lambda: engine.jacobian(TISSUE, VIEW, NAMES, seed=1, **asked),
    ):
        with pytest.raises(InputError) as caught:
            call()
        message = caught.value.message
        assert all(part in message for part in named)
        assert message.endswith(".")
        assert message.count(". ") == 0
