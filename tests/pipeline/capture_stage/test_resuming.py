"""Captures that are cancelled, overtaken or broken off leave the dome dark and continue after their last frame."""

from __future__ import annotations

import resource
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from services.capture import stage
from services.capture.cameras.simulated import SimulatedCameras
from services.capture.dome.registers import FaultKind
from services.capture.dome.simulator import order_fault
from services.capture.frames import FrameStore
from services.capture.plan import PlannedFrame, plan_capture
from services.core.errors import (
    FencedError,
    JobCancelledError,
    ReadbackError,
    StoreError,
)
from services.core.records import JobSpec, RigSpec, SimulatedCameraSpec
from services.core.results import FrameRecord
from services.core.stage import CANCEL_FLAG, LocalContext, StageEvent
from services.core.store import StageWriter, is_published
from tests.support.captured_frames import LIGHTS, Address, frames_of, outputs
from tests.support.mouth import write_mouth


class CancelAfter(LocalContext):
    """A context that requests a cancel after a number of stored frames, and asserts that the dome is dark then."""

    def __init__(self, root: Path, frames: int, address: Address) -> None:
        super().__init__(root, listener=self._count)
        self._left, self._address = frames, address

    def _count(self, event: StageEvent) -> None:
        self._left -= event.kind == "progress"

    def raise_if_cancelled(self) -> None:
        # The capture's watcher also asks for a cancel, from its own thread and while a light is on.
        if threading.current_thread() is threading.main_thread():
            assert not outputs(self._address).any()
        if self._left == 0:
            raise JobCancelledError("The job was cancelled.")


@pytest.mark.parametrize("damage", [False, True])
def test_a_cancelled_capture_is_dark_and_resumes(
    tmp_path: Path, job: Callable[..., JobSpec], address: Address, damage: bool
) -> None:
    spec = job(simulation=SimulatedCameraSpec(motion_px=1.0))
    root = tmp_path / "job"
    with pytest.raises(JobCancelledError):
        stage.run(spec, CancelAfter(root, 5, address))
    assert not outputs(address).any()
    assert not is_published(root, "capture")
    if damage:
        shard = root / ".capture.1" / "capture.zarr" / "c" / "1" / "3" / "0" / "0" / "0"
        shard.write_bytes(shard.read_bytes()[:-5])
    events: list[StageEvent] = []
    resumed = stage.run(spec, LocalContext(root, attempt=2, listener=events.append))
    fresh = stage.run(spec, LocalContext(tmp_path / "fresh"))
    exposed = [event.data["frame"] for event in events if event.kind == "progress"]
    assert exposed == [3] * damage + list(range(5, len(fresh.frames)))
    assert np.array_equal(frames_of(root), frames_of(tmp_path / "fresh"))
    assert [frame.index for frame in resumed.frames] == [frame.index for frame in fresh.frames]


LONG_S = 58.0
"""Exposure time longer than every wait of a test, so that code that waits for its end fails the test. At a level of 0.1
it is within the dose limit of a light."""
WAIT_S = 30.0


@pytest.fixture
def long_job(job: Callable[..., JobSpec], monkeypatch: pytest.MonkeyPatch) -> Callable[..., JobSpec]:
    """A job that exposes for ``LONG_S`` when a light is on, without the preflight's flashes and with short black
    frames.
    """

    def plan(rig: RigSpec, lights: int) -> tuple[PlannedFrame, ...]:
        frames = plan_capture(rig, lights)
        return tuple(
            frame.model_copy(update={"exposure_s": 0.01}) if frame.kind == "black" else frame for frame in frames
        )

    monkeypatch.setattr("services.capture.rig.plan_capture", plan)
    monkeypatch.setattr("services.capture.preflight.preflight", lambda *_: ())
    return lambda **options: job(exposure_s=LONG_S, level=0.1, **options)


def begin(spec: JobSpec, root: Path) -> tuple[threading.Thread, list[Exception]]:
    """Capture in a thread; returns it and the list that receives its exceptions."""
    raised: list[Exception] = []

    def capture() -> None:
        try:
            stage.run(spec, LocalContext(root))
        except Exception as problem:
            raised.append(problem)

    thread = threading.Thread(target=capture)
    thread.start()
    return thread, raised


def wait_until(condition: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < deadline_s, f"waited for {WAIT_S:g} s in vain"
        time.sleep(0.01)


@pytest.mark.parametrize("cameras", ["simulated", "playback"])
def test_a_cancel_in_mid_exposure_ends_the_capture_in_the_dark(
    tmp_path: Path, long_job: Callable[..., JobSpec], address: Address, cameras: str
) -> None:
    thread, raised = begin(long_job(cameras=cameras), tmp_path / "job")
    try:
        wait_until(lambda: bool(outputs(address).any()))
    finally:
        (tmp_path / "job" / CANCEL_FLAG).touch()
    thread.join(WAIT_S)
    assert not thread.is_alive(), "the capture waits for the end of its exposure"
    assert [type(problem) for problem in raised] == [JobCancelledError]
    assert not outputs(address).any()


def test_a_cancel_darkens_a_camera_that_is_still_exposing(
    tmp_path: Path, long_job: Callable[..., JobSpec], address: Address, monkeypatch: pytest.MonkeyPatch
) -> None:
    read_out, reads = threading.Event(), SimulatedCameras.read

    def read_late(cameras: SimulatedCameras) -> tuple[NDArray[np.uint16], ...]:
        if outputs(address).any():
            read_out.wait(2 * WAIT_S)
        return reads(cameras)

    monkeypatch.setattr(SimulatedCameras, "read", read_late)
    thread, raised = begin(long_job(), tmp_path / "job")
    try:
        wait_until(lambda: bool(outputs(address).any()))
        (tmp_path / "job" / CANCEL_FLAG).touch()
        wait_until(lambda: not outputs(address).any())
        assert thread.is_alive(), "the camera has ended, so it is not known what darkened the dome"
    finally:
        read_out.set()
        thread.join(WAIT_S)
    assert [type(problem) for problem in raised] == [JobCancelledError]


def test_frames_of_another_capture_are_not_mixed_in(
    tmp_path: Path, job: Callable[..., JobSpec], address: Address
) -> None:
    root = tmp_path / "job"
    with pytest.raises(JobCancelledError):
        stage.run(job(), CancelAfter(root, 5, address))
    events: list[StageEvent] = []
    stage.run(job(level=0.3), LocalContext(root, attempt=2, listener=events.append))
    assert next(event.data["frame"] for event in events if event.kind == "progress") == 0
    assert not list(root.glob(".capture.[0-9]*"))


@pytest.mark.parametrize(
    ("spoil", "recaptured"), [(lambda text: text[:-40], 2), (lambda text: text.replace('"index":1,', '"in', 1), 1)]
)
def test_a_torn_journal_line_is_no_frame(
    tmp_path: Path, job: Callable[..., JobSpec], address: Address, spoil: Callable[[str], str], recaptured: int
) -> None:
    root = tmp_path / "job"
    with pytest.raises(JobCancelledError):
        stage.run(job(), CancelAfter(root, 3, address))
    journal = root / ".capture.1" / "journal.jsonl"
    journal.write_text(spoil(journal.read_text()))
    events: list[StageEvent] = []
    # Use the same attempt number again, as a rerun of the command does.
    stage.run(job(), LocalContext(root, listener=events.append))
    assert next(event.data["frame"] for event in events if event.kind == "progress") == recaptured


def test_an_overtaken_attempt_stores_nothing_more(tmp_path: Path) -> None:
    store = FrameStore(StageWriter(tmp_path, "capture", 1), (1, 2, 4, 5, 1), "same")
    image = (np.ones((4, 5, 1), dtype=np.uint16),)
    frame = FrameRecord(index=0, kind="black", light=None, exposure_s=1, level=0, time_s=0, readback=(0, 0, 0))
    store.store(frame, image)
    assert FrameStore(StageWriter(tmp_path, "capture", 2), (1, 2, 4, 5, 1), "same").frames() == (frame,)
    with pytest.raises(FencedError, match="overtaken by attempt 2"):
        store.store(frame.model_copy(update={"index": 1}), image)


def test_a_light_that_dies_during_the_capture_ends_it_with_the_frames_kept(
    tmp_path: Path, job: Callable[..., JobSpec], address: Address
) -> None:
    def kill_light(event: StageEvent) -> None:
        if event.kind == "progress" and event.data["light"] == "l2":
            order_fault(*address, FaultKind.DEAD_LIGHT, 3)

    with pytest.raises(ReadbackError, match="Light 3 emits"):
        stage.run(job(), LocalContext(tmp_path / "job", listener=kill_light))
    assert not outputs(address).any()
    assert len((tmp_path / "job" / ".capture.1" / "journal.jsonl").read_text().splitlines()) == 1 + 6


def test_a_full_disk_keeps_what_was_acknowledged(tmp_path: Path, job: Callable[..., JobSpec], address: Address) -> None:
    write_mouth(tmp_path / "large", LIGHTS, sizes=((160, 160),))
    spec, root = job(mouth=tmp_path / "large", simulation=SimulatedCameraSpec(bits=12)), tmp_path / "job"

    def fill_disk(event: StageEvent) -> None:
        if event.kind == "progress" and event.data["frame"] == 4:
            # A shard of 160 x 160 x 3 noisy 12-bit pixels is over 100 kB, and all other written files are much smaller.
            resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, limits[1]))

    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        with pytest.raises(StoreError, match=r"Frame 5 cannot be stored .* free the disk"):
            stage.run(spec, LocalContext(root, listener=fill_disk))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not outputs(address).any()
    assert not is_published(root, "capture")
    events: list[StageEvent] = []
    stage.run(spec, LocalContext(root, attempt=2, listener=events.append))
    assert next(event.data["frame"] for event in events if event.kind == "progress") == 5
