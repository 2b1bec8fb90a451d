"""Make a virtual laboratory: two raw folders as a real laboratory would have them, and a folder with the ground truth.

LAB/session/   raw.toml and frames of boards, spheres, flat field and chart
LAB/mouth/     raw.toml, frames of the mouth, scan.ply; its calibration is expected in LAB/calibration/
LAB/truth/     calibration.json, teeth/11, lab.json: read only by the final comparison
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from services.core.calibration.record import Calibration
from services.core.files.meshes import write_mesh
from services.core.geometry import Matrix4, Record, teeth_folder
from services.core.store import read_record, write_record
from services.phantom.files import medium_truth
from services.phantom.jaw_optics import mouth_around
from services.phantom.lab.capture import PinholeImages, write_capture
from services.phantom.lab.light import MouthLight
from services.phantom.lab.mouth import FITTED, true_mouth
from services.phantom.lab.rig import CHANNELS, RigSize, true_rig
from services.phantom.lab.sensor import Sensor
from services.phantom.lab.session import write_session
from services.phantom.subjects import subject_tissues

SESSION, MOUTH, TRUTH = "session", "mouth", "truth"
CALIBRATION, CALIBRATION_FILE = "calibration", "calibration.json"
LAB_RECORD = "lab.json"


@dataclass(frozen=True)
class LabSize:
    """Size of a laboratory.

    Attributes:
        rig: size of images, and numbers of cameras and lights.
        boards, mirror, white: numbers of places of the board, the mirror sphere and the white sphere.
        samples: paths per pixel of the tooth in green.
    """

    rig: RigSize
    boards: int
    mirror: int
    white: int
    samples: int


DEMO_SIZE = LabSize(RigSize((720, 520), 0.13, 3, 9), boards=10, mirror=5, white=2, samples=256)
"""Size for ``make lab-demo``, which is rendered in some minutes on two cores."""
COARSE_SIZE = LabSize(RigSize((480, 352), 0.19, 3, 6), boards=7, mirror=4, white=1, samples=128)
"""Smallest size, which only shows that all steps work together."""


VERSION = 2
"""Counts up whenever the same options make other files, so that an older laboratory is made anew."""


class LabRecord(Record):
    """Content of ``truth/lab.json``, which is written last, so a folder that has it is complete."""

    recipe: str
    """All options as text, by which a laboratory with other options is recognised."""
    world_from_scan: Matrix4
    world_from_session: Matrix4
    """Rigid transform from the session's frame, which is that of its first board."""
    media: dict[str, dict[str, dict[str, float]]]
    """True media by channel, then by enamel and dentin."""


def make_lab(root: Path, size: LabSize, subject: int, seed: int, report: Callable[[str], None]) -> bool:
    """Make a laboratory, unless the folder contains it already, and return whether it was made.

    Args:
        root: folder of the laboratory.
        size: size of the laboratory.
        subject: seed of the subject's teeth and optics.
        seed: seed of all other random numbers.
        report: called with the name of each step as it begins.
    """
    recipe = repr((VERSION, size, subject, seed))
    record_path = root / TRUTH / LAB_RECORD
    if record_path.is_file() and read_record(record_path, LabRecord).recipe == recipe:
        return False
    for part in (SESSION, MOUTH, TRUTH):
        shutil.rmtree(root / part, ignore_errors=True)
    sensor = Sensor()
    rig, mouth, tissues = (
        true_rig(size.rig, sensor.black, seed),
        true_mouth(subject, seed),
        subject_tissues(subject, CHANNELS),
    )
    report("calibration session: boards, spheres, flat field and chart")
    numbers = {"n_boards": size.boards, "n_mirror": size.mirror, "n_white": size.white}
    first_board = write_session(root / SESSION, rig, sensor, seed, **numbers)
    fdi = tuple(tooth.fdi for tooth in mouth.teeth)
    media = {channel: mouth_around(tissue, fdi, channel, subject) for channel, tissue in tissues.items()}
    light = MouthLight(mouth, rig.lights, media)
    pinhole_images = []
    for number, camera in enumerate(rig.cameras):
        report(f"mouth: camera {camera.name} is rendered under {len(rig.lights)} lights")
        pinhole_images.append(PinholeImages(camera, light.images(camera, size.samples, seed + 7919 * number)))
    report("mouth: the capture's frames")
    write_capture(root / MOUTH, rig, sensor, mouth, pinhole_images, f"../{CALIBRATION}/{CALIBRATION_FILE}", seed)
    _write_truth(root / TRUTH, rig)
    tooth = mouth.fitted
    for name, mesh in (("outer.ply", tooth.outer), ("dentin.ply", tooth.dentin)):
        if mesh is not None:
            write_mesh(teeth_folder(root / TRUTH, FITTED) / name, mesh)
    truth = {
        channel: {"enamel": medium_truth(tissue.enamel), "dentin": medium_truth(tissue.dentin)}
        for channel, tissue in tissues.items()
    }
    record = LabRecord.model_validate(
        {
            "recipe": recipe,
            "world_from_scan": mouth.world_from_scan.tolist(),
            "world_from_session": first_board.tolist(),
            "media": truth,
        }
    )
    write_record(record_path, record)
    return True


def _write_truth(root: Path, rig: Calibration) -> None:
    root.mkdir(parents=True, exist_ok=True)
    write_record(root / CALIBRATION_FILE, rig)
