"""Plots of benchmarks: every point is in its panel, the ratio is beside the peer's name, and a missing drawing library
costs only the plot.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any

import numpy as np
import pytest

import services.cli.bench as command
from services.bench import Row
from services.bench.plots import error_against_time, write_png
from services.bench.transport.lights import LightsRow, picture, spread_lights

ROWS: list[dict[str, Any]] = [
    Row(benchmark="race", peer="dentine", seconds=1.0, error=0.1).model_dump(),
    Row(benchmark="race", peer="dentine", seconds=4.0, error=0.05).model_dump(),
    Row(benchmark="race", peer="another", seconds=2.0, error=0.5).model_dump(),
    Row(benchmark="race-summary", peer="another", seconds=2.0, error=0.5, efficiency_ratio=50.0).model_dump(),
    Row(benchmark="hurdles", peer="dentine", seconds=3.0, error=0.2).model_dump(),
]


def points(axes: Any) -> dict[str, list[tuple[float, float]]]:
    """The points of lines with markers, by label."""
    return {
        line.get_label(): sorted(map(tuple, line.get_xydata().tolist()))
        for line in axes.get_lines()
        if line.get_marker() == "o"
    }


def test_everyone_measured_is_in_the_picture() -> None:
    race, hurdles = error_against_time(ROWS).axes
    assert points(race) == {
        "dentine": [(1.0, 0.1), (4.0, 0.05)],
        "another, 50 times our cost": [(2.0, 0.5), (2.0, 0.5)],
    }
    assert points(hurdles) == {"dentine": [(3.0, 0.2)]}
    assert race.get_xscale() == race.get_yscale() == "log"


def test_lines_follow_equal_efficiency() -> None:
    race, _ = error_against_time(ROWS).axes
    dashed = [np.asarray(line.get_xydata()) for line in race.get_lines() if line.get_linestyle() == "--"]
    assert len(dashed) == 2
    for line in dashed:
        efficiencies = line[:, 0] * line[:, 1] ** 2
        assert efficiencies[0] == pytest.approx(efficiencies[1])
    assert dashed[0][0].tolist() == pytest.approx([1.0, 0.1])


def test_lights_and_pixels_have_panels_of_their_own(tmp_path: Path) -> None:
    def row(
        benchmark: str, lights: int, pixels: int, seconds: float, cost: float | None, peer: str = "dentine"
    ) -> dict[str, Any]:
        return LightsRow(
            benchmark=benchmark, peer=peer, seconds=seconds, error=0.1, lights=lights, pixels=pixels, samples=8,
            seconds_per_path=0.1, relative_cost=cost
        ).model_dump()  # fmt: skip

    rows = [row("transport-lights", lights, 10, lights**0.5, lights**0.5) for lights in (1, 4, 9)]
    rows += [row("transport-pixels", 54, pixels, pixels / 10, None) for pixels in (10, 20)]
    figure = picture(rows)
    errors, by_lights, by_pixels = figure.axes
    assert len(points(errors)) == 3
    assert points(by_lights)["variance x time"] == [(1, 1), (4, 2), (9, 3)]
    assert sorted(*points(by_pixels).values()) == [(10, 1), (20, 2)]
    write_png(figure, tmp_path / "lights.png")
    assert (tmp_path / "lights.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("count", [1, 6, 54, 155])
def test_chosen_lights_are_different_lights_of_the_dome(count: int) -> None:
    chosen = spread_lights(count)
    assert len(set(chosen)) == count
    assert set(chosen) <= set(range(155))


@pytest.fixture
def toy_benchmark(monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("toy_benchmark")
    vars(module)["run"] = lambda **options: ROWS if options == {"quick": False} else None
    monkeypatch.setitem(sys.modules, "toy_benchmark", module)
    monkeypatch.setattr(command, "_BENCHMARKS", MappingProxyType({"toy": "toy_benchmark:run"}))


def test_the_picture_lies_beside_the_rows(toy_benchmark: None, tmp_path: Path) -> None:
    command.bench("toy", tmp_path / "one.json")
    command.bench("all", tmp_path / "every.json")
    assert json.loads((tmp_path / "one.json").read_text()) == ROWS
    assert {path.name for path in tmp_path.glob("*.png")} == {"one.png", "every-toy.png"}


def test_without_a_drawing_library_the_rows_are_still_written(
    toy_benchmark: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delitem(sys.modules, "services.bench.plots")
    monkeypatch.setitem(sys.modules, "matplotlib.axes", None)
    command.bench("toy", tmp_path / "one.json")
    assert json.loads((tmp_path / "one.json").read_text()) == ROWS
    assert not (tmp_path / "one.png").exists()
    assert "pip install '.[bench]'" in capsys.readouterr().err
