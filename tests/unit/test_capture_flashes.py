"""A dome flashes at most three times in any second, or as often as a person has acknowledged, on an injected clock."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from services.capture.dome.flashes import Flashes
from services.capture.plan import plan_capture, preflight_frames, shortest_s, told_of_time
from services.core.errors import JobCancelledError, SettingsError
from services.core.light.safety import FlashAcknowledgement
from services.core.records import RigSpec
from tests.support.flashing_plans import captured, flashes_of_random_work
from tests.support.model_dome import Clock, Controller, ModelDome, most_in_a_second

NOON = datetime(2026, 11, 28, 12, tzinfo=UTC)


def acknowledged(**options: Any) -> FlashAcknowledgement:
    stated = {"per_s": 10.0, "eye_cover": True, "epilepsy_asked": True, "by": "B. Roe", "at": NOON}
    return FlashAcknowledgement.model_validate(stated | options)


def test_random_plans_and_light_by_hand_never_flash_more_than_three_times_in_a_second() -> None:
    worst, total = 0, 0
    for seed in range(150):
        times_s = flashes_of_random_work(seed)
        worst, total = max(worst, most_in_a_second(times_s)), total + len(times_s)
    assert worst == 3, "three a second are reached, so the limit is what kept more away"
    assert total > 1500


def test_flashes_are_evenly_spaced_and_a_driver_waits_a_second_before_its_first() -> None:
    clock = Clock()
    controller = Controller(4, clock)
    starts_s = []
    for _ in range(2):
        starts_s.append(clock())
        with ModelDome(controller, Flashes(clock=clock)) as dome:
            for light in (0, 1, 2):
                dome.light(light, 0.5, 0.001)
                dome.dark()
    first, *_, last = controller.flashes_s[:3]
    assert (first - starts_s[0], controller.flashes_s[3] - starts_s[1]) == pytest.approx((1.0, 1.0))
    assert last - first == pytest.approx(2 * 1.01 / 3)


def test_a_light_that_must_wait_for_another_waits_in_the_dark() -> None:
    clock = Clock()
    controller = Controller(4, clock)
    with ModelDome(controller, Flashes(clock=clock)) as dome:
        dome.light(0, 0.5, 0.1)
        seen: list[bool] = []
        wait = dome.pause

        def look(seconds: float) -> None:
            seen.append(any(controller.model.outputs()))
            wait(seconds)

        dome.pause = look  # type: ignore[method-assign]
        dome.light(1, 0.5, 0.1)
        assert seen == [False]
        dome.pause(5.0)
        dome.light(2, 0.5, 0.1)
        assert seen == [False, True], "a light that need not wait follows without a pause"


def test_an_interruption_ends_the_wait_for_a_flash() -> None:
    clock = Clock()
    controller = Controller(4, clock)
    with ModelDome(controller, Flashes(clock=clock)) as dome:
        wait = dome.pause

        def cancel(seconds: float) -> None:
            dome.interrupt(JobCancelledError("The job was cancelled."))
            wait(seconds)

        dome.pause = cancel  # type: ignore[method-assign]
        with pytest.raises(JobCancelledError):
            dome.light(0, 0.5, 0.1)
    assert controller.flashes_s == []


def test_an_acknowledged_rate_is_kept_as_well() -> None:
    def flashes(clock: Clock) -> Flashes:
        return Flashes(acknowledged(per_s=5.0), clock=clock, now=lambda: NOON)

    assert max(most_in_a_second(flashes_of_random_work(seed, flashes)) for seed in range(20)) == 5


@pytest.mark.parametrize("per_s", [4.0, 10.0])
def test_an_acknowledged_plan_reaches_its_rate_and_no_more(per_s: float) -> None:
    clock = Clock()
    controller = Controller(12, clock)
    stated = acknowledged(per_s=per_s)
    captured(controller, RigSpec(mouth=Path("m"), exposure_s=0.01), Flashes(stated, clock=clock, now=lambda: NOON))
    assert most_in_a_second(controller.flashes_s) == per_s


@pytest.mark.parametrize(
    ("after", "named"),
    [(timedelta(hours=24, seconds=1), "more than 24 hours ago"), (timedelta(minutes=-6), "in the future")],
)
def test_an_acknowledgement_of_another_day_lights_nothing(after: timedelta, named: str) -> None:
    controller = Controller(4, Clock())
    flashes = Flashes(acknowledged(), clock=controller.clock, now=lambda: NOON + after)
    with ModelDome(controller, flashes) as dome, pytest.raises(SettingsError, match=named):
        dome.light(0, 0.5, 0.1)
    assert controller.flashes_s == []


def test_an_acknowledgement_holds_for_a_plan_that_began_within_its_day() -> None:
    controller, now = Controller(4, Clock()), [NOON + timedelta(hours=23, minutes=59)]
    with ModelDome(controller, Flashes(acknowledged(), clock=controller.clock, now=lambda: now[0])) as dome:
        dome.light(0, 0.5, 0.1)
        now[0] += timedelta(hours=1)
        dome.light(1, 0.5, 0.1)
    assert len(controller.flashes_s) == 2


def test_the_time_of_54_lights_is_told_before_the_first() -> None:
    plan = plan_capture(RigSpec(mouth=Path("m"), exposure_s=0.05), 54)
    clock = Clock()
    controller = Controller(54, clock)
    captured(controller, RigSpec(mouth=Path("m"), exposure_s=0.05), Flashes(clock=clock))
    told_s = sum(shortest_s(frames, Flashes().interval_s) for frames in (preflight_frames(plan), plan))
    # 55 + 64 flashes, three a second; the rest of the time is the first second and the black frames.
    assert told_s == pytest.approx(119 * 1.01 / 3, abs=0.2)
    assert clock() == pytest.approx(told_s, abs=1.5)
    assert told_of_time(plan, Flashes().interval_s) == (
        "The preflight takes at least 19 s at one light every 0.34 s, the capture 22 s more."
    )
    assert shortest_s(plan, Flashes.of_no_real_light().interval_s) < 4, "a simulated dome is not waited for"


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"per_s": 3.0}, "leave 'flashes' out"),
        ({"per_s": True}, "number"),
        ({"per_s": "10"}, "number"),
        ({"eye_cover": False}, "leave 'flashes' out for three a second"),
        ({"epilepsy_asked": 1}, "leave 'flashes' out for three a second"),
        ({"by": " "}, "at least 1 character"),
        ({"at": "2026-11-28T12:00:00"}, "timezone"),
        ({"more": 1}, "Extra"),
    ],
)
def test_an_acknowledgement_is_whole_or_refused(options: dict[str, Any], named: str) -> None:
    with pytest.raises(ValidationError, match=named):
        acknowledged(**options)
    for name in FlashAcknowledgement.model_fields:
        stated = acknowledged().model_dump()
        del stated[name]
        with pytest.raises(ValidationError, match="required"):
            FlashAcknowledgement.model_validate(stated)


def test_an_attempt_needs_an_acknowledgement_of_its_own() -> None:
    acknowledged().require_newer(())
    for stale in (NOON, NOON - timedelta(hours=1)):
        with pytest.raises(SettingsError, match=r"ask the subject again and give rig\.flashes with the new time"):
            acknowledged(at=stale).require_newer((acknowledged(),))
    acknowledged(at=NOON + timedelta(seconds=1)).require_newer((acknowledged(),))
