"""The verdict on a slab's wavelengths, and what it advises where one of them went wrong."""

from __future__ import annotations

import numpy as np
import pytest

from services.slab.results.result import Errors, SlabReport, image_error
from tests.support.small_slab import made_up_fit

FAR, NEAR = 2.5, 0.01
"""Held-out errors of a fit unlike its images, and of one like them."""


@pytest.mark.parametrize(
    ("converged", "held_out_error", "advice"),
    [
        (True, NEAR, ""),
        (False, NEAR, "The fit at 635 nm has not converged; raise option effort."),
        (True, FAR, "No material gives such images at 635 nm; compare slab.json with the set-up"),
        (False, FAR, "The fit at 635 nm ended far from its images without converging. Fit again with a greater option"),
    ],
)
def test_advice_blames_the_folder_where_the_search_did_not_fail(
    converged: bool, held_out_error: float, advice: str
) -> None:
    errors = Errors(fit_error=0.0, held_out_error=held_out_error)
    other = made_up_fit(635.0).model_copy(update={"converged": converged, "errors": errors})
    verdict = SlabReport(fits=(made_up_fit(), other)).verdict()
    assert verdict.converged == (converged and held_out_error == NEAR)
    assert verdict.advice.startswith(advice)
    assert bool(verdict.advice) == bool(advice)
    assert ("compare slab.json" in verdict.advice) == (held_out_error == FAR)


@pytest.mark.parametrize("true", [0.0, 0.004, 0.02])
def test_an_error_of_images_has_a_standard_error(true: float) -> None:
    """400 images of 300 pixels with 5 % of noise, and renders with 1 % whose own error is ``true`` everywhere."""
    draws, pixels, noise, of_render = 400, 300, 0.05, 0.01
    rng = np.random.default_rng(3)
    values = 1 + noise * rng.standard_normal((draws, pixels))
    first, second = (1 + true + of_render * rng.standard_normal((draws, pixels)) for _ in range(2))
    found = [image_error(*one, np.full(pixels, noise**2)) for one in zip(first, second, values, strict=True)]
    value = np.array([one.value for one in found])
    upper = value + np.array([one.se for one in found])
    # Variance of the product of two sums of normal numbers: twice the noise of the image is common to both.
    variance = 2 * noise**4 + 2 * (noise * of_render) ** 2 + of_render**4
    variance += 2 * true**2 * (2 * noise**2 + of_render**2)
    # 400 means of the scatter of 300 terms know it to 1 %; the mean root of a noisy variance is 2 % low.
    assert (upper**2 - value**2).mean() == pytest.approx(np.sqrt(variance / pixels), rel=0.05)


def test_the_verdict_has_the_errors_standard_error() -> None:
    errors = Errors(fit_error=0.0, fit_error_se=0.002, held_out_error=0.005, held_out_error_se=0.003)
    verdict = SlabReport(fits=(made_up_fit().model_copy(update={"errors": errors}),)).verdict()
    assert verdict.headline == "Converged after 1 steps: held-out error 0.50 ± 0.30 %."
