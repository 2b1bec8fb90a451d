"""Variants of the chain with a part of the truth given, on the same photographs: they show how much of the error each
step of the chain causes.

All variants use the frame of the calibration session, so that a true part is consistent with the estimates of the
others.
"""

from __future__ import annotations

import os
import shutil
import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.calibration.record import Calibration
from services.core.files.meshes import read_mesh, read_teeth, write_mesh
from services.core.geometry import Mesh, teeth_folder
from services.core.raw.folder import DESCRIPTION
from services.core.raw.registration import REGISTRATION, Registration
from services.core.raw.toml_writing import description_toml
from services.core.store import read_record, write_atomic, write_record
from services.phantom.lab.make import CALIBRATION, CALIBRATION_FILE, LAB_RECORD, MOUTH, TRUTH, LabRecord
from services.phantom.lab.rig import in_session_frame

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Known:
    """Parts of the truth that are given.

    Attributes:
        cameras: lenses and poses of the cameras.
        lights: positions of the lights.
        radiometry: intensities and lobes of the lights, radiance per count and vignetting of the cameras.
        pose: pose of the teeth.
    """

    cameras: bool = False
    lights: bool = False
    radiometry: bool = False
    pose: bool = False

    @property
    def is_all(self) -> bool:
        """Whether calibration and pose are perfect."""
        return self.cameras and self.lights and self.radiometry and self.pose


VARIANTS = {
    "perfect": Known(cameras=True, lights=True, radiometry=True, pose=True),
    "true pose": Known(pose=True),
    "true cameras": Known(cameras=True),
    "true lights": Known(lights=True),
    "true radiometry": Known(radiometry=True),
}
"""Variants of the chain by name; the limits of the chain refer to the first one."""


def true_calibration(root: Path) -> Calibration:
    """Return the true rig in the frame of the session's first board."""
    record = read_record(root / TRUTH / LAB_RECORD, LabRecord)
    rig = read_record(root / TRUTH / CALIBRATION_FILE, Calibration)
    return in_session_frame(rig, np.array(record.world_from_session))


def session_from_scan(root: Path) -> Floats:
    """Return the true transform session_from_scan (4, 4)."""
    record = read_record(root / TRUTH / LAB_RECORD, LabRecord)
    return np.asarray(np.linalg.inv(np.array(record.world_from_session)) @ np.array(record.world_from_scan))


def write_variant(root: Path, out: Path, known: Known) -> Path:
    """Write a raw folder of the same frames with a part of the truth, and return its path.

    Args:
        root: folder of the laboratory, calibrated and registered.
        out: folder to write; an existing one is replaced.
        known: parts of the truth that are given.
    """
    shutil.rmtree(out, ignore_errors=True)
    mouth, (found, true) = (
        root / MOUTH,
        (read_record(root / CALIBRATION / CALIBRATION_FILE, Calibration), true_calibration(root)),
    )
    registration = read_record(mouth / REGISTRATION, Registration)
    transform = np.eye(4)
    if known.pose:
        transform = session_from_scan(root) @ np.linalg.inv(np.array(registration.rig_from_scan))
    for tooth in read_teeth(mouth):
        write_mesh(teeth_folder(out, tooth.fdi) / "outer.ply", _transformed(tooth.outer, transform))
    write_mesh(out / "gums.ply", _transformed(read_mesh(mouth / "gums.ply"), transform))
    if not known.pose:
        shutil.copyfile(mouth / REGISTRATION, out / REGISTRATION)

    tree = tomllib.loads((mouth / DESCRIPTION).read_text())
    for frame in tree["frame"]:
        _linked(mouth / frame["file"], out / frame["file"])
    tree = {key: value for key, value in tree.items() if key not in {"scan", "landmark"}}
    tree["calibration"] = {"file": CALIBRATION_FILE}
    write_record(out / CALIBRATION_FILE, _mixed(found, true, known))
    write_atomic(out / DESCRIPTION, description_toml(tree))
    return out


def _mixed(found: Calibration, true: Calibration, known: Known) -> Calibration:
    cameras = []
    for one, real in zip(found.cameras, true.cameras, strict=True):
        geometry, light = (real if known.cameras else one), (real if known.radiometry else one)
        radiometry = {"radiance_per_count": light.radiance_per_count, "vignetting": light.vignetting}
        cameras.append(geometry.model_copy(update=radiometry))
    lights = []
    for lamp in found.lights:
        actual = next(light for light in true.lights if light.name == lamp.name)
        place, bright = (actual if known.lights else lamp), (actual if known.radiometry else lamp)
        lights.append(place.model_copy(update={"intensity": bright.intensity, "lobe": bright.lobe}))
    uncertainty = None if known.is_all else found.uncertainty
    return found.model_copy(update={"cameras": tuple(cameras), "lights": tuple(lights), "uncertainty": uncertainty})


def _linked(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:  # a file system without links, or another one
        shutil.copyfile(source, target)


def _transformed(mesh: Mesh, transform: Floats) -> Mesh:
    return Mesh(_transformed_points(transform, mesh.vertices_mm), mesh.faces)


def _transformed_points(transform: Floats, points_mm: Floats) -> Floats:
    return np.asarray(points_mm @ transform[:3, :3].T + transform[:3, 3])
