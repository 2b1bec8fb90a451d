"""The race of tooth fits: a level counts when it is kept and surely reached; what is not decided is told in words."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.bench.fits.race import Measured, Span, best, time_to, verdict
from services.bench.fits.race_floor import HELD_OUT, QUANTITIES, Measurements, bound, pair_product, quantities
from services.bench.fits.race_rows import ALL, LEVELS, WORDS, LevelRow, level_rows, off, point_rows, sentences, table
from services.bench.fits.race_runs import (
    OURS,
    FloorRecord,
    ImageErrors,
    Point,
    RaceState,
    Run,
    Settings,
    is_known,
    logged,
    media_of,
)
from services.bench.fits.stock_fit import TEETH_2018, TUTORIAL
from services.bench.fits.tooth import picture
from services.bench.fits.tooth_capture import tissue_of, true_tissue
from services.core.errors import InputError
from services.transport.optics.parameters import Medium, Tissue

TRUTH = Tissue(Medium(4.5, 0.997, 0.93, 0.82, -0.1), Medium(12.0, 0.9945, g1=0.75))
PEER = TUTORIAL.name


def errors(*values: float, se: float = 0.0) -> list[Measured]:
    """A run with an error after every ten seconds."""
    return [Measured(10.0 * (k + 1), value, se) for k, value in enumerate(values)]


def test_a_level_that_is_touched_and_left_is_not_reached() -> None:
    assert time_to(0.05, errors(0.3, 0.04, 0.2, 0.1), has_ended=True) == Span(40.0, None)


def test_a_level_counts_from_where_it_is_kept() -> None:
    assert time_to(0.05, errors(0.3, 0.04, 0.2, 0.04, 0.05), has_ended=True) == Span(30.0, 40.0)


def test_a_level_that_the_first_iterate_keeps_has_no_time_before_it() -> None:
    assert time_to(0.05, errors(0.01, 0.02), has_ended=True) == Span(0.0, 10.0)


def test_a_run_that_was_stopped_must_keep_a_level_through_its_last_fifth() -> None:
    # Ten iterates: the last fifth begins after 80 s.
    for first, by_s in ((8, None), (7, 80.0)):
        run = errors(*[0.3] * first, *[0.01] * (10 - first))
        assert time_to(0.05, run, has_ended=False).by_s == by_s
        assert time_to(0.05, run, has_ended=True).by_s == 10.0 * (first + 1)


def test_an_error_known_to_more_than_a_third_of_a_level_does_not_reach_it() -> None:
    # 4.9 ± 3.7 % touches 5 % by chance, and is not surely above it either.
    assert time_to(0.05, [Measured(10.0, 0.4), Measured(90.0, 0.049, 0.037)], has_ended=True) == Span(10.0, None)
    # 0 ± 2 % lies two standard errors below 5 %, but is known to two fifths of it.
    assert not Measured(1.0, 0.0, 0.02).is_below(0.05)
    assert Measured(1.0, 0.0, 0.016).is_below(0.05)


def test_an_error_near_a_level_leaves_a_span_of_times() -> None:
    run = [Measured(10.0, 0.3, 0.01), Measured(20.0, 0.055, 0.005), Measured(30.0, 0.03, 0.005)]
    assert time_to(0.05, run, has_ended=True) == Span(10.0, 30.0)


def test_a_solver_with_several_rates_takes_the_earliest_times() -> None:
    assert best([Span(90.0, None), Span(30.0, 40.0), Span(20.0, 60.0)]) == Span(20.0, 40.0)
    assert best([Span(90.0, None), Span(70.0, None)]) == Span(70.0, None)


def test_the_ratio_has_the_limits_of_both_spans() -> None:
    found = verdict(0.05, 0.01, Span(8.0, 10.0), Span(50.0, 80.0))
    assert (found.lowest, found.highest) == (5.0, 10.0)
    assert found.sentence == "dentine is 5 to 10 times as fast"


def test_a_peer_that_does_not_reach_the_level_gives_a_lower_bound() -> None:
    found = verdict(0.05, 0.01, Span(8.0, 10.0), Span(300.0, None))
    assert (found.lowest, found.highest) == (30.0, None)
    assert found.sentence == "dentine is over 30 times as fast"


def test_a_faster_peer_is_called_faster() -> None:
    found = verdict(0.05, 0.01, Span(50.0, 80.0), Span(8.0, 10.0))
    assert (found.lowest, found.highest) == (0.1, 0.2)
    assert found.sentence == "the other is at least 5 times as fast"


@pytest.mark.parametrize(
    ("floor", "ours", "other", "why"),
    [
        (0.02, Span(8.0, 10.0), Span(50.0, 80.0), "the photographs allow an error of 2 %"),
        (0.01, Span(8.0, 10.0), Span(9.0, 80.0), "overlap"),
        (0.01, Span(8.0, None), Span(90.0, None), "neither"),
        (0.01, Span(8.0, None), Span(50.0, 80.0), "dentine did not"),
        (0.01, Span(8.0, 100.0), Span(90.0, None), "the other was stopped"),
    ],
)
def test_what_cannot_be_told_decides_nothing(floor: float, ours: Span, other: Span, why: str) -> None:
    found = verdict(0.05, floor, ours, other)
    assert not found.is_decided
    assert found.sentence.startswith("decides nothing: ")
    assert why in found.sentence


def test_paths_are_added_until_an_error_is_on_one_side_of_each_level() -> None:
    levels = (0.1, 0.05, 0.03)
    assert is_known(Measured(0.0, 0.3, 0.09), levels)
    assert not is_known(Measured(0.0, 0.3, 0.11), levels)
    assert is_known(Measured(0.0, 0.07, 0.009), levels)
    assert not is_known(Measured(0.0, 0.07, 0.011), levels)


def run_of(peer: str, rate: float | None, media: list[Tissue], seconds: float, held_out: float | None) -> Run:
    points = tuple(
        Point(seconds=seconds * (k + 1), stage="", media=media_of(one)) for k, one in enumerate(media)
    )  # fmt: skip
    image = ImageErrors(point=len(points) - 1, held_out=held_out or 0.0, held_out_se=0.003, fitted=0.1, samples=64)
    return Run(
        peer=peer, rate=rate, points=points, images=() if held_out is None else (image,), is_finished=True,
        has_ended=rate is None,
    )  # fmt: skip


def floor_of(error: float) -> FloorRecord:
    """The same floor for every quantity."""
    names = (*QUANTITIES, HELD_OUT)
    return FloorRecord(floor=dict.fromkeys(names, error), se=dict.fromkeys(names, 0.0))


def test_rows_hold_every_parameter_and_the_image_to_its_levels() -> None:
    # Dentin's extinction 60 % off leaves its scattering and absorption as far off, whatever the images show.
    wrong = TRUTH.with_values({"dentin.sigma": 1.6 * TRUTH.dentin.sigma})
    runs = [
        run_of(OURS, None, [wrong, TRUTH, TRUTH], 10.0, 0.02),
        run_of(PEER, 0.05, [wrong, wrong, wrong], 100.0, 0.02),
    ]
    assert off(wrong, TRUTH) == pytest.approx(
        {
            ALL: 0.6,
            "enamel.sigma_s_reduced": 0,
            "dentin.sigma_s_reduced": 0.6,
            "enamel.sigma_a": 0,
            "dentin.sigma_a": 0.6,
        }
    )
    assert [row.error for row in point_rows(runs, TRUTH)] == pytest.approx([0.6, 0, 0, 0.6, 0.6, 0.6], abs=1e-12)
    floor = FloorRecord(
        floor=dict.fromkeys((*QUANTITIES, HELD_OUT), 0.01), se=dict.fromkeys((*QUANTITIES, HELD_OUT), 0)
    )
    rows = level_rows(runs, TRUTH, floor)
    found = {(row.quantity, row.error, row.peer): row for row in rows if isinstance(row, LevelRow)}
    assert len(found) == 2 * sum(len(levels) for levels in LEVELS.values())
    assert (found["dentin.sigma_s_reduced", 0.05, OURS].after_s, found["dentin.sigma_s_reduced", 0.05, OURS].by_s) == (
        10.0,
        20.0,
    )
    other = found["dentin.sigma_s_reduced", 0.2, PEER]
    assert (other.by_s, other.lowest_ratio) == (None, 300.0 / 20.0)
    assert found[HELD_OUT, 0.03, PEER].by_s is None, "its only image is its last iterate, in the last fifth"
    text = table(rows)
    assert text[0] == f"| error kept, % | floor, % | {OURS} | {PEER} |"
    assert text[2] == "| all four parameters 20/10/5 | 1±0 | 20/20/20 | >300/>300/>300 |"
    assert len(text) == 2 + len(LEVELS)
    assert "dentin σs' to 20 %, mitsuba-prbvolpath-adam: dentine is over 15 times as fast." in sentences(rows)
    assert not sentences(rows)[-1].startswith("This race decides nothing")


def test_a_race_that_decides_nothing_at_all_says_so() -> None:
    runs = [run_of(OURS, None, [TRUTH], 10.0, 0.2), run_of(PEER, 0.05, [TRUTH], 10.0, 0.2)]
    floor = floor_of(0.5)
    assert sentences(level_rows(runs, TRUTH, floor))[-1].startswith("This race decides nothing")


def test_picture_has_a_panel_for_each_quantity_and_a_line_for_each_run() -> None:
    wrong = TRUTH.with_values({"dentin.sigma": 1.6 * TRUTH.dentin.sigma})
    runs = [run_of(OURS, None, [wrong, TRUTH], 10.0, 0.02), run_of(PEER, 0.05, [wrong, wrong], 10.0, 0.2)]
    floor = FloorRecord(
        floor=dict.fromkeys((*QUANTITIES, HELD_OUT), 0.01), se=dict.fromkeys((*QUANTITIES, HELD_OUT), 0)
    )
    rows = [row.model_dump() for row in (*point_rows(runs, TRUTH), *level_rows(runs, TRUTH, floor))]
    figure: Any = picture(rows)
    assert [axes.get_title() for axes in figure.axes] == [WORDS[name] for name in LEVELS]
    labels = {text.get_text() for text in figure.legends[0].get_texts()}
    assert labels == {OURS, f"{PEER}, rate 0.05", "allowed by the photographs' noise"}
    assert picture(rows[:2]).axes, "a race under way has neither levels nor floors yet"


def test_few_iterates_are_compared_and_the_last_one_always_is() -> None:
    run = run_of(PEER, 0.05, [TRUTH] * 100, 3.0, None)
    chosen = logged(run)
    times = [run.points[k].seconds for k in chosen]
    assert chosen[-1] == 99
    assert 5 <= len(chosen) <= 12
    # Rounds of 3 s are the least that can be told apart.
    assert all(1.5 * one <= other < 1.5 * one + 3 * 1.5 + 1e-9 for one, other in pairwise(times))


SETTINGS = Settings(pixel_step=1, rates=(0.05,), limit_s=10.0, max_samples=64, floor_samples=64)


def test_a_race_goes_on_from_what_is_stored(tmp_path: Path) -> None:
    state, fresh = RaceState(tmp_path / "race.state"), Run(peer=PEER, rate=0.05)
    state.open(SETTINGS)
    assert state.stored(fresh) == fresh
    run = run_of(PEER, 0.05, [TRUTH, TRUTH], 1.0, 0.2).model_copy(update={"solver": {"rounds": 2, "seconds": 2.0}})
    state.keep(run)
    RaceState(tmp_path / "race.state").open(SETTINGS)
    assert state.stored(fresh) == run
    floor = state.floor(lambda: ({HELD_OUT: 0.1}, {HELD_OUT: 0.01}))
    assert state.floor(lambda: pytest.fail("measured twice")) == floor


@pytest.mark.parametrize("changed", [{"limit_s": 20.0}, {"numerics": SETTINGS.numerics + 1}])
def test_the_state_of_another_race_is_refused(tmp_path: Path, changed: dict[str, float]) -> None:
    RaceState(tmp_path).open(SETTINGS)
    with pytest.raises(InputError, match="holds the state of another race or version; delete it"):
        RaceState(tmp_path).open(SETTINGS.model_copy(update=changed))


def test_floor_is_that_of_a_linear_fit() -> None:
    # Measurements that depend on the quantities' logarithms alone, with independent columns: the sd of quantity k is
    # sd_noise / |column k|. Noise of the Jacobians enters products of different ones only: six pairs of 1 % noise on
    # 4,000 values change an entry by 0.01^2 sqrt(4,000) / 4,000, far below the tolerance.
    rng = np.random.default_rng(3)
    columns = np.linalg.qr(rng.standard_normal((4000, 4)))[0].T * np.array([2.0, 3.0, 4.0, 5.0])[:, None]
    media = {
        f"{part}.{leaf}": TRUTH.value(f"{part}.{leaf}") for part in ("enamel", "dentin") for leaf in ("sigma", "alpha")
    }
    slopes = np.array(
        [
            [
                (off_by(TRUTH, name, 1e-6)[quantity] / quantities(TRUTH)[quantity] - 1) / (1e-6 * value)
                for name, value in media.items()
            ]
            for quantity in QUANTITIES
        ]
    )
    jacobian = slopes.T @ columns
    noisy = [jacobian * (1 + 0.01 * rng.standard_normal(jacobian.shape)) for _ in range(4)]
    fitted = np.arange(4000) < 4000
    photographs = Measurements(np.ones(4000), np.full(4000, 0.01), fitted, fitted)
    found = bound(noisy, photographs, TRUTH)
    assert found is not None
    assert [found[name] for name in QUANTITIES] == pytest.approx([0.05, 0.1 / 3, 0.025, 0.02], rel=0.02)
    # Four parameters of variance 0.01 over a signal of 4,000 (1 - 0.01).
    assert found[HELD_OUT] == pytest.approx(np.sqrt(4 * 0.01 / (4000 * 0.99)), rel=0.02)
    assert bound([rng.standard_normal((4, 50)) for _ in range(2)], _few(), TRUTH) is None


def _few() -> Measurements:
    chosen = np.ones(50, dtype=bool)
    return Measurements(np.ones(50), np.ones(50), chosen, chosen)


def off_by(tissue: Tissue, name: str, share: float) -> dict[str, float]:
    """Quantities with one parameter changed by a share of itself."""
    return quantities(tissue.with_values({name: (1 + share) * tissue.value(name)}))


def test_pairs_leave_out_what_a_jacobian_has_with_itself() -> None:
    one, other = np.array([[1.0, 2.0]]), np.array([[3.0, -1.0]])
    assert pair_product([one, other], np.ones(2)) == pytest.approx(np.array([[1.0]]))


def test_truths_of_both_forms_are_read() -> None:
    dentin = {"sigma_t": 12.0, "albedo": 0.9945, "g": 0.75}
    enamel = {"sigma_t": 4.5, "albedo": 0.997, "beta": 0.93, "g1": 0.82, "g2": -0.1}
    assert true_tissue({"enamel": enamel, "dentin": dentin}) == TRUTH
    green = {part: {**vars(TRUTH.medium(part)), "sigma_s_reduced": 1.0} for part in ("enamel", "dentin")}
    assert true_tissue({"channels": {"green": green}}) == TRUTH


def test_recipes_say_what_is_free() -> None:
    assert TUTORIAL.names == tuple(
        f"{part}.{leaf}" for part in ("enamel", "dentin") for leaf in ("sigma", "alpha", "g1")
    )
    assert len(TEETH_2018.names) == 10
    assert (TEETH_2018.samples, TUTORIAL.homogeneous_rounds) == (64, 0)


def test_tissue_of_reported_parameters() -> None:
    values = {"sigma": 4.0, "alpha": 0.99, "beta": 0.9, "g1": 0.8, "g2": -0.1}
    enamel = {f"enamel.{leaf}": value for leaf, value in values.items()}
    dentin = {f"dentin.{leaf}": 0.5 * value for leaf, value in values.items()}
    assert tissue_of(enamel) == Tissue(Medium(4.0, 0.99, 0.9, 0.8, -0.1), Medium(4.0, 0.99, 0.9, 0.8, -0.1))
    assert tissue_of(enamel | dentin | {"shape.1": 0.2, "shape.0": 0.1}) == Tissue(
        Medium(4.0, 0.99, 0.9, 0.8, -0.1), Medium(2.0, 0.495, 0.45, 0.4, -0.05), (0.1, 0.2)
    )
