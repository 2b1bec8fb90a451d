"""Contents of frames: radiance, noise, motion, and the light that the dome's registers state."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zarr
from numpy.typing import NDArray
from zarr.core.metadata import ArrayV3Metadata

from services.capture import stage
from services.capture.cameras.motion import SubjectMotion
from services.capture.cameras.simulated import SimulatedCameras
from services.capture.cameras.stills import Stills
from services.capture.dome.driver import ModbusDome
from services.capture.dome.protocol import ExposureBudget
from services.capture.dome.registers import FaultKind
from services.capture.dome.simulator import order_fault
from services.core.errors import (
    RigError,
)
from services.core.records import FolderCapture, JobSpec, RigSpec, SimulatedCameraSpec
from services.core.results import CaptureManifest, FrameRecord
from services.core.stage import LocalContext, StageEvent
from services.core.store import open_stage, read_record
from tests.support.captured_frames import LIGHTS, NOISELESS, Address, frames_of
from tests.support.mouth import smooth_image
from tests.support.shared_data import shared_path


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
    assert isinstance(array.metadata, ArrayV3Metadata)
    assert array.metadata.dimension_names == ("camera", "frame", "y", "x", "channel")
    assert (array.shape, array.dtype) == ((2, len(manifest.frames), 18, 24, 3), np.dtype(np.uint16))
    for camera, description in enumerate(manifest.description.cameras):
        width, height = description.size
        stills = np.stack([smooth_image(width, height, 3, camera, light) for light in range(LIGHTS)])
        for frame in manifest.frames:
            seen = counts[camera, frame.index, :height, :width]
            if frame.kind == "black":
                assert (seen == manifest.black_level).all()
                continue
            still = stills.sum(axis=0) if frame.light is None else stills[int(frame.light[1:])]
            # Rounding to counts changes radiance by up to half a count, and float32 sums of the stills by some
            # epsilons.
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
    # The gain follows the 99.9th percentile of the brightest image; with 432 pixels this is within 1 % of its maximum.
    assert brightest == pytest.approx(0.7, rel=0.01)


def test_noise_is_as_specified(tmp_path: Path, job: Callable[..., JobSpec]) -> None:
    noisy = SimulatedCameraSpec(noise_relative=0.02, noise_floor=0.004, bits=16, seed=5)
    clean = stage.run(job(), LocalContext(tmp_path / "clean"))
    stage.run(job(simulation=noisy), LocalContext(tmp_path / "noisy"))
    lit = [frame.index for frame in clean.frames if frame.kind != "black"]
    truth = frames_of(tmp_path / "clean")[0, lit].astype(np.float64)
    deviation = np.hypot(0.02 * (truth - clean.black_level), 0.004 * (2**16 - 1))
    z = (frames_of(tmp_path / "noisy")[0, lit] - truth) / deviation
    # For n samples of N(0, 1) the bounds are 4/√n for the mean and 4·√(2/n) for the variance: together one false alarm
    # in 8,000 seeds, and the seed is fixed.
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
    # The bound is the interpolation error of waves of amplitude 0.225 and wave numbers 1/4 and 1/5, as derived in
    # test_capture_motion.
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
    # Chi-square over n pixels, divided by n, has the mean 1 and the standard deviation √(2/n). The tolerance is 4
    # standard deviations, and the seed is fixed.
    assert z_sum / pixels == pytest.approx(1, abs=4 * np.sqrt(2 / pixels))
    assert manifest.fdi == (11,)
    assert (tmp_path / "capture" / "teeth" / "11" / "dentin.ply").is_file()
