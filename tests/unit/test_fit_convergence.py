"""Whether the fits of a job's channels count as converged, and what is said of errors that no noise explains."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from services.fit.passes.evaluate import ErrorSums
from services.fit.solve.outcome import Result
from services.fit.stages.attempt import Assessment, assess_convergence


def fit(error: float, product_noise: float = 0.0) -> Any:
    """A fit of images whose square is 1, with a held-out error."""
    held_out = ErrorSums(error**2, 1.0, 0.0, product_noise)
    solution = SimpleNamespace(result=Result.CONVERGED, advice="")
    return cast(
        "Any",
        SimpleNamespace(
            solution=solution,
            fit_error=0.01,
            held_out_error=error,
            evaluation=SimpleNamespace(fitted=ErrorSums(1e-4, 1.0), held_out=held_out),
        ),
    )


def test_a_small_error_is_not_mentioned() -> None:
    assert assess_convergence({"green": fit(0.045)}) == Assessment(True, False, [])


def test_an_error_of_the_model_makes_a_converged_fit_doubtful() -> None:
    found = assess_convergence({"red": fit(0.02), "green": fit(0.068)})
    assert (found.converged, found.doubtful) == (True, True)
    (told,) = found.advice
    assert told.startswith("green: unseen images are 6.8 % off beside their noise")


def test_an_error_that_the_renders_noise_may_explain_is_not_mentioned() -> None:
    # The standard error of the error is 1 %: that of its square is 2 x 0.068 x 0.01.
    assert assess_convergence({"green": fit(0.068, (2 * 0.068 * 0.01) ** 2)}) == Assessment(True, False, [])


@pytest.mark.parametrize("error", [0.2, 0.35])
def test_a_large_error_is_not_converged_and_said_once(error: float) -> None:
    found = assess_convergence({"green": fit(error)})
    assert (found.converged, found.doubtful) == (False, False)
    (told,) = found.advice
    assert "the images are still" in told


def test_lack_of_samples_is_said_before_anything_else() -> None:
    # 26.5 ± 26.5 %: nothing but noise, above the limit.
    found = assess_convergence({"green": fit(0.0, 0.265**4)})
    assert not found.converged
    (told,) = found.lacking
    assert told.startswith("green: the renders are too noisy to tell how far the images are off (26 ± 26 %); raise")
    assert found.advice == []
    # An error that noise does not explain is the model's or the photographs'.
    found = assess_convergence({"green": fit(0.265, (2 * 0.265 * 0.02) ** 2)})
    assert found.lacking == []
    assert "still 26 % off" in found.advice[0]
