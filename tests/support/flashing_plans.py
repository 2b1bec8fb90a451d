"""Random work with a dome: drivers that follow each other, with a preflight and a capture each, or light by hand."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

from services.capture.dome.flashes import Flashes
from services.capture.plan import plan_capture
from services.capture.preflight import preflight
from services.capture.sequence import expose
from services.core.errors import DentineError
from services.core.records import RigSpec
from tests.support.model_dome import Clock, Controller, DarkCameras, ModelDome, random_delays


def captured(controller: Controller, rig: RigSpec, flashes: Flashes, stop_after: int | None = None) -> None:
    """Make a preflight and a capture; a capture that stops ends after that number of frames."""
    plan = plan_capture(rig, controller.lights)
    with ModelDome(controller, flashes) as dome:
        cameras = DarkCameras()
        preflight(plan, dome, cameras, rig, lambda: None)  # type: ignore[arg-type]
        for frame in plan[:stop_after]:
            expose(frame, dome, cameras, rig.settle_s)  # type: ignore[arg-type]


def lit_by_hand(controller: Controller, flashes: Flashes, source: random.Random) -> None:
    """Ask for lights as an impatient person does: again while one is on, in quick succession, or after a while."""
    with ModelDome(controller, flashes) as dome:
        for _ in range(source.randint(1, 8)):
            light = source.choice([None, *range(controller.lights)])
            dome.light(light, source.uniform(0.01, 1.0), source.uniform(0.01, 20.0))
            dome.pause(source.choice([0.0, 0.0, source.uniform(0.0, 0.4), source.uniform(0.0, 3.0)]))
            if source.random() < 0.5:
                dome.dark()
                dome.pause(source.choice([0.0, source.uniform(0.0, 0.5)]))


def unacknowledged(clock: Clock) -> Flashes:
    """The flashes of a driver without an acknowledgement."""
    return Flashes(clock=clock)


def flashes_of_random_work(seed: int, flashes_on: Callable[[Clock], Flashes] = unacknowledged) -> list[float]:
    """Do random work with a dome; returns the times in s at which light went on."""
    source = random.Random(seed)
    clock = Clock(source.uniform(0.0, 1e6))
    controller = Controller(
        source.randint(1, 8),
        clock,
        random_delays(source, source.choice([0.0, 0.002, 0.05])),
        lambda: source.random() < 0.01,
    )
    for _ in range(source.randint(1, 3)):
        flashes = flashes_on(clock)
        rig = RigSpec(
            mouth=Path("mouth"),
            exposure_s=source.choice([0.001, source.uniform(0.001, 0.5), source.uniform(0.5, 1.5)]),
            settle_s=source.choice([0.0, source.uniform(0.0, 0.1)]),
            tracking_every=source.randint(0, 4),
            black_frames=source.randint(1, 3),
        )
        try:
            if source.random() < 0.5:
                captured(controller, rig, flashes, source.choice([None, source.randint(1, 10)]))
            else:
                lit_by_hand(controller, flashes, source)
        except DentineError:
            pass  # an order whose answer was lost may end a driver; the next one begins at once
    return controller.flashes_s
