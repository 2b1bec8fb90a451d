"""The canonical frame of a tooth is found from its shape and the viewpoints, in any pose."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from services.anatomy.frame import ToothFrame, estimate_frame
from services.anatomy.templates.crown import build_tooth
from services.anatomy.templates.dimensions import upper_tooth
from services.anatomy.templates.incisor import build_incisor
from services.core.files.meshes import read_mesh
from services.core.geometry import Mesh
from services.core.records import FolderCapture
from services.core.store import read_record
from tests.support.shared_data import shared_path

VIEWPOINTS = np.array([[300.0, 950.0, 100.0], [-300.0, 950.0, -100.0]])


@pytest.mark.parametrize("seed", range(4))
def test_the_procedural_incisor_is_recognised_in_any_pose(seed: int) -> None:
    outer = build_incisor().outer
    turn, shift = Rotation.random(random_state=seed).as_matrix(), np.array([3.0, -7.0, 11.0])
    frame = estimate_frame(Mesh(outer.vertices_mm @ turn.T + shift, outer.faces), VIEWPOINTS @ turn.T + shift)
    # The wedge's axis of inertia leans a few degrees against the axis it is built on.
    assert np.degrees(np.arccos(np.clip(np.diag(frame.rotation @ turn), -1, 1))).max() < 8
    np.testing.assert_allclose(frame.rotation @ frame.rotation.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("position", range(1, 6))
def test_every_tooth_with_a_stub_of_root_but_molars_points_to_its_edge(position: int) -> None:
    frame = estimate_frame(build_tooth(upper_tooth(position)).outer, VIEWPOINTS)
    assert frame.axes[2, 2] > np.cos(np.radians(8))


def test_the_scanned_incisor_is_seen_by_its_landmarks() -> None:
    root = shared_path("data/tooth-ur1-truth")
    cameras = read_record(root / "capture.json", FolderCapture).cameras
    centres = np.array([camera.rays(np.zeros(1), np.zeros(1))[0] for camera in cameras])
    frame = estimate_frame(read_mesh(root / "teeth/11/outer.ply"), centres)
    landmarks = np.array(
        [
            [37.46, 47.35, 10.32],
            [34.96, 44.96, 5.36],
            [36.07, 50.19, 4.24],
            [40.46, 48.75, 5.65],
            [29.67, 59.43, 16.16],
            [41.20, 40.92, 1.98],
        ]
    )
    placed = landmarks @ frame.rotation.T
    # Root tip and incisal edge are the fifth and sixth landmark, 26 mm apart along the tooth.
    assert placed[5, 2] - placed[4, 2] == pytest.approx(26.0, abs=0.5)
    assert np.linalg.norm((placed[5] - placed[4])[:2]) < 2.0


def test_a_bare_crown_points_to_its_edge() -> None:
    crown = read_mesh(shared_path("data/intraoral-photos/ref_mesh/Ref_Mesh_Tag=0_FDI=11.obj"))
    frame = estimate_frame(crown, np.array([[0.0, 0.0, 1000.0]]))
    # These teeth look to larger z, and the edges of the upper ones hang towards smaller y; a crown's own axis leans up
    # to 15 degrees to the side.
    assert frame.rotation[2] @ [0.0, -1.0, 0.0] > np.cos(np.radians(15))


def test_transforms_are_inverse() -> None:
    frame = ToothFrame(Rotation.random(random_state=5).as_matrix(), np.array([1.0, 2.0, 3.0]))
    points = np.random.default_rng(0).normal(size=(10, 3))
    np.testing.assert_allclose(frame.world_from_canonical(frame.canonical_from_world(points)), points, atol=1e-12)
