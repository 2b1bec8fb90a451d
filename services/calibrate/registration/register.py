"""Registration of a raw folder's scan: the work of ``dentine register``, from landmarks to teeth in the rig's frame."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from services.anatomy.scans.scan import read_scan
from services.anatomy.scans.scanned_jaw import ScannedJaw, jaw_from_scan
from services.calibrate.registration.landmarks import Click, fit_landmarks
from services.calibrate.registration.outlines import View, outline_misfit_mm, pose_from_outlines
from services.calibrate.registration.overlay import report_page, write_overlay
from services.calibrate.registration.photographs import (
    cameras_of,
    clicks_of,
    crop_to_points,
    photographs,
    require_facing,
)
from services.calibrate.registration.pose import Floats, PoseStep, RigidPose
from services.core.calibration.record import Calibration
from services.core.calibration.state import warnings_of
from services.core.calibration.uncertainty import TWIST, CalibrationUncertainty
from services.core.errors import CaptureInputError
from services.core.files.meshes import write_mesh
from services.core.geometry import Matrix4, Mesh, teeth_folder
from services.core.raw.folder import DESCRIPTION, read_raw_folder, scan_of
from services.core.raw.records import RawFolder
from services.core.raw.registration import REGISTRATION, Registration, RegistrationStep
from services.core.store import read_record, write_atomic, write_record

PICTURES, PAGE = "registration", "registration.html"
FARTHEST_LANDMARK_MM = 2.0
"""Largest distance of a landmark from its tooth's nearest vertex: clicks lie on the surface, and vertices are some
tenths of a millimetre apart."""
REACH_MM = 1.5
"""Distance to which edges are searched in the first round: the error of a pose from clicks is smaller."""
MAX_MISFIT_MM = 0.32
"""Largest median distance between outlines and edges with which a scan is accepted as one of these teeth. A patient's
own teeth have up to 0.29 mm in photographs from the front and along the teeth, another person's 0.41 mm and more
(docs/measured/registration.md)."""
DOUBTFUL_MISFIT_MM = 0.10
"""Median distance above which an accepted scan is doubted in a warning. In a calibrated rig phantoms' own scans have
0.05 mm, those of other phantoms 0.11 mm and more."""


@dataclass(frozen=True)
class ScannedTeeth:
    """Solids of a scan in the scan's own frame, in mm.

    Attributes:
        fdi: FDI numbers of the teeth.
        teeth: solids of the teeth, in the same order.
        gums: solid of the gums.
        arch_from_scan: transform (4, 4) from the scan to the dental arch's axes.
        repairs: sentences that say how the scan was repaired and its teeth separated.
    """

    fdi: tuple[int, ...]
    teeth: tuple[Mesh, ...]
    gums: Mesh
    arch_from_scan: Floats
    repairs: str

    @property
    def centre_mm(self) -> Floats:
        """Mean of all vertices of the teeth (3,)."""
        return np.asarray(np.concatenate([mesh.vertices_mm for mesh in self.teeth]).mean(axis=0))


def register_folder(
    root: Path,
    calibration_file: Path | None = None,
    out: Path | None = None,
    max_misfit_mm: float = MAX_MISFIT_MM,
    refused: Path | None = None,
) -> Registration:
    """Register the scan of a raw folder and write teeth, gums, record, pictures and page.

    Args:
        root: the folder of ``raw.toml``.
        calibration_file: calibration to use in place of the one that ``raw.toml`` names.
        out: folder to write to; by default the raw folder itself, which then contains the teeth.
        max_misfit_mm: largest median distance between outlines and edges; beyond it the scan is refused.
        refused: folder for the pictures of a refusal; by default that of the other pictures.

    Raises:
        CaptureInputError: an input is missing or contradicts another one, or the pose is not plausible; where pictures
            show why, the message names them.
        MeshError: the scan cannot be made solid.
    """
    folder, out = read_raw_folder(root), root if out is None else out
    if (out / "teeth").exists():
        raise CaptureInputError(
            f"{out} has teeth already; remove its teeth and {REGISTRATION} to register again, or give --out."
        )
    calibration_path, calibration = _calibration(root, folder, calibration_file)
    scanned = scanned_teeth(root, folder)
    views = photographs(root, folder, calibration)
    clicks = clicks_of(folder, calibration, views)
    require_on_their_teeth(clicks, scanned)
    steps, cropped, misfit_mm = _fit_pose(views, clicks, scanned, refused or out / PICTURES, max_misfit_mm)

    pose = steps[-1].pose
    pictures = []
    for view in cropped:
        pictures.append(f"{PICTURES}/overlay_{view.camera.name}.png")
        write_overlay(out / pictures[-1], view, scanned.teeth, [scanned.gums], steps, _in_view(clicks, views, view))
    for fdi, mesh in zip(scanned.fdi, scanned.teeth, strict=True):
        write_mesh(teeth_folder(out, fdi) / "outer.ply", _transformed(mesh, pose))
    write_mesh(out / "gums.ply", _transformed(scanned.gums, pose))
    assert folder.scan is not None
    inputs = {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in (root / folder.scan.file, calibration_path)
    }
    warnings = (*warnings_of(calibration, calibration_path.name, time.time()), *doubts_of(misfit_mm))
    pixel_mm = float(np.median([view.camera.pixel_mm(pose.apply(scanned.centre_mm[None])[0]) for view in cropped]))
    record = _record(steps, scanned, misfit_mm, pixel_mm, inputs, tuple(pictures), warnings)
    write_atomic(out / PAGE, report_page(record).encode())
    write_record(out / REGISTRATION, record)
    return record


def scanned_teeth(root: Path, folder: RawFolder) -> ScannedTeeth:
    """Return the solids of a raw folder's scan.

    Raises:
        CaptureInputError: the folder names no scan, or the scan cannot be used.
        MeshError: the scan cannot be made solid.
    """
    scan = scan_of(root, folder)
    if scan.jaw == "both":
        raise CaptureInputError(f"Scan {scan.file} is of both jaws; export the jaw that is photographed alone.")
    points_mm = {
        fdi: np.array([one.xyz_mm for one in folder.landmark if one.tooth == fdi], dtype=np.float64)
        for fdi in sorted({one.tooth for one in folder.landmark})
    }
    read = read_scan(root / scan.file, "either", scan.labels, units=scan.units, jaw=scan.jaw, points_mm=points_mm)
    jaw: ScannedJaw = jaw_from_scan(read, "whole")
    separation = "" if read.is_labelled else f"Teeth parted along creases about landmarks of {len(points_mm)} teeth. "
    scan_from_arch = np.asarray(np.linalg.inv(jaw.arch_from_scan), dtype=np.float64)
    arch_pose = RigidPose(scan_from_arch[:3, :3], scan_from_arch[:3, 3])
    teeth = tuple(_transformed(tooth.outer, arch_pose) for tooth in jaw.teeth)
    fdi = tuple(tooth.fdi for tooth in jaw.teeth)
    return ScannedTeeth(
        fdi, teeth, _transformed(jaw.gums, arch_pose), jaw.arch_from_scan, separation + jaw.repairs.sentence()
    )


def _fit_pose(
    views: Mapping[str, View], clicks: Sequence[Click], scanned: ScannedTeeth, pictures: Path, max_misfit_mm: float
) -> tuple[list[PoseStep], list[View], float]:
    first, contradiction = fit_landmarks(cameras_of(views), clicks, scanned.centre_mm)
    steps = [first]
    teeth_mm = steps[0].pose.apply(np.concatenate([mesh.vertices_mm for mesh in scanned.teeth]))
    cropped = [crop_to_points(view, teeth_mm) for view in views.values()]
    try:
        _require_agreement(contradiction)
        require_facing(list(cameras_of(views).values()), steps[0].pose, scanned.arch_from_scan, scanned.centre_mm)
        reach_px = REACH_MM / min(view.camera.pixel_mm(teeth_mm.mean(axis=0)) for view in cropped)
        steps.append(pose_from_outlines(cropped, scanned.teeth, [scanned.gums], steps[0], scanned.centre_mm, reach_px))
        misfit_mm = outline_misfit_mm(cropped, scanned.teeth, [scanned.gums], steps[-1].pose)
        _require_small(misfit_mm, max_misfit_mm)
    except CaptureInputError as problem:
        names = []
        for view in cropped:
            names.append(str(pictures / f"refused_{view.camera.name}.png"))
            write_overlay(Path(names[-1]), view, scanned.teeth, [scanned.gums], steps, _in_view(clicks, views, view))
        raise CaptureInputError(f"{problem.message[:-1]}; {', '.join(names)} show it.") from problem
    return steps, cropped, misfit_mm


def doubts_of(misfit_mm: float) -> tuple[str, ...]:
    """A warning about an accepted scan whose outlines lie farther from the photographs' than a calibrated rig leaves
    them; none if they do not.
    """
    if misfit_mm <= DOUBTFUL_MISFIT_MM:
        return ()
    note = (
        f"The scan's teeth lie {misfit_mm:.2f} mm from the photographs' outlines in the median, and teeth in a"
        f" calibrated rig within {DOUBTFUL_MISFIT_MM:g} mm; see in the overlay pictures whether the scan is of this"
        " person and as the teeth are now, and whether the calibration is this rig's."
    )
    return (note,)


def _require_agreement(contradiction: str | None) -> None:
    if contradiction is not None:
        raise CaptureInputError(contradiction)


def _require_small(misfit_mm: float, max_mm: float) -> None:
    if misfit_mm > max_mm:
        raise CaptureInputError(
            f"The scan's teeth lie {misfit_mm:.2f} mm from the photographs' outlines in the median, more than "
            f"{max_mm:g} mm; see whether the scan is of this person and as the teeth are now, and whether the "
            "calibration is this rig's."
        )


def _calibration(root: Path, folder: RawFolder, given: Path | None) -> tuple[Path, Calibration]:
    if given is None and folder.calibration is None:
        raise CaptureInputError(
            f"{root / DESCRIPTION} names no calibration; add [calibration] with its file, or give --calibration."
        )
    path = given if given is not None else root / (folder.calibration.file if folder.calibration else "")
    return path, read_record(path, Calibration)


def require_on_their_teeth(clicks: Sequence[Click], scanned: ScannedTeeth) -> None:
    """Refuse landmarks of teeth that the scan does not have, and landmarks that do not lie on their tooth.

    Raises:
        CaptureInputError: names the first such landmark.
    """
    for one in clicks:
        if int(one.name.split()[0]) not in scanned.fdi:
            raise CaptureInputError(
                f"Landmark {one.name} is of a tooth that the scan does not have ({', '.join(map(str, scanned.fdi))}); "
                "correct its tooth, or remove it."
            )
        mesh = scanned.teeth[scanned.fdi.index(int(one.name.split()[0]))]
        off_mm = float(np.linalg.norm(mesh.vertices_mm - one.point_mm, axis=1).min())
        if off_mm > FARTHEST_LANDMARK_MM:
            raise CaptureInputError(
                f"Landmark {one.name} lies {off_mm:.3g} mm from its tooth in the scan; give xyz_mm in the scan's own"
                " coordinates, in mm, and see whether its tooth is right."
            )


def _in_view(clicks: Sequence[Click], views: Mapping[str, View], cropped: View) -> list[Click]:
    # Transform the clicks' pixels from the whole photograph to the cropped one.
    whole, part = np.asarray(views[cropped.camera.name].camera.K), np.asarray(cropped.camera.K)
    part_from_whole = part @ np.linalg.inv(whole)
    return [
        Click(one.name, one.camera, one.point_mm, (part_from_whole @ [*one.pixel, 1.0])[:2])
        for one in clicks
        if one.camera == cropped.camera.name
    ]


def _transformed(mesh: Mesh, pose: RigidPose) -> Mesh:
    return Mesh(pose.apply(mesh.vertices_mm), mesh.faces)


def _record(
    steps: Sequence[PoseStep],
    scanned: ScannedTeeth,
    misfit_mm: float,
    pixel_mm: float,
    inputs: dict[str, str],
    pictures: tuple[str, ...],
    warnings: tuple[str, ...],
) -> Registration:
    last = steps[-1]
    x, y, z = last.pose.apply(scanned.centre_mm[None])[0]
    rows = tuple(map(tuple, ((last.covariance + last.covariance.T) / 2).tolist()))
    return Registration(
        rig_from_scan=_rows(last.pose),
        centre_mm=(float(x), float(y), float(z)),
        uncertainty=CalibrationUncertainty(names=tuple(f"teeth.{axis}" for axis in TWIST), covariance=rows),
        steps=tuple(
            RegistrationStep(
                name=step.name,
                rig_from_scan=_rows(step.pose),
                covariance=tuple(map(tuple, step.covariance.tolist())),
                residual_px=dict(step.residual_px),
                residual_mm=step.residual_mm,
                points=step.points,
                left_out=step.left_out,
            )
            for step in steps
        ),
        misfit_mm=misfit_mm,
        pixel_mm=pixel_mm,
        teeth=scanned.fdi,
        repairs=scanned.repairs,
        inputs=inputs,
        pictures=pictures,
        warnings=warnings,
    )


def _rows(pose: RigidPose) -> Matrix4:
    one, two, three, four = ((float(a), float(b), float(c), float(d)) for a, b, c, d in pose.matrix)
    return one, two, three, four
