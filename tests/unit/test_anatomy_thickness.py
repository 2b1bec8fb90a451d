"""Enamel thickness against published figures of a real tooth."""

from __future__ import annotations

import numpy as np
import pytest

from services.core.meshfiles import read_mesh
from services.core.records import FolderCapture
from services.core.store import read_record
from services.fit.anatomy.incisor import build_incisor
from services.fit.anatomy.rig import dome_cameras
from services.fit.anatomy.thickness import enamel_thickness_mm, thickness_image
from tests.support.shared_data import shared_path


def test_the_real_incisors_figures() -> None:
    folder = shared_path("data/tooth-ur1")
    thickness = enamel_thickness_mm(read_mesh(folder / "UR1_enamel.ply").vertices_mm, read_mesh(folder / "UR1_dentin.ply"))
    # Published to three digits; a candidate triangle missed near an edge costs up to spacing^2 / 2d = 0.005 mm.
    assert thickness.mean() == pytest.approx(0.653, abs=0.002)
    assert np.percentile(thickness, 95) == pytest.approx(1.066, abs=0.003)
    assert thickness.max() == pytest.approx(1.34, abs=0.006)
    assert np.mean(thickness < 0.05) == pytest.approx(0.06, abs=0.005)


def test_the_image_shows_what_the_camera_sees() -> None:
    tooth = build_incisor()
    (camera,) = dome_cameras(1, 0.5, (tooth.outer,))
    image = thickness_image(tooth.outer, tooth.dentin, camera)
    width, height = camera.size
    assert image.shape == (height, width)
    assert np.isnan(image[[0, -1]]).all()
    assert np.isnan(image[:, [0, -1]]).all()
    # The silhouette's area at half-millimetre pixels.
    assert np.isfinite(image).sum() * 0.25 == pytest.approx(105, abs=6)
    # Thin over the root at the top of the picture, thick towards the incisal edge at its bottom.
    rows = np.array([np.nanmedian(row) for row in image[4:-4]])
    assert rows[0] < 0.2
    assert rows[-1] > 0.9


def test_the_image_of_the_scanned_tooth_has_its_pixels() -> None:
    root = shared_path("data/tooth-ur1-truth")
    capture = read_record(root / "capture.json", FolderCapture)
    outer, dentin = (read_mesh(root / f"teeth/11/{name}.ply") for name in ("outer", "dentin"))
    image = thickness_image(outer, dentin, capture.cameras[0])
    lit = np.load(root / "c0_l0.npy")[..., 0] > 0
    # Every pixel whose centre sees the tooth is lit through it; a lit rim pixel's centre may miss it.
    assert not np.any(np.isfinite(image) & ~lit)
    assert np.isfinite(image).sum() > 0.8 * lit.sum()
