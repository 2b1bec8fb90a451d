"""Raw folders of a patient's photographs, each with a scan: the patient's own, its mirror image, or another person's.

The patient's crowns are closed meshes without gums, so gums are added below their necks. The cameras are those that the
data's authors fitted to the photographs; moved by their fit of the two jaws, they give the pose of each jaw in each
photograph. From it landmarks are projected: where the photographs show a tooth's corners or its cusp to the cheek.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from services.anatomy.isosurface import surface_net
from services.anatomy.scans.patches import compact
from services.anatomy.scans.scan import LabelledScan
from services.anatomy.scans.scanned_jaw import jaw_from_scan
from services.calibrate.cameras.rotations import rotation_matrix
from services.core.calibration.cameras_and_lights import CalibratedCamera
from services.core.calibration.record import Calibration
from services.core.files.meshes import read_mesh
from services.core.geometry import Mesh
from services.core.store import write_record
from tests.support.labelled_scan import write_labelled_ply
from tests.support.patient_photos import CLICKED_WIDTH, SIZE, STILL
from tests.support.raw_folders import write_toml

Jaw = Literal["upper", "lower"]
Points = NDArray[np.float64]
QUADRANTS: Mapping[Jaw, tuple[int, int]] = {"upper": (1, 2), "lower": (3, 4)}
PHOTOGRAPH = {"upper": 0, "lower": 1, "left": 2, "right": 3, "frontal": 4}
"""Number of each photograph's file."""
FOCAL_PX = {"upper": 924.81, "lower": 1049.63, "left": 1807.59, "right": 1606.23, "frontal": 1426.57}
PRINCIPAL_PX = {
    "upper": (410.57, 335.03),
    "lower": (391.26, 327.75),
    "left": (301.30, 203.32),
    "right": (499.39, 362.62),
    "frontal": (428.88, 295.94),
}
"""Of the authors' cameras, for images 800 pixels wide."""
CAMERA_FROM_JAW: Mapping[tuple[Jaw, str], tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    ("upper", "upper"): ((2.261, 0.0224, 0.097), (0.162, 0.238, 73.406)),
    ("upper", "left"): ((-3.0313, -0.0406, 0.64), (-4.646, -0.605, 123.321)),
    ("upper", "right"): ((-2.965, 0.0315, -0.5062), (6.642, -1.738, 117.889)),
    ("upper", "frontal"): ((-2.9766, 0.0335, -0.0817), (-0.868, -3.22, 126.489)),
    ("lower", "lower"): ((-2.2794, 0.0419, -0.0281), (0.083, -0.187, 77.784)),
    ("lower", "left"): ((-3.0224, 0.0005, 0.6263), (-5.947, 4.644, 122.801)),
    ("lower", "right"): ((-2.9425, 0.0623, -0.513), (6.107, 3.632, 117.159)),
    ("lower", "frontal"): ((-2.9583, 0.0683, -0.0909), (-1.61, 2.149, 126.091)),
}
"""Rotation vector and translation in mm from the reference meshes of a jaw to a photograph's camera: the authors'
camera after the similarity that fits the meshes to their model (0.35 mm upper, 0.42 mm lower)."""
CLICK_MM = 0.3
GUMS_MM, GUMS_DEPTH_MM, PITCH_MM = 1.0, 4.0, 0.35
"""How far gums stand out around the necks, how deep they are, and the distance of their grid's points."""
CAP_COSINE = -0.5
"""Faces of a crown whose normals point towards the root by more than this close it, and were not scanned."""
BASE = -1
"""Label of the faces of the cut that ends the gums."""
CORNERS = {1: ("mesial edge", "distal edge"), 2: ("mesial edge", "distal edge")}
"""Landmarks by a tooth's place from the midline; the others have a cusp."""


@dataclass(frozen=True)
class Landmarked:
    """A labelled scan, and its landmarks (3,) by their names in the scan's coordinates."""

    scan: LabelledScan
    landmarks_mm: Mapping[str, Points]


def patients_scan(root: Path, jaw: Jaw) -> LabelledScan:
    """The patient's teeth of one jaw, with gums below their necks: one open surface."""
    from manifold3d import Manifold, Mesh64

    numbers = [10 * quadrant + place for quadrant in QUADRANTS[jaw] for place in range(1, 8)]
    crowns = [read_mesh(root / "ref_mesh" / f"Ref_Mesh_Tag=0_FDI={fdi}.obj") for fdi in numbers]
    occlusal = _occlusal(crowns, jaw)
    bodies = [
        Manifold(Mesh64(np.ascontiguousarray(mesh.vertices_mm), np.ascontiguousarray(mesh.faces, dtype=np.uint64)))
        for mesh in [*crowns, _gums(crowns, occlusal)]
    ]
    fdi_of = {int(body.to_mesh64().run_original_id[0]): fdi for body, fdi in zip(bodies, [*numbers, 0], strict=True)}
    whole = bodies[-1]
    for body in bodies[:-1]:
        whole = whole + body
    base_mm = _base_mm(crowns, occlusal)
    cut = whole.trim_by_plane(tuple(occlusal.tolist()), base_mm).to_mesh64()
    ends = np.asarray(cut.run_index, dtype=np.int64) // 3
    labels = np.zeros(len(cut.tri_verts), dtype=np.int64)
    for number, first, last in zip(cut.run_original_id, ends[:-1], ends[1:], strict=True):
        labels[first:last] = fdi_of.get(int(number), BASE)
    vertices, faces = cut.vert_properties[:, :3].astype(np.float64), cut.tri_verts.astype(np.int32)
    scanned = labels != BASE
    return LabelledScan(compact(Mesh(vertices, faces[scanned])), labels[scanned])


def mirrored(scan: LabelledScan) -> LabelledScan:
    """The mirror image of a scan, with left and right numbers exchanged: teeth that nobody has, but somebody might."""
    vertices = scan.mesh.vertices_mm * [-1.0, 1.0, 1.0]
    quadrant, place = np.divmod(scan.fdi, 10)
    fdi = np.where(scan.fdi == 0, 0, 10 * np.where(quadrant % 2 == 1, quadrant + 1, quadrant - 1) + place)
    return LabelledScan(Mesh(vertices, scan.mesh.faces[:, ::-1].copy()), fdi)


def landmarked(scan: LabelledScan) -> Landmarked:
    """Landmarks of a scan by the same rule on everybody's teeth: corners of the incisors' edges, else a buccal cusp."""
    jaw, found = jaw_from_scan(scan), {}
    rotation, shift = jaw.arch_from_scan[:3, :3], jaw.arch_from_scan[:3, 3]
    for tooth, frame in zip(jaw.teeth, jaw.frames, strict=True):
        own = np.unique(scan.mesh.faces[scan.fdi == tooth.fdi])
        points = scan.mesh.vertices_mm[own]
        local = frame.canonical_from_world(points @ rotation.T + shift)
        mesial = 1.0 if tooth.fdi // 10 % 2 == 1 else -1.0
        if tooth.fdi % 10 <= 2:
            edge = local[:, 2] > local[:, 2].max() - 1.0
            for name, sign in zip(CORNERS[1], (mesial, -mesial), strict=True):
                score = np.where(edge, sign * local[:, 0] + local[:, 2], -np.inf)
                found[f"{tooth.fdi} {name}"] = points[int(score.argmax())]
        else:
            buccal = local[:, 1] > np.median(local[:, 1])
            found[f"{tooth.fdi} cusp"] = points[int(np.where(buccal, local[:, 2], -np.inf).argmax())]
    return Landmarked(scan, found)


def write_patient_folder(
    folder: Path, root: Path, jaw: Jaw, view: str, own: Landmarked, shown: Landmarked, seed: int
) -> None:
    """Write a raw folder of one photograph, with a scan and its landmarks.

    Args:
        folder: empty folder to write to.
        root: folder of the patient's data.
        jaw: jaw that is registered.
        view: name of the photograph.
        own: the patient's own scan, whose landmarks the photograph shows.
        shown: scan to register, with landmarks of the same names.
        seed: of the errors of the clicks.
    """
    rng, scale = np.random.default_rng(seed), CLICKED_WIDTH / SIZE[0]
    vector, move = CAMERA_FROM_JAW[jaw, view]
    focal, (cx, cy) = scale * FOCAL_PX[view], (scale * one for one in PRINCIPAL_PX[view])
    size = (CLICKED_WIDTH, round(scale * SIZE[1]))
    camera = CalibratedCamera(
        name="phone",
        size=size,
        K=((focal, 0.0, cx), (0.0, focal, cy), (0.0, 0.0, 1.0)),
        camera_from_world=STILL,
        radiance_per_count=(1.0, 1.0, 1.0),
    )
    record = Calibration(units="mm", channels=("red", "green", "blue"), cameras=(camera,), lights=())
    write_record(folder / "calibration.json", record)
    picture = f"{view}.png"
    (folder / picture).write_bytes((root / "image" / f"0-{PHOTOGRAPH[view]}.png").read_bytes())
    write_labelled_ply(folder / "scan.ply", shown.scan.mesh, shown.scan.fdi)
    tree: dict[str, Any] = {
        "units": "mm",
        "calibration": {"file": "calibration.json"},
        "camera": [{"name": "phone", "size": list(size), "bits": 8}],
        "frame": [{"camera": "phone", "file": picture, "kind": "tracking", "exposure_s": 1.0}],
        "scan": {"file": "scan.ply", "units": "mm", "labels": "label", "jaw": jaw},
        "landmark": [],
    }
    rotation = rotation_matrix(np.array(vector))
    for name in _visible(own.landmarks_mm, rotation, jaw, view):
        at_mm = rotation @ own.landmarks_mm[name] + np.array(move)
        at_mm = at_mm + np.append(rng.normal(0, CLICK_MM, 2), 0)
        x, y = focal * at_mm[0] / at_mm[2] + cx, focal * at_mm[1] / at_mm[2] + cy
        if name not in shown.landmarks_mm or not (0 < x < size[0] and 0 < y < size[1]):
            continue
        tooth, point = name.split(" ", 1)
        seen = [{"camera": "phone", "xy_px": [float(x), float(y)]}]
        xyz_mm = [float(one) for one in shown.landmarks_mm[name]]
        tree["landmark"].append({"tooth": int(tooth), "point": point, "xyz_mm": xyz_mm, "pixels": seen})
    write_toml(folder, tree)


def _visible(landmarks_mm: Mapping[str, Points], rotation: Points, jaw: Jaw, view: str) -> list[str]:
    # Names of the landmarks on the side of the mouth that the photograph shows.
    left = QUADRANTS[jaw][1] if jaw == "upper" else QUADRANTS[jaw][0]
    names = []
    for name in landmarks_mm:
        quadrant, place = divmod(int(name.split()[0]), 10)
        is_shown = place <= 4 if view == "frontal" else (quadrant == left) == (view == "left") or place == 1
        if view in QUADRANTS or is_shown:
            names.append(name)
    return names


def _occlusal(crowns: list[Mesh], jaw: Jaw) -> Points:
    # Normal (3,) of the plane of the crowns' middles towards the other jaw; the meshes' y axis points upwards.
    middles = np.array([mesh.vertices_mm.mean(axis=0) for mesh in crowns])
    normal = np.linalg.svd(middles - middles.mean(axis=0))[2][2]
    return np.asarray(normal if (normal[1] > 0) == (jaw == "lower") else -normal)


def _base_mm(crowns: list[Mesh], occlusal: Points) -> float:
    # Height of the plane in which the gums are cut off.
    return float(min((mesh.vertices_mm @ occlusal).min() for mesh in crowns)) - GUMS_DEPTH_MM


def _gums(crowns: list[Mesh], occlusal: Points) -> Mesh:
    # Everything within some distance of the columns below the crowns' caps.
    from scipy.spatial import cKDTree

    caps = []
    for mesh in crowns:
        is_cap = _normals(mesh.vertices_mm, mesh.faces) @ occlusal < CAP_COSINE
        caps.append(mesh.vertices_mm[mesh.faces[is_cap]].mean(axis=1)[::4])
    points, base_mm = np.concatenate(caps), _base_mm(crowns, occlusal) - 2 * GUMS_MM
    longest = float((points @ occlusal).max()) - base_mm
    columns = [points - depth * occlusal for depth in np.arange(GUMS_MM, longest, GUMS_MM / 2)]
    inside = np.concatenate([one[one @ occlusal > base_mm] for one in columns])
    tree, beyond = cKDTree(inside), 3 * GUMS_MM

    def nearness(at_mm: Points) -> Points:
        return -np.minimum(tree.query(at_mm, distance_upper_bound=beyond)[0], beyond)

    return surface_net(nearness, inside.min(axis=0) - beyond, inside.max(axis=0) + beyond, PITCH_MM, -GUMS_MM)


def _crosses(vertices: Points, faces: NDArray[np.int32]) -> Points:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def _normals(vertices: Points, faces: NDArray[np.int32]) -> Points:
    crosses = _crosses(vertices, faces)
    return np.asarray(crosses / np.maximum(np.linalg.norm(crosses, axis=1, keepdims=True), 1e-300))
