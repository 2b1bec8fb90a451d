"""Plan of all exposures, made before any light is on by a pure function of the rig and its number of lights.

::

    black ... black | tracking | light 0 ... light k-1 | tracking | light k ... | tracking

A tracking frame has all lights on at 1/lights of the level, so that it is as bright as the mean frame of a single light
and costs no more dose. The subject's motion is measured between tracking frames, because they all have the same light.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal

from pydantic import Field

from services.capture.dome.protocol import ExposureBudget
from services.capture.dome.registers import FULL_SCALE, level_word
from services.core.errors import SettingsError
from services.core.geometry import Record
from services.core.records import MAX_ON_TIME_S, RigSpec

MAX_BLACK_FRAMES = 1000
"""Largest number of black frames; their mean then has 3 % of one frame's noise."""
FLASH_S = 0.005
"""Time for which a preflight switches on each light to check that it emits, seconds."""


class PlannedFrame(Record):
    """One exposure of all cameras."""

    index: int = Field(ge=0, description="number in the plan, from 0")
    kind: Literal["black", "tracking", "light"]
    light: int | None = Field(description="index of the one light that is on; null for black and tracking frames")
    level: float = Field(ge=0, le=1, description="fraction of full scale, a whole number of register steps")
    exposure_s: float = Field(gt=0)
    on_s: float = Field(ge=0, description="planned on-time of the light: settle and exposure")


def plan_capture(rig: RigSpec, lights: int) -> tuple[PlannedFrame, ...]:
    """Plan the frames of one capture, in order.

    Args:
        rig: description of the rig.
        lights: number of lights to capture, indices 0 to lights - 1 of the dome.

    Raises:
        SettingsError: the level is below one register step, an exposure is longer than a light may be on, or there are
            too many black frames. ExposureLimitError: the plan exceeds a dose limit.
    """
    if rig.black_frames > MAX_BLACK_FRAMES:
        raise SettingsError(
            f"rig.black_frames {rig.black_frames} are more than {MAX_BLACK_FRAMES}, which average all noise away;"
            " lower it."
        )
    frames = tuple(_frame(rig, lights, index, light) for index, light in enumerate(_order(rig, lights)))
    require_exposure(frames, lights, rig)
    if (on_s := rig.settle_s + rig.exposure_s) > MAX_ON_TIME_S:
        what = (
            f"rig.exposure_s {rig.exposure_s:g} s with rig.settle_s is longer than a light may be on at once"
            f" ({MAX_ON_TIME_S:g} s)"
        )
        raise SettingsError(f"{what}; shorten it by {on_s - MAX_ON_TIME_S:.3g} s.")
    return frames


def preflight_frames(plan: Sequence[PlannedFrame]) -> tuple[PlannedFrame, ...]:
    """Lit frames of a preflight: each light for ``FLASH_S``, then one whole frame.

    The whole frame is a tracking frame, or the plan's last frame if the plan has no tracking frames.
    """
    flashes = (frame.model_copy(update={"on_s": FLASH_S}) for frame in plan if frame.light is not None)
    return (*flashes, next((frame for frame in plan if frame.kind == "tracking"), plan[-1]))


def shortest_s(frames: Sequence[PlannedFrame], flash_interval_s: float) -> float:
    """Time in s that frames take at least: their exposures, and what their flashes need not to come too often.

    Args:
        flash_interval_s: shortest time in s between two lights.
    """
    return sum(frame.exposure_s if frame.kind == "black" else max(frame.on_s, flash_interval_s) for frame in frames)


def told_of_time(plan: Sequence[PlannedFrame], flash_interval_s: float) -> str:
    """Say how long preflight and capture take at least."""
    first_s, then_s = (shortest_s(frames, flash_interval_s) for frames in (preflight_frames(plan), plan))
    rate = f" at one light every {flash_interval_s:.2f} s" if flash_interval_s else ""
    return f"The preflight takes at least {first_s:.0f} s{rate}, the capture {then_s:.0f} s more."


def require_exposure(frames: Sequence[PlannedFrame], lights: int, rig: RigSpec) -> None:
    """Raise ExposureLimitError if the planned dose exceeds a limit of the rig."""
    budget = ExposureBudget(rig.light_exposure_limit_s, rig.total_exposure_limit_s)
    for frame in frames:
        if frame.kind != "black":
            on = range(lights) if frame.light is None else range(frame.light, frame.light + 1)
            budget.require(on, frame.level, frame.on_s)
            budget.spend(on, frame.level, frame.on_s)


def _order(rig: RigSpec, lights: int) -> Iterator[int | Literal["black", "tracking"]]:
    for _ in range(rig.black_frames):
        yield "black"
    for light in range(lights):
        if rig.tracking_every and light % rig.tracking_every == 0:
            yield "tracking"
        yield light
    if rig.tracking_every:
        yield "tracking"


def _frame(rig: RigSpec, lights: int, index: int, what: int | Literal["black", "tracking"]) -> PlannedFrame:
    kind: Literal["black", "tracking", "light"] = "light" if isinstance(what, int) else what
    level = {"black": 0.0, "tracking": rig.level / lights, "light": rig.level}[kind]
    word = level_word(level)
    if kind != "black" and word == 0:
        raise SettingsError(
            f"rig.level {rig.level:g} is below one step of the dome's 16-bit levels in a {kind} frame; raise it."
        )
    return PlannedFrame(
        index=index,
        kind=kind,
        light=what if isinstance(what, int) else None,
        level=word / FULL_SCALE,
        exposure_s=rig.exposure_s,
        on_s=rig.settle_s + rig.exposure_s if kind != "black" else 0.0,
    )
