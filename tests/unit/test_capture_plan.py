from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.capture.dome.registers import FULL_SCALE, MAX_LIGHTS
from services.capture.plan import plan_capture, preflight_frames
from services.capture.rig import PlannedRig
from services.core.errors import ExposureLimitError, SettingsError
from services.core.records import RigSpec
from tests.support.mouth import write_mouth

LEVELS = st.floats(0.01, 1.0)


def rig(**options: object) -> RigSpec:
    return RigSpec.model_validate(
        {"mouth": Path("mouth"), "light_exposure_limit_s": 1e9, "total_exposure_limit_s": 1e9} | options
    )


@given(lights=st.integers(1, MAX_LIGHTS), every=st.integers(0, 200), black=st.integers(1, 5), level=LEVELS)
def test_every_plan_keeps_the_order_it_promises(lights: int, every: int, black: int, level: float) -> None:
    frames = plan_capture(rig(tracking_every=every, black_frames=black, level=level), lights)
    kinds = [frame.kind for frame in frames]
    assert [frame.index for frame in frames] == list(range(len(frames)))
    assert [frame.light for frame in frames if frame.kind == "light"] == list(range(lights))
    assert kinds[:black] == ["black"] * black
    assert "black" not in kinds[black:]
    if every == 0:
        assert "tracking" not in kinds
        return
    runs = "".join("T" if kind == "tracking" else "." for kind in kinds[black:])
    assert runs.startswith("T")
    assert runs.endswith("T")
    assert "TT" not in runs
    assert max(len(run) for run in runs.split("T")) <= every


@given(lights=st.integers(1, MAX_LIGHTS), level=LEVELS)
def test_levels_are_whole_register_steps_and_tracking_spreads_one_light_over_all(lights: int, level: float) -> None:
    for frame in plan_capture(rig(level=level), lights):
        assert (frame.level * FULL_SCALE) == pytest.approx(round(frame.level * FULL_SCALE), abs=1e-9)
        wanted = {"black": 0.0, "tracking": level / lights, "light": level}[frame.kind]
        # Rounding to a register moves a level by at most half a step.
        assert abs(frame.level - wanted) <= 0.5 / FULL_SCALE + 1e-12


@given(
    lights=st.integers(1, 60),
    level=LEVELS,
    exposure_s=st.floats(0.001, 2.0),
    settle_s=st.floats(0, 0.1),
    limit_s=st.floats(0.001, 3.0),
)
def test_a_plan_exists_exactly_when_no_light_passes_its_limit(
    lights: int, level: float, exposure_s: float, settle_s: float, limit_s: float
) -> None:
    asked = rig(level=level, exposure_s=exposure_s, settle_s=settle_s, tracking_every=0, light_exposure_limit_s=limit_s)
    dose_s = round(level * FULL_SCALE) / FULL_SCALE * (exposure_s + settle_s)
    if dose_s > limit_s:
        with pytest.raises(ExposureLimitError, match=r"Light 0 would reach .* over its limit"):
            plan_capture(asked, lights)
    else:
        plan_capture(asked, lights)


@given(lights=st.integers(2, 60), margin=st.sampled_from([0.99, 1.01]))
def test_the_total_limit_counts_every_light_and_tracking_frame(lights: int, margin: float) -> None:
    generous = rig(tracking_every=3, level=1.0, exposure_s=0.1, settle_s=0.0)
    total_s = sum(
        frame.level * frame.on_s * (lights if frame.kind == "tracking" else 1)
        for frame in plan_capture(generous, lights)
    )
    limited = generous.model_copy(update={"total_exposure_limit_s": total_s * margin})
    if margin < 1:
        with pytest.raises(ExposureLimitError, match="All lights together"):
            plan_capture(limited, lights)
    else:
        plan_capture(limited, lights)


def test_a_level_below_one_register_step_is_refused() -> None:
    with pytest.raises(SettingsError, match="below one step"):
        plan_capture(rig(level=0.0), 4)


def test_an_exposure_that_the_controller_cannot_time_is_refused() -> None:
    with pytest.raises(SettingsError, match=r"longer than a light may be on at once \(60 s\)"):
        plan_capture(rig(level=0.1, exposure_s=59.0, settle_s=1.1), 4)
    plan_capture(rig(level=0.1, exposure_s=59.0, settle_s=1.0), 4)


@pytest.mark.parametrize(("lights", "every"), [(1, 0), (5, 0), (5, 2)])
def test_a_dose_of_which_the_preflight_leaves_too_little_is_refused_before_any_light(
    lights: int, every: int, tmp_path: Path
) -> None:
    write_mouth(tmp_path, lights)
    generous = rig(mouth=tmp_path, tracking_every=every, level=0.5, exposure_s=0.1, settle_s=0.0)
    plan = PlannedRig.read(generous).plan
    # The last light has the largest dose: without tracking frames, the preflight's whole frame counts for it.
    planned_s, glimpsed_s = (
        sum(frame.level * frame.on_s for frame in frames if frame.light in {lights - 1, None})
        for frames in (plan, preflight_frames(plan))
    )
    with pytest.raises(ExposureLimitError, match="would reach"):
        PlannedRig.read(generous.model_copy(update={"light_exposure_limit_s": planned_s + 0.99 * glimpsed_s}))
    PlannedRig.read(generous.model_copy(update={"light_exposure_limit_s": planned_s + 1.01 * glimpsed_s}))
