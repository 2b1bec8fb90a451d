"""The capture stage: a rig in, the published ``capture`` store out."""

from __future__ import annotations

import importlib
import shutil
from functools import partial
from pathlib import Path

from services.core.errors import SettingsError
from services.core.installed import require_packages
from services.core.light.flash_record import record_use, used_in
from services.core.records import LIMITS_OF_A_RIG, JobSpec
from services.core.results import CaptureManifest
from services.core.stage import StageContext, StageEvent
from services.core.store import StageWriter

PACKAGES = ("pymodbus",)
"""Import names of the packages that the extra ``capture`` installs."""


def check() -> None:
    """Import every module and package that a capture needs.

    Raises:
        PlatformError: a package is missing.
    """
    require_packages(PACKAGES, "capture")
    importlib.import_module("services.capture.sequence")


def run(spec: JobSpec, context: StageContext) -> CaptureManifest:
    """Capture with ``spec.rig`` and publish ``capture``; an interrupted capture of the same rig is resumed.

    All checks of the input are made before a light is switched on.

    Raises:
        SettingsError: there is no rig, a level or address is invalid, or an earlier attempt has flashed under the
            acknowledgement of this one. CaptureInputError, MeshError: the mouth folder
            is incomplete or contradictory. RigError and its kinds: the dome or a camera failed; lights are dark.
            StoreError: a frame cannot be stored. JobCancelledError: the job was cancelled.
    """
    from services.capture.cancel_watch import interrupt_on_cancel
    from services.capture.frames import FrameStore, fingerprint
    from services.capture.plan import told_of_time
    from services.capture.preflight import preflight
    from services.capture.rig import PlannedRig
    from services.capture.sequence import capture_frames
    from services.core.files.meshes import read_teeth

    if spec.rig is None:
        raise SettingsError(
            "The capture stage needs option [rig]; add it, or give 'capture' and start from the prepare stage."
        )
    rig = PlannedRig.read(spec.rig)
    description, plan = rig.description, rig.plan
    if spec.rig.flashes is not None and not spec.rig.is_simulated:
        spec.rig.flashes.require_newer(used_in(context.root))
    teeth = read_teeth(spec.rig.mouth)

    writer = StageWriter(context.root, "capture", context.attempt)
    context.report(
        StageEvent(
            stage="capture", kind="started", message=f"{len(plan)} frames of {len(description.cameras)} cameras."
        )
    )
    widths, heights = zip(*(camera.size for camera in description.cameras), strict=True)
    shape = (len(description.cameras), len(plan), max(heights), max(widths), len(description.channels))
    # Leave the dome's address and limits out of the fingerprint, because they do not change a frame; all else does.
    pixels = spec.rig.model_dump(mode="json", exclude=set(LIMITS_OF_A_RIG))
    store = FrameStore(
        writer, shape, fingerprint(pixels, description.model_dump(mode="json"), rig.stills.peak_radiance)
    )

    with (
        rig.in_use(before_flashes=partial(record_use, context.root)) as (dome, cameras),
        interrupt_on_cancel(context.raise_if_cancelled, dome.interrupt),
    ):
        # Check for a cancel after the watchdog is armed. An ALL OFF before that moment has left a cancel; after a later
        # ALL OFF the dome itself refuses light.
        context.raise_if_cancelled()
        context.report(StageEvent(stage="capture", kind="log", message=told_of_time(plan, dome.flash_interval_s)))
        for finding in preflight(plan, dome, cameras, spec.rig, context.raise_if_cancelled):
            context.report(StageEvent(stage="capture", kind="log", message=finding))
        capture_frames(plan, rig.lights, dome, cameras, spec.rig.settle_s, store, context)
        manifest = CaptureManifest(
            description=description.model_copy(update={"images": ()}),
            frames=store.frames(),
            bits=cameras.bits,
            black_level=cameras.black_level,
            radiance_per_count=cameras.radiance_per_count,
            sensor_noise_relative=spec.rig.simulation.noise_relative,
            sensor_noise_floor=spec.rig.simulation.noise_floor,
            fdi=tuple(tooth.fdi for tooth in teeth),
            flashes=used_in(context.root),
        )

    _copy_meshes(spec.rig.mouth, writer.folder, manifest.fdi)
    writer.publish(manifest)
    store.remove_leftovers()
    context.report(
        StageEvent(stage="capture", kind="finished", message=f"{len(manifest.frames)} frames captured.", done=1.0)
    )
    return manifest


def _copy_meshes(mouth: Path, folder: Path, fdi: tuple[int, ...]) -> None:
    mesh_files = [Path("teeth") / str(number) / name for number in fdi for name in ("outer.ply", "dentin.ply")]
    for relative in [*mesh_files, Path("gums.ply"), Path("cavity.ply")]:
        if (mouth / relative).is_file():
            (folder / relative).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(mouth / relative, folder / relative)
