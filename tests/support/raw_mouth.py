"""A raw folder as a laboratory records it: tracking frames of a phantom mouth, a scan in its own frame, and clicked
landmarks.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from services.anatomy.templates.jaw import build_jaw
from services.calibrate.registration.pose import RigidPose
from services.core.calibration.cameras_and_lights import CalibratedCamera, CalibratedLight
from services.core.calibration.record import Calibration
from services.core.geometry import Mesh
from services.core.store import write_record
from services.phantom.lab.scan import scan_of
from tests.support.computed_once import computed_once, run_folder
from tests.support.labelled_scan import write_labelled_ply
from tests.support.photographed_mouth import clicks_on, photographed_mouth
from tests.support.raw_folders import Tree, write_toml

BLACK, FULL_SCALE = 64, 3000
BITS = 12
INTENSITY = 3e7
"""Intensity of the light. With it, teeth are about half as bright as a white surface in their place."""


@dataclass(frozen=True)
class RawMouth:
    """A raw folder and the true pose of its scan."""

    root: Path
    tree: Tree
    rig_from_scan: RigidPose
    centre_mm: np.ndarray


def shared_mouth(factory: pytest.TempPathFactory) -> RawMouth:
    """A raw folder that all tests of the run share. Nobody may write into it."""

    def made() -> RawMouth:
        root = run_folder(factory) / "raw-mouth"
        root.mkdir()
        return write_raw_mouth(root)

    return computed_once(factory, "raw-mouth-record", made)


def write_raw_mouth(
    root: Path, subject: int | None = None, seed: int = 1, places: int = 3, *, is_labelled: bool = True
) -> RawMouth:
    """Write a raw folder with three cameras.

    Args:
        places: the scan holds the teeth up to this place from the midline.
        is_labelled: write the scan as a labelled PLY file. Otherwise it is an STL file, and each tooth without a click
            in photographs has a landmark in the scan alone.
    """
    jaw = build_jaw(subject)
    mouth = photographed_mouth(subject, seed, 0.2, jaw)
    inverse = mouth.rig_from_scan.rotation.T
    scan = scan_of(jaw, seed=seed, teeth_a_side=places)
    vertices = (scan.mesh.vertices_mm - mouth.rig_from_scan.translation_mm) @ inverse.T
    if is_labelled:
        write_labelled_ply(root / "scan.ply", Mesh(vertices, scan.mesh.faces), scan.fdi)
    else:
        trimesh.Trimesh(vertices, scan.mesh.faces, process=False).export(root / "scan.stl")

    cameras, frames = [], []
    for view in mouth.views:
        name, size = view.camera.name, list(view.camera.size)
        cameras.append({"name": name, "size": size, "bits": BITS})
        for kind, lit in (("tracking", {}), ("light", {"light": "l0"})):
            counts = (BLACK + FULL_SCALE * np.clip(view.image, 0, 1)).round().astype(np.uint16)
            np.save(root / f"{name}_{kind}.npy", counts)
            frames.append({"camera": name, "file": f"{name}_{kind}.npy", "kind": kind, "exposure_s": 0.1} | lit)
    known: dict[str, Any] = {"black_counts": BLACK, "radiance_per_count": (1 / FULL_SCALE,) * 3}
    calibrated = tuple(CalibratedCamera(**camera.model_dump(), **known) for camera in mouth.cameras.values())
    lights = (CalibratedLight(name="l0", position_mm=(0.0, 900.0, 0.0), intensity=(INTENSITY,) * 3),)
    channels = ("red", "green", "blue")
    write_record(
        root / "calibration.json", Calibration(units="mm", channels=channels, cameras=calibrated, lights=lights)
    )

    landmarks: dict[str, dict[str, object]] = {}
    for one in clicks_on(mouth, np.random.default_rng(seed)):
        tooth = int(one.name.split()[0])
        if tooth % 10 > places:
            continue
        entry = landmarks.setdefault(
            one.name, {"tooth": tooth, "point": "tip", "xyz_mm": one.point_mm.tolist(), "pixels": []}
        )
        pixels = entry["pixels"]
        assert isinstance(pixels, list)
        pixels.append({"camera": one.camera, "xy_px": one.pixel.tolist()})
    tree: Tree = {"units": "mm", "calibration": {"file": "calibration.json"}, "camera": cameras, "frame": frames}
    tree["light"] = [{"name": "l0"}]
    tree["scan"] = {"file": "scan.ply", "units": "mm", "labels": "label", "jaw": "upper"}
    if not is_labelled:
        tree["scan"] = {"file": "scan.stl", "units": "mm", "jaw": "upper"}
        clicked = {one["tooth"] for one in landmarks.values()}
        for fdi, mesh in zip(mouth.fdi, mouth.teeth, strict=True):
            if fdi % 10 <= places and fdi not in clicked:
                height = mouth.rig_from_scan.apply(mesh.vertices_mm)[:, 2]
                tip = mesh.vertices_mm[int(height.argmax())].tolist()
                landmarks[f"{fdi} edge"] = {"tooth": fdi, "point": "edge", "xyz_mm": tip}
    tree["landmark"] = list(landmarks.values())
    write_toml(root, tree)
    return RawMouth(root, tree, mouth.rig_from_scan, mouth.centre_mm)
