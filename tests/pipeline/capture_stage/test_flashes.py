"""A capture under an acknowledgement of faster flashes: it is stored, and no other attempt flashes under it."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from services.capture import stage
from services.core.errors import JobCancelledError, SettingsError
from services.core.light.flash_record import used_in
from services.core.light.safety import FlashAcknowledgement
from services.core.records import JobSpec
from services.core.results import CaptureManifest
from services.core.stage import LocalContext, StageEvent
from services.core.store import open_stage
from tests.support.captured_frames import Address, outputs


def acknowledged(at: datetime) -> dict[str, Any]:
    return {"per_s": 10.0, "eye_cover": True, "epilepsy_asked": True, "by": "B. Roe", "at": at}


class CancelAfter(LocalContext):
    """A context that requests a cancel once a frame is stored."""

    def __init__(self, root: Path) -> None:
        super().__init__(root, listener=self._hear)
        self._is_stored = False

    def _hear(self, event: StageEvent) -> None:
        self._is_stored |= event.kind == "progress"

    def raise_if_cancelled(self) -> None:
        if self._is_stored:
            raise JobCancelledError("The job was cancelled.")


def test_each_attempt_that_flashes_needs_an_acknowledgement_and_the_capture_keeps_them(
    tmp_path: Path, job: Callable[..., JobSpec]
) -> None:
    root, now = tmp_path / "job", datetime.now(UTC)
    first, second = acknowledged(now - timedelta(minutes=2)), acknowledged(now)
    with pytest.raises(JobCancelledError):
        stage.run(job(flashes=first), CancelAfter(root))
    with pytest.raises(SettingsError, match="An earlier attempt has flashed under the acknowledgement of"):
        stage.run(job(flashes=first), LocalContext(root, attempt=2))
    events: list[StageEvent] = []
    stage.run(job(flashes=second), LocalContext(root, attempt=3, listener=events.append))
    assert "Resuming: 1 of" in "".join(event.message for event in events), "another acknowledgement changes no frame"
    stated = tuple(map(FlashAcknowledgement.model_validate, (first, second)))
    assert open_stage(root, "capture", CaptureManifest)[1].flashes == stated


def test_an_acknowledgement_that_is_too_old_lights_nothing_and_is_not_used(
    tmp_path: Path, job: Callable[..., JobSpec], address: Address
) -> None:
    old = acknowledged(datetime.now(UTC) - timedelta(hours=25))
    with pytest.raises(SettingsError, match=r"rig\.flashes\.at .* is more than 24 hours ago"):
        stage.run(job(flashes=old), LocalContext(tmp_path / "job"))
    assert not outputs(address).any()
    assert used_in(tmp_path / "job") == ()


def test_a_simulated_dome_needs_no_acknowledgement_and_uses_none(tmp_path: Path, job: Callable[..., JobSpec]) -> None:
    old = acknowledged(datetime.now(UTC) - timedelta(hours=25))
    events: list[StageEvent] = []
    spec = job(dome="simulated", flashes=old)
    assert stage.run(spec, LocalContext(tmp_path / "job", listener=events.append)).flashes == ()
    assert not any("one light every" in event.message for event in events)


def test_a_capture_tells_its_time_before_the_first_light_and_what_remains_of_it(
    tmp_path: Path, job: Callable[..., JobSpec]
) -> None:
    events: list[StageEvent] = []
    stage.run(job(), LocalContext(tmp_path / "job", listener=events.append))
    assert events[1].message == ("The preflight takes at least 2 s at one light every 0.34 s, the capture 3 s more.")
    first, *_, last = [event.data["remaining_s"] for event in events if event.kind == "progress"]
    # 8 lights and tracking frames are to come, a third of a second each, while black frames took milliseconds.
    assert first >= 8 * 1.01 / 3
    assert last == 0


def test_limits_above_the_defaults_need_an_assessment_of_the_lights(
    tmp_path: Path, job: Callable[..., JobSpec], address: Address
) -> None:
    for lavish in ({"light_exposure_limit_s": 10.1}, {"total_exposure_limit_s": 101}):
        with pytest.raises(SettingsError, match=rf"rig\.{next(iter(lavish))} .*; give assessment = 'who, when, file'"):
            stage.run(job(**lavish), LocalContext(tmp_path / "job"))
        assert not outputs(address).any()
    stage.run(
        job(light_exposure_limit_s=10.1, assessment="A. Low, 2026-03-01, iec62471.pdf"), LocalContext(tmp_path / "job")
    )
