"""The jaw benchmark: parameters become the mouth they describe, errors are relative to the truth, and each row is kept
as soon as it is there.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import pytest

from services.bench.fits.jaw import ErrorRecorder, mouth_of, picture, relative_errors
from services.fit.passes.evaluate import ErrorSums
from services.transport.optics.parameters import MEDIUM_FIELDS, Medium, Mouth, Tissue

TRUTH = Mouth(
    (Tissue(Medium(4.0, 0.99, g1=0.8), Medium(12.0, 0.98, g1=0.75)), Tissue(Medium(5.0, 0.98), Medium(5.0, 0.98))),
    Medium(7.0, 0.95, g1=0.8),
    0.4,
)


def parameters(mouth: Mouth, parts: tuple[str, ...]) -> dict[str, float]:
    """The parameters of a mouth as a fit reports them, including derived ones."""
    values = {
        f"{part}.{leaf}": float(getattr(mouth.medium(part), leaf))
        for part in parts
        for leaf in (*MEDIUM_FIELDS, "sigma_s_reduced")
    }
    return values | {"cavity.reflectance": mouth.value("cavity.reflectance")}


def test_a_fits_parameters_are_a_mouth() -> None:
    # The second tooth has no dentin.
    assert mouth_of(parameters(TRUTH, ("0.enamel", "0.dentin", "1.enamel", "gums")), TRUTH) == TRUTH


def test_errors_are_relative_and_those_of_absorption() -> None:
    true = Tissue(Medium(4.0, 0.99), Medium(10.0, 0.95))
    found = Tissue(Medium(4.4, 0.99), Medium(10.0, 0.96))
    off = relative_errors(found, true)
    assert off["enamel.sigma_s_reduced"] == pytest.approx(0.1)
    assert off["enamel.alpha_reduced"] == pytest.approx(0.0)
    # With g = 0 alpha' is alpha.
    assert off["dentin.alpha_reduced"] == pytest.approx(-0.2)


@dataclass(frozen=True)
class FixedErrors:
    """Replaces a prepared jaw: the same errors for every solver."""

    observations: Any

    def errors(self, mouth: Mouth, *, samples: int, seed: int) -> tuple[ErrorSums, ErrorSums]:  # noqa: ARG002
        return ErrorSums(0.04, 1.0, 0.0, 1e-12), ErrorSums(0.09, 1.0, 0.0, 1e-12)


def test_rows_are_kept_and_drawn() -> None:
    kept: list[list[dict[str, Any]]] = []
    teeth = SimpleNamespace(teeth=tuple(SimpleNamespace(fdi=fdi) for fdi in (11, 12)))
    recorder = ErrorRecorder(FixedErrors(teeth), TRUTH, kept.append, samples=16)  # type: ignore[arg-type]  # a stand-in
    moved = TRUTH.with_values({"0.enamel.sigma": 5.0})
    for seconds, stage in ((1.0, "start.0"), (2.0, "joint"), (3.0, "joint"), (4.0, "final")):
        recorder.record(seconds, moved, stage, step=int(seconds))
    assert [len(rows) for rows in kept] == [1, 2, 3, 4]
    row = recorder.rows[-1]
    assert (row.error, row.fitted_error) == pytest.approx((0.3, 0.2))
    assert row.off["11"]["enamel.sigma_s_reduced"] == pytest.approx(0.25)
    assert row.off["12"]["enamel.sigma_s_reduced"] == 0.0
    images, media = picture(kept[-1]).axes
    assert [label.get_text() for label in images.texts] == ["start.0", "joint", "final"]
    assert len(media.get_lines()) == 4
