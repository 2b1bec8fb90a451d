"""The race of tooth fits: ratios compare times to the same error, bounds are marked as bounds, and each row is kept as
soon as it is there.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import pytest

from services.bench.fits.tooth import PEER, ErrorRecorder, ToothRow, picture, summary
from services.bench.fits.tooth_capture import tissue_of
from services.fit.passes.evaluate import ErrorSums
from services.transport.optics.parameters import Medium, Tissue


def row(peer: str, seconds: float, error: float, rate: float | None = None, error_se: float = 0.001) -> ToothRow:
    return ToothRow(
        benchmark="tooth", peer=peer, seconds=seconds, error=error, error_se=error_se, fitted_error=error, stage="",
        parameters={}, rate=rate
    )  # fmt: skip


OURS = [row("dentine", 2.0, 0.2), row("dentine", 5.0, 0.03), row("dentine", 9.0, 0.02)]


def test_ratio_is_of_the_first_times_at_the_target() -> None:
    peer = [row(PEER, 10.0, 0.3), row(PEER, 100.0, 0.029), row(PEER, 200.0, 0.021)]
    found = summary(OURS, peer, target=0.03)
    assert (found.efficiency_ratio, found.lower_bound, found.seconds) == (100.0 / 5.0, False, 100.0)
    assert found.benchmark == "tooth-summary"


def test_peer_that_never_gets_there_has_a_lower_bound() -> None:
    found = summary(OURS, [row(PEER, 10.0, 0.3), row(PEER, 90.0, 0.1)], target=0.022)
    assert (found.efficiency_ratio, found.lower_bound) == (90.0 / 9.0, True)


def test_ratio_at_the_error_that_the_peer_ended_with_is_no_bound() -> None:
    peer = [row(PEER, 10.0, 0.3), row(PEER, 80.0, 0.1), row(PEER, 90.0, 0.1)]
    found = summary(OURS, peer, peer[-1].error, "tooth-at-its-end")
    assert (found.benchmark, found.efficiency_ratio, found.lower_bound) == ("tooth-at-its-end", 80.0 / 5.0, False)


def test_our_time_ends_when_no_later_start_is_worse() -> None:
    ours = [
        row("dentine", 2.0, 0.02),
        row("dentine", 5.0, 0.2),
        row("dentine", 9.0, 0.0225),
        row("dentine", 12.0, 0.02),
    ]
    assert summary(ours, [row(PEER, 90.0, 0.02)], target=0.022).efficiency_ratio == 90.0 / 9.0


def test_a_level_that_a_peer_touches_and_leaves_is_not_reached() -> None:
    peer = [row(PEER, 10.0, 0.02), row(PEER, 50.0, 0.2), row(PEER, 90.0, 0.1)]
    found = summary(OURS, peer, target=0.03)
    assert (found.efficiency_ratio, found.lower_bound) == (90.0 / 5.0, True)


def test_a_race_between_errors_known_too_roughly_decides_nothing() -> None:
    peer = [row(PEER, 10.0, 0.3), row(PEER, 90.0, 0.049, error_se=0.037)]
    found = summary(OURS, peer, target=0.05)
    assert found.efficiency_ratio is None
    assert found.undecided.startswith("This race decides nothing: its errors are known to 3.7 %, and a level of 5.0 %")
    label = picture([one.model_dump() for one in (*OURS, *peer, found)]).axes[0].get_lines()[1].get_label()
    assert label == f"{PEER}, undecided"


def test_a_peer_that_is_clearly_above_the_level_has_a_bound_however_roughly_it_is_known() -> None:
    found = summary(OURS, [row(PEER, 90.0, 0.6, error_se=0.03)], target=0.03)
    assert (found.efficiency_ratio, found.lower_bound, found.undecided) == (90.0 / 5.0, True, "")


def test_picture_shows_every_rate_and_the_bound() -> None:
    peers = [
        row(PEER, 10.0, 0.3, 0.02),
        row(PEER, 50.0, 0.3, 0.02),
        row(PEER, 10.0, 0.4, 0.05),
        row(PEER, 90.0, 0.1, 0.05),
    ]
    rows = [*OURS, *peers, summary(OURS, peers[2:], target=0.022)]
    axes: Any = picture([one.model_dump() for one in rows]).axes[0]
    labels = {line.get_label(): len(line.get_xydata()) for line in axes.get_lines()}
    assert labels == {"dentine": 3, f"{PEER}, rate 0.02": 2, f"{PEER}, rate 0.05, over 10 times our time": 2}


@dataclass(frozen=True)
class FixedErrors:
    """Replaces a prepared tooth: the same errors for every solver."""

    truth = MappingProxyType({"enamel.sigma_s_reduced": 1.8, "dentin.sigma_s_reduced": 7.84})

    def errors(self, tissue: Tissue, *, samples: int, seed: int) -> tuple[ErrorSums, ErrorSums]:  # noqa: ARG002
        return ErrorSums(0.04, 1.0, 0.0, 1e-12), ErrorSums(0.09, 1.0, 0.0, 1e-12)


def test_rows_are_kept_as_they_come() -> None:
    kept: list[list[dict[str, Any]]] = []
    recorder = ErrorRecorder(FixedErrors(), kept.append, samples=16)  # type: ignore[arg-type]  # a stand-in
    tissue = Tissue(Medium(4.0, 0.99, g1=0.5), Medium(8.0, 0.98))
    recorder.record("dentine", 1.0, tissue, "start")
    recorder.record("dentine", 2.0, tissue, "final")
    assert [len(rows) for rows in kept] == [1, 2]
    assert kept[1][1]["error"] == pytest.approx(0.3)
    assert kept[1][1]["fitted_error"] == pytest.approx(0.2)
    assert kept[1][1]["parameters"]["enamel.sigma_s_reduced"] == pytest.approx(0.5 * 0.99 * 4)
    assert kept[1][1]["parameter_error"] == pytest.approx(0.1)


def test_tissue_of_reported_parameters() -> None:
    values = {"sigma": 4.0, "alpha": 0.99, "beta": 0.9, "g1": 0.8, "g2": -0.1}
    enamel = {f"enamel.{leaf}": value for leaf, value in values.items()}
    dentin = {f"dentin.{leaf}": 0.5 * value for leaf, value in values.items()}
    assert tissue_of(enamel) == Tissue(Medium(4.0, 0.99, 0.9, 0.8, -0.1), Medium(4.0, 0.99, 0.9, 0.8, -0.1))
    assert tissue_of(enamel | dentin | {"shape.1": 0.2, "shape.0": 0.1}) == Tissue(
        Medium(4.0, 0.99, 0.9, 0.8, -0.1), Medium(2.0, 0.495, 0.45, 0.4, -0.05), (0.1, 0.2)
    )
