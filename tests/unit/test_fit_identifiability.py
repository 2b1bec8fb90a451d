"""Sentences about what a capture determines: plain words with numbers, and never more than is known."""

from __future__ import annotations

import numpy as np
import pytest

from services.core.results import Correlation, Estimate
from services.fit.checks.identifiability import correlation, determined_sentences
from services.fit.coordinates.domain import Coordinate, Domain
from services.fit.solve.covariance import Uncertainty

NAMES = ("enamel.sigma", "enamel.alpha", "dentin.sigma", "dentin.alpha")


def estimate(value: float, se: float | None, determined: bool = True) -> Estimate:
    return Estimate(value=value, se=se, unit="1/mm", determined=determined)


def table(**changes: Estimate) -> dict[str, Estimate]:
    usual = {"enamel.sigma_s_reduced": estimate(0.9, 0.05), "enamel.sigma_a": estimate(0.01, 0.02, determined=False)}
    return usual | {"dentin.sigma_s_reduced": estimate(2.4, 0.12), "dentin.sigma_a": estimate(0.03, 0.004)} | changes


def correlated(value: float, first: int = 0, second: int = 1) -> Correlation:
    matrix = np.eye(4)
    matrix[first, second] = matrix[second, first] = value
    return Correlation(names=NAMES, matrix=tuple(map(tuple, matrix.tolist())))


def test_known_and_unknown_are_told_with_unit_and_error() -> None:
    text = determined_sentences({"green": table()}, {"green": correlated(0.3)})
    assert (
        text
        == "This capture tells enamel scattering (0.900 ± 0.050 per mm), dentin scattering (2.40 ± 0.12 per mm) and"
        " dentin absorption (0.0300 ± 0.0040 per mm), but not enamel absorption (anything up to 0.05 per mm fits)."
    )


def test_a_large_error_is_not_knowledge() -> None:
    assert "but not enamel absorption or dentin absorption" in determined_sentences(
        {"green": table(**{"dentin.sigma_a": estimate(0.03, 0.02)})}, {}
    ).replace(" (anything up to 0.05 per mm fits)", "")


@pytest.mark.parametrize(
    ("pair", "value", "expected"),
    [
        ((0, 2), -0.95, "More enamel scattering with less dentin scattering"),
        ((1, 3), -0.95, "More enamel absorption with less dentin absorption"),
        ((0, 1), 0.95, "More enamel scattering with less enamel absorption"),
        ((0, 3), -0.95, "More enamel scattering with more dentin absorption"),
    ],
)
def test_what_looks_alike_is_named_with_its_direction(pair: tuple[int, int], value: float, expected: str) -> None:
    # The coordinate of alpha is -log10(1 - alpha): it falls when absorption grows.
    assert f"{expected} would look almost the same." in determined_sentences(
        {"green": table()}, {"green": correlated(value, *pair)}
    )


def test_channels_that_tell_the_same_share_a_sentence() -> None:
    whole = table(**{"enamel.sigma_a": estimate(0.01, 0.001)})
    text = determined_sentences({"red": table(), "green": table(), "blue": whole}, {})
    assert text.count("this capture tells") == 2
    assert text.startswith(
        "In red and green this capture tells enamel scattering (red 0.900 ± 0.050 per mm, green 0.900 ± 0.050 per mm)"
    )
    assert "In blue this capture tells" in text


def test_a_tooth_of_which_nothing_is_known_says_so() -> None:
    nothing = {name: estimate(1.0, None, determined=False) for name in table()}
    assert determined_sentences({"green": nothing}, {}).startswith(
        "This capture does not tell enamel scattering (anything fits)"
    )


def test_correlation_is_that_of_the_covariance() -> None:
    domain = Domain((Coordinate(("enamel.sigma",)), Coordinate(("enamel.alpha",)), Coordinate(("dentin.sigma",))))
    covariance = np.array([[4.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    found = correlation(Uncertainty(domain, np.zeros(3), covariance, np.zeros((3, 0)), np.eye(3)))
    assert found.names == domain.names
    np.testing.assert_allclose(found.matrix, [[1.0, 0.5, 0.0], [0.5, 1.0, 0.0], [0.0, 0.0, 1.0]])
