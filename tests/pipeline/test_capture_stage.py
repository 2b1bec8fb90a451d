"""The capture stage from a folder of radiance images to a published store, over a real Modbus server."""

from __future__ import annotations

import json
import resource
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import zarr
from numpy.typing import NDArray

from services.capture import stage
from services.capture.cameras.motion import SubjectMotion
from services.capture.cameras.simulated import SimulatedCameras
from services.capture.cameras.stills import Stills
from services.capture.dome.controller import DomeObserver
from services.capture.dome.driver import ModbusDome
from services.capture.dome.protocol import ExposureBudget
from services.capture.dome.registers import FaultKind
from services.capture.dome.simulator import order_fault, simulated_dome
from services.capture.frames import FrameStore
from services.capture.plan import PlannedFrame, plan_capture
from services.capture.preflight import preflight
from services.core.errors import (
    CaptureInputError,
    DentineError,
    ExposureLimitError,
    FencedError,
    JobCancelledError,
    MeshError,
    ReadbackError,
    RigError,
    SettingsError,
    StoreError,
)
from services.core.records import CaptureManifest, FolderCapture, FrameRecord, JobSpec, RigSpec, SimulatedCameraSpec
from services.core.stage import CANCEL_FLAG, LocalContext, StageEvent
from services.core.store import StageWriter, is_published, open_stage, read_record
from tests.support.mouth import smooth_image, write_mouth
from tests.support.shared_data import shared_path

LIGHTS = 6
NOISELESS = SimulatedCameraSpec(noise_relative=0, noise_floor=0, bits=16)
Address = tuple[str, int]


@pytest.fixture(scope="module")
def shared_dome() -> Iterator[Address]:
    with simulated_dome(LIGHTS) as address:
        yield address


@pytest.fixture
def address(shared_dome: Address) -> Iterator[Address]:
    order_fault(*shared_dome, FaultKind.NONE)
    yield shared_dome
    order_fault(*shared_dome, FaultKind.NONE)


@pytest.fixture
def mouth(tmp_path: Path) -> Path:
    write_mouth(tmp_path / "mouth", LIGHTS)
    return tmp_path / "mouth"


@pytest.fixture
def job(mouth: Path, address: Address) -> Callable[..., JobSpec]:
    def make(**options: object) -> JobSpec:
        rig = {
            "mouth": mouth,
            "dome": f"{address[0]}:{address[1]}",
            "exposure_s": 0.01,
            "settle_s": 0.0,
            "simulation": NOISELESS,
        }
        return JobSpec(rig=RigSpec.model_validate(rig | options))

    return make


def outputs(address: Address) -> NDArray[np.float64]:
    observer = DomeObserver(*address)
    try:
        return observer.outputs()
    finally:
        observer.close()


def frames_of(root: Path) -> NDArray[np.uint16]:
    return zarr.open_array(root / "capture" / "capture.zarr", mode="r")[:]


def radiance_of(manifest: CaptureManifest, counts: NDArray[np.uint16], frame: FrameRecord) -> NDArray[np.float64]:
    return (
        (counts.astype(np.float64) - manifest.black_level)
        * manifest.radiance_per_count
        / (frame.level * frame.exposure_s)
    )


@pytest.mark.parametrize("cameras", ["simulated", "playback"])
def test_counts_turn_back_into_the_radiance_of_the_one_light(
    tmp_path: Path, mouth: Path, job: Callable[..., JobSpec], cameras: str
) -> None:
    manifest = stage.run(job(cameras=cameras), LocalContext(tmp_path / "job"))
    folder, published = open_stage(tmp_path / "job", "capture", CaptureManifest)
    assert published == manifest
    counts = frames_of(tmp_path / "job")
    array = zarr.open_array(folder / "capture.zarr", mode="r")
    assert array.metadata.dimension_names == ("camera", "frame", "y", "x", "channel")
    assert (array.shape, array.dtype) == ((2, len(manifest.frames), 18, 24, 3), np.uint16)
    for camera, description in enumerate(manifest.description.cameras):
        width, height = description.size
        stills = np.stack([smooth_image(width, height, 3, camera, light) for light in range(LIGHTS)])
        for frame in manifest.frames:
            seen = counts[camera, frame.index, :height, :width]
            if frame.kind == "black":
                assert (seen == manifest.black_level).all()
                continue
            still = stills.sum(axis=0) if frame.light is None else stills[int(frame.light[1:])]
            # Rounding to counts moves radiance by half a count; float32 sums of the stills by some of their epsilons.
            tolerance = (
                0.5 * manifest.radiance_per_count / (frame.level * frame.exposure_s)
                + 8 * np.finfo(np.float32).eps * still.max()
            )
            assert np.abs(radiance_of(manifest, seen, frame) - still).max() <= tolerance
        assert not counts[camera, :, height:].any()
        assert not counts[camera, :, :, width:].any()
    assert (folder / "teeth" / "11" / "outer.ply").read_bytes() == (mouth / "teeth" / "11" / "outer.ply").read_bytes()
    assert (manifest.fdi, manifest.description.images) == ((11,), ())


def test_brightest_single_light_sits_at_seven_tenths(tmp_path: Path, job: Callable[..., JobSpec]) -> None:
    manifest = stage.run(job(), LocalContext(tmp_path / "job"))
    lit = [frame.index for frame in manifest.frames if frame.kind == "light"]
    brightest = (frames_of(tmp_path / "job")[:, lit].max() - manifest.black_level) / (2**16 - 1 - manifest.black_level)
    # The gain follows the 99.9th percentile of the brightest image; of 432 pixels that lies within 1 % of its maximum.
    assert brightest == pytest.approx(0.7, rel=0.01)


def test_noise_is_as_specified(tmp_path: Path, job: Callable[..., JobSpec]) -> None:
    noisy = SimulatedCameraSpec(noise_relative=0.02, noise_floor=0.004, bits=16, seed=5)
    clean = stage.run(job(), LocalContext(tmp_path / "clean"))
    stage.run(job(simulation=noisy), LocalContext(tmp_path / "noisy"))
    lit = [frame.index for frame in clean.frames if frame.kind != "black"]
    truth = frames_of(tmp_path / "clean")[0, lit].astype(np.float64)
    deviation = np.hypot(0.02 * (truth - clean.black_level), 0.004 * (2**16 - 1))
    z = (frames_of(tmp_path / "noisy")[0, lit] - truth) / deviation
    # n samples of N(0, 1): mean within 4/√n, variance within 4·√(2/n); together a false alarm in 8,000 seeds, and the seed is fixed.
    assert abs(z.mean()) < 4 / np.sqrt(z.size)
    assert abs(z.var() - 1) < 4 * np.sqrt(2 / z.size)


def test_cameras_see_the_registers_and_not_the_plan(mouth: Path, address: Address) -> None:
    rig = RigSpec(mouth=mouth, exposure_s=0.01, simulation=NOISELESS)
    stills = Stills(mouth, read_record(mouth / "capture.json", FolderCapture))
    with (
        ModbusDome(*address, ExposureBudget(10, 10)) as dome,
        SimulatedCameras(stills, rig, 0.5, SubjectMotion(0, 0, 1, 0), *address) as cameras,
    ):

        def expose() -> NDArray[np.float64]:
            cameras.arm(0.01, 1)
            dome.trigger()
            return (cameras.read()[0].astype(np.float64) - cameras.black_level) * cameras.radiance_per_count / 0.01

        half_count = 0.51 * cameras.radiance_per_count / 0.01
        assert not expose().any()
        for light, level in ((2, 0.5), (5, 0.25)):
            held = dome.light(light, level, 0.1)[0] / 65535
            assert np.abs(expose() - held * stills.still(0, light)).max() < half_count
        dome.light(3, 0.5, 0.1)
        order_fault(*address, FaultKind.DEAD_LIGHT, 3)
        assert not expose().any()
        cameras.arm(0.01, 2)
        with pytest.raises(RigError, match="no trigger"):
            cameras.read()


def test_motion_displaces_frames_by_the_stated_field(tmp_path: Path, job: Callable[..., JobSpec]) -> None:
    moving = NOISELESS.model_copy(update={"motion_px": 1.5, "seed": 4})
    manifest = stage.run(job(simulation=moving), LocalContext(tmp_path / "job"))
    last = manifest.frames[-2]
    assert last.light is not None
    motion = SubjectMotion(1.5, reference=2, last=len(manifest.frames) - 1, seed=4)
    flow = motion.flow_px(last.index, 0, 18, 24)
    y, x = np.mgrid[:18, :24]
    k, light = np.arange(3), int(last.light[1:])
    displaced_x, displaced_y = (x + flow[..., 0])[..., None], (y + flow[..., 1])[..., None]
    waves = np.sin(displaced_x / 4 + light + k) * np.cos(displaced_y / 5)
    truth = 0.1 + 0.225 * (1 + light % 2 + waves)
    seen = radiance_of(manifest, frames_of(tmp_path / "job")[0, last.index], last)
    inside = np.s_[4:-4, 4:-4]
    # Interpolation error of waves of amplitude 0.225 and wave numbers 1/4 and 1/5, as derived in test_capture_motion.
    bound = 0.225 * 0.5625 / 6 * ((1 / 4) ** 3 + 1.25 * (1 / 5) ** 3) + manifest.radiance_per_count / (
        last.level * last.exposure_s
    )
    assert np.abs(seen - truth)[inside].max() < bound
    assert np.abs(smooth_image(24, 18, 3, 0, light) - truth)[inside].max() > 10 * bound


def test_events_tell_progress_and_end(tmp_path: Path, job: Callable[..., JobSpec]) -> None:
    events: list[StageEvent] = []
    manifest = stage.run(job(), LocalContext(tmp_path / "job", listener=events.append))
    progress = [event for event in events if event.kind == "progress"]
    assert (events[0].kind, events[-1].kind) == ("started", "finished")
    assert [event.data["frame"] for event in progress] == [frame.index for frame in manifest.frames]
    assert [event.done for event in progress] == [(i + 1) / len(progress) for i in range(len(progress))]


class CancelAfter(LocalContext):
    """Asks for a cancel once so many frames are stored, and looks at the lights when it does."""

    def __init__(self, root: Path, frames: int, address: Address) -> None:
        super().__init__(root, listener=self._count)
        self._left, self._address = frames, address

    def _count(self, event: StageEvent) -> None:
        self._left -= event.kind == "progress"

    def raise_if_cancelled(self) -> None:
        # The lookout asks too, from a thread of its own and under light.
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
"""An exposure that outlasts every wait of a test: whoever waits for its end has failed. At a level of 0.1 it is within the dose of a light."""
WAIT_S = 30.0


@pytest.fixture
def long_job(job: Callable[..., JobSpec], monkeypatch: pytest.MonkeyPatch) -> Callable[..., JobSpec]:
    """A job that exposes for so long as soon as a light is on; without the preflight's glimpses, and with short black frames."""

    def plan(rig: RigSpec, lights: int) -> tuple[PlannedFrame, ...]:
        frames = plan_capture(rig, lights)
        return tuple(
            frame.model_copy(update={"exposure_s": 0.01}) if frame.kind == "black" else frame for frame in frames
        )

    monkeypatch.setattr("services.capture.rig.plan_capture", plan)
    monkeypatch.setattr("services.capture.preflight.preflight", lambda *_: ())
    return lambda **options: job(exposure_s=LONG_S, level=0.1, **options)


def begin(spec: JobSpec, root: Path) -> tuple[threading.Thread, list[Exception]]:
    """Capture in a thread; what it raises is put into the list."""
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
        wait_until(lambda: outputs(address).any())
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
        wait_until(lambda: outputs(address).any())
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
    assert events[1].data["frame"] == 0
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
    # The same attempt number again, as a plain rerun of the command has it.
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


def test_preflight_names_a_dead_light_before_any_frame(
    tmp_path: Path, job: Callable[..., JobSpec], address: Address
) -> None:
    order_fault(*address, FaultKind.DEAD_LIGHT, 4)
    with pytest.raises(ReadbackError, match="Light 4 emits"):
        stage.run(job(), LocalContext(tmp_path / "job"))
    assert not outputs(address).any()
    assert not (tmp_path / "job" / ".capture.1" / "capture.zarr" / "c").exists()


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


class LeakyRoom(SimulatedCameras):
    """Cameras in a room that is not dark: 500 counts more everywhere."""

    def read(self) -> tuple[NDArray[np.uint16], ...]:
        return tuple(image + np.uint16(500) for image in super().read())


def look(mouth: Path, address: Address, kind: type[SimulatedCameras], gain_level: float) -> tuple[str, ...]:
    """Preflight at level 0.5 with cameras whose gain suits another level."""
    rig = RigSpec(mouth=mouth, exposure_s=0.01, simulation=NOISELESS)
    plan = plan_capture(rig, LIGHTS)
    stills = Stills(mouth, read_record(mouth / "capture.json", FolderCapture))
    with (
        ModbusDome(*address, ExposureBudget(10, 10)) as dome,
        kind(stills, rig, gain_level, SubjectMotion(0, 0, 1, 0), *address) as cameras,
    ):
        return preflight(plan, dome, cameras, rig, lambda: None)


def test_preflight_finds_nothing_in_a_good_rig(mouth: Path, address: Address) -> None:
    assert look(mouth, address, SimulatedCameras, gain_level=0.5) == ()


def test_preflight_tells_of_clipping(mouth: Path, address: Address) -> None:
    findings = look(mouth, address, SimulatedCameras, gain_level=0.05)
    assert [finding.split(" of its")[0] for finding in findings] == ["Camera 0 clips 100.0%", "Camera 1 clips 100.0%"]


def test_preflight_tells_of_a_closed_shutter(mouth: Path, address: Address) -> None:
    assert all("sees no light" in finding for finding in look(mouth, address, SimulatedCameras, gain_level=500.0))


def test_preflight_refuses_a_room_that_is_not_dark(mouth: Path, address: Address) -> None:
    with pytest.raises(RigError, match=r"Camera 0 reads 564.0 counts in the dark instead of 64"):
        look(mouth, address, LeakyRoom, gain_level=0.5)


def test_a_full_disk_keeps_what_was_acknowledged(tmp_path: Path, job: Callable[..., JobSpec], address: Address) -> None:
    write_mouth(tmp_path / "large", LIGHTS, sizes=((160, 160),))
    spec, root = job(mouth=tmp_path / "large", simulation=SimulatedCameraSpec(bits=12)), tmp_path / "job"

    def fill_disk(event: StageEvent) -> None:
        if event.kind == "progress" and event.data["frame"] == 4:
            # A shard of 160 x 160 x 3 noisy 12-bit pixels is over 100 kB; nothing else that is written comes near.
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


def _remove(name: str) -> Callable[[Path], None]:
    return lambda mouth: (mouth / name).unlink()


def _truncate(mouth: Path) -> None:
    path = mouth / "c1_l2.npy"
    path.write_bytes(path.read_bytes()[:-100])


def _relist(**lists: object) -> Callable[[Path], None]:
    def edit(mouth: Path) -> None:
        description = json.loads((mouth / "capture.json").read_text())
        (mouth / "capture.json").write_text(json.dumps(description | lists))

    return edit


def _edit(**changes: str) -> Callable[[Path], None]:
    def edit(mouth: Path) -> None:
        description = json.loads((mouth / "capture.json").read_text())
        description["images"][3] |= changes
        (mouth / "capture.json").write_text(json.dumps(description))

    return edit


def _replace(array: NDArray[np.generic]) -> Callable[[Path], None]:
    return lambda mouth: np.save(mouth / "c0_l1.npy", array)


@pytest.mark.parametrize(
    ("spoil", "error", "words"),
    [
        (_remove("c1_l2.npy"), CaptureInputError, ("c1_l2.npy", "camera c1", "light l2", "restore")),
        (_remove("capture.json"), CaptureInputError, ("capture.json", "does not exist")),
        (_remove("teeth/11/outer.ply"), CaptureInputError, ("outer.ply", "does not exist")),
        (_truncate, CaptureInputError, ("c1_l2.npy", "cannot be read")),
        (_relist(lights=[]), CaptureInputError, ("capture.json", "lists no light")),
        (_relist(channels=["red", "red", "blue"]), CaptureInputError, ("lists channel 'red' twice",)),
        (_edit(light="l77"), CaptureInputError, ("unknown light 'l77'",)),
        (_edit(camera="left"), CaptureInputError, ("unknown camera 'left'",)),
        (_edit(light="l0"), CaptureInputError, ("no image of camera c0 and light l3",)),
        (_replace(np.ones((3, 4, 3), dtype=np.float32)), CaptureInputError, ("c0_l1.npy", "(3, 4, 3)", "(18, 24, 3)")),
        (_replace(np.full((18, 24, 3), np.nan, dtype=np.float32)), CaptureInputError, ("c0_l1.npy", "non-finite")),
        (_replace(np.ones((18, 24, 3), dtype=np.uint8)), CaptureInputError, ("c0_l1.npy", "floating-point")),
    ],
)
def test_bad_input_is_one_sentence_before_any_light(
    tmp_path: Path,
    mouth: Path,
    job: Callable[..., JobSpec],
    spoil: Callable[[Path], None],
    error: type[DentineError],
    words: tuple[str, ...],
) -> None:
    spoil(mouth)
    with pytest.raises(error) as caught:
        stage.run(job(dome="127.0.0.1:1"), LocalContext(tmp_path / "job"))
    assert type(caught.value) is error
    assert all(word in caught.value.message for word in words)
    assert "\n" not in caught.value.message


def test_a_tooth_in_metres_is_refused(tmp_path: Path, mouth: Path, job: Callable[..., JobSpec]) -> None:
    import trimesh

    path = mouth / "teeth" / "11" / "outer.ply"
    mesh = trimesh.load_mesh(path)
    mesh.apply_scale(0.001)
    mesh.export(path)
    with pytest.raises(MeshError, match="millimetres"):
        stage.run(job(), LocalContext(tmp_path / "job"))


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"dome": "nowhere"}, SettingsError, "neither 'simulated' nor host:port"),
        ({"dome": "127.0.0.1:1"}, RigError, "does not answer"),
        ({"exposure_s": 30.0}, ExposureLimitError, "Light 0"),
    ],
)
def test_a_rig_that_cannot_be_used_is_refused(
    tmp_path: Path, job: Callable[..., JobSpec], options: dict[str, object], error: type[DentineError], words: str
) -> None:
    with pytest.raises(error, match=words):
        stage.run(job(**options), LocalContext(tmp_path / "job"))


def test_more_lights_than_the_dome_has_are_refused(tmp_path: Path, job: Callable[..., JobSpec]) -> None:
    write_mouth(tmp_path / "large", LIGHTS + 1)
    with pytest.raises(RigError, match=r"has 6 lights and .* lists 7"):
        stage.run(job(mouth=tmp_path / "large"), LocalContext(tmp_path / "job"))


def test_the_measured_incisor_is_captured_through_a_dome_of_its_own(tmp_path: Path) -> None:
    mouth = shared_path("data/tooth-ur1-truth")
    manifest = stage.run(JobSpec(rig=RigSpec(mouth=mouth)), LocalContext(tmp_path))
    counts = frames_of(tmp_path)
    z_sum, pixels = 0.0, 0
    for frame in (frame for frame in manifest.frames if frame.light is not None):
        for camera in range(3):
            still = np.load(mouth / f"c{camera}_{frame.light}.npy").astype(np.float64)
            seen = radiance_of(manifest, counts[camera, frame.index], frame)
            count = manifest.radiance_per_count / (frame.level * frame.exposure_s)
            variance = (0.01 * still) ** 2 + (0.002 * 4095 * count) ** 2 + count**2 / 12
            z_sum += float(((seen - still) ** 2 / variance).sum())
            pixels += still.size
    # Chi-square over n pixels: mean 1, deviation √(2/n); 4 deviations, and the seed is fixed.
    assert z_sum / pixels == pytest.approx(1, abs=4 * np.sqrt(2 / pixels))
    assert manifest.fdi == (11,)
    assert (tmp_path / "capture" / "teeth" / "11" / "dentin.ply").is_file()
