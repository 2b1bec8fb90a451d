"""The capture stage: a rig in, the published ``capture`` store out."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from services.core.errors import CaptureInputError, RigError, SettingsError
from services.core.records import CaptureManifest, FolderCapture, JobSpec, RigSpec
from services.core.stage import StageContext, StageEvent
from services.core.store import StageWriter, read_record

if TYPE_CHECKING:
    from services.capture.camera import Cameras
    from services.capture.plan import PlannedFrame
    from services.capture.stills import Stills


def run(spec: JobSpec, context: StageContext) -> CaptureManifest:
    """Capture with ``spec.rig`` and publish ``capture``; an interrupted capture of the same rig is resumed.

    Everything that can be wrong with the input is found before a light is lit.

    Raises:
        SettingsError: no rig, or a level or address that cannot be. CaptureInputError, MeshError: the mouth folder.
        RigError and its kinds: the dome or a camera; lights are dark. StoreError: the disk. JobCancelledError.
    """
    from services.capture.dome import ExposureBudget
    from services.capture.dome_modbus import ModbusDome
    from services.capture.frames import FrameStore, fingerprint
    from services.capture.plan import plan_capture
    from services.capture.preflight import preflight
    from services.capture.sequence import capture_frames
    from services.capture.stills import Stills
    from services.core.meshfiles import read_teeth

    if spec.rig is None:
        raise SettingsError("The capture stage needs option [rig]; add it, or give 'capture' and start from the prepare stage.")
    rig = spec.rig
    description = _read_description(rig.mouth / "capture.json")
    names = tuple(light.name for light in description.lights)
    plan = plan_capture(rig, len(names))
    teeth = read_teeth(rig.mouth)
    stills = Stills(rig.mouth, description)

    writer = StageWriter(context.root, "capture", context.attempt)
    context.report(StageEvent(stage="capture", kind="started", message=f"{len(plan)} frames of {len(description.cameras)} cameras."))
    widths, heights = zip(*(camera.size for camera in description.cameras), strict=True)
    shape = (len(description.cameras), len(plan), max(heights), max(widths), len(description.channels))
    # Where the dome is and how far it may go do not change a frame; everything else does.
    pixels = rig.model_dump(mode="json", exclude={"dome", "watchdog_s", "light_exposure_limit_s", "total_exposure_limit_s"})
    store = FrameStore(writer, shape, fingerprint(pixels, description.model_dump(mode="json"), stills.peak_radiance))

    with ExitStack() as rig_in_use:
        host, port = rig_in_use.enter_context(_dome_address(rig, len(names)))
        budget = ExposureBudget(rig.light_exposure_limit_s, rig.total_exposure_limit_s)
        dome = rig_in_use.enter_context(ModbusDome(host, port, budget, rig.watchdog_s))
        if dome.light_count < len(names):
            raise RigError(f"The dome at {dome.address} has {dome.light_count} lights and {rig.mouth / 'capture.json'} lists {len(names)}; correct rig.dome.")
        cameras = rig_in_use.enter_context(_cameras(rig, stills, plan, host, port))
        for finding in preflight(plan, dome, cameras, rig):
            context.report(StageEvent(stage="capture", kind="log", message=finding))
        capture_frames(plan, names, dome, cameras, rig.settle_s, store, context)
        manifest = CaptureManifest(
            description=description.model_copy(update={"images": ()}),
            frames=store.frames(),
            bits=cameras.bits,
            black_level=cameras.black_level,
            radiance_per_count=cameras.radiance_per_count,
            sensor_noise_relative=rig.simulation.noise_relative,
            sensor_noise_floor=rig.simulation.noise_floor,
            fdi=tuple(tooth.fdi for tooth in teeth),
        )

    _copy_meshes(rig.mouth, writer.folder, manifest.fdi)
    writer.publish(manifest)
    store.remove_leftovers()
    context.report(StageEvent(stage="capture", kind="finished", message=f"{len(manifest.frames)} frames captured.", done=1.0))
    return manifest


def _read_description(path: Path) -> FolderCapture:
    description = read_record(path, FolderCapture)
    parts = {"camera": [c.name for c in description.cameras], "light": [light.name for light in description.lights], "channel": list(description.channels)}
    for part, names in parts.items():
        if not names:
            raise CaptureInputError(f"{path} lists no {part}; describe the rig in it.")
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise CaptureInputError(f"{path} lists {part} '{twice}' twice; give each its own name.")
    return description


@contextmanager
def _dome_address(rig: RigSpec, lights: int) -> Iterator[tuple[str, int]]:
    if rig.dome == "simulated":
        from services.capture.simulator import simulated_dome

        with simulated_dome(lights, rig.watchdog_s) as address:
            yield address
        return
    host, separator, port = rig.dome.rpartition(":")
    if not (separator and host and port.isdigit()):
        raise SettingsError(f"rig.dome '{rig.dome}' is neither 'simulated' nor host:port; correct it.")
    yield host, int(port)


def _cameras(rig: RigSpec, stills: Stills, plan: tuple[PlannedFrame, ...], host: str, port: int) -> Cameras:
    from services.capture.motion import SubjectMotion
    from services.capture.simulated_cameras import PlaybackCameras, SimulatedCameras

    level = next(frame.level for frame in plan if frame.kind == "light")
    if rig.cameras == "playback":
        return PlaybackCameras(stills, rig, level, plan)
    motion = SubjectMotion(rig.simulation.motion_px, reference=rig.black_frames, last=len(plan) - 1, seed=rig.simulation.seed)
    return SimulatedCameras(stills, rig, level, motion, host, port)


def _copy_meshes(mouth: Path, folder: Path, fdi: tuple[int, ...]) -> None:
    wanted = [Path("teeth") / str(number) / name for number in fdi for name in ("outer.ply", "dentin.ply")]
    for relative in [*wanted, Path("gums.ply"), Path("cavity.ply")]:
        if (mouth / relative).is_file():
            (folder / relative).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(mouth / relative, folder / relative)
