"""From a COLMAP model to prepared images of an object: photographs through a lens with distortion, and their
calibration by ``dentine colmap``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from services.core.files.meshes import read_mesh, write_mesh
from services.core.geometry import Mesh
from services.core.records import FolderCapture, JobSpec, MaskBit
from services.core.results import PreparedManifest
from services.core.stage import LocalContext
from services.core.store import open_stage, read_record
from services.fit.measurements.levels import LevelReader
from services.phantom.object import write_object_phantom
from services.preprocess.stage import run_object
from tests.support.command_line import dentine

MM_PER_UNIT = 25.0
EXPOSURE_S = 0.1
RAW = """units = "mm"
calibration = {file = "calibration.json"}
camera = [{name = "c0", size = [%d, %d], channels = ["green"], bits = 16}]
light = [{name = "l0"}]
frame = [
  {camera = "c0", file = "black.npy", kind = "black", exposure_s = 0.1},
  {camera = "c0", file = "l0.npy", kind = "light", light = "l0", exposure_s = 0.1},
]
"""


def test_a_raw_folder_is_prepared_by_the_calibration_of_a_model(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap comes with the extra colmap")
    phantom, raw = tmp_path / "phantom", tmp_path / "raw"
    write_object_phantom(phantom, pixel_mm=0.5, cameras=1, lights=1, samples=16, held_out=0)
    truth = read_record(phantom / "capture.json", FolderCapture)
    (camera,), (light,) = truth.cameras, truth.lights
    K, pose, (width, height) = np.array(camera.K), np.array(camera.camera_from_world), camera.size

    # A model of this camera, whose unit is 25 mm.
    model = pycolmap.Reconstruction()
    lens = {"model": "RADIAL", "width": width, "height": height, "camera_id": 1}
    model.add_camera_with_trivial_rig(pycolmap.Camera(**lens, params=[K[0, 0], K[0, 2], K[1, 2], 4000.0, 0.0]))
    image = pycolmap.Image(name="all/c0.png", camera_id=1, image_id=1)
    model.add_image_with_trivial_frame(
        image, pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:3, :3]), pose[:3, 3] / MM_PER_UNIT)
    )
    (tmp_path / "sparse").mkdir()
    model.write_text(str(tmp_path / "sparse"))
    place = ",".join(str(value / MM_PER_UNIT) for value in light.position_mm)
    (tmp_path / "lights.csv").write_text(f"name,x,y,z,intensity\n{light.name},{place},{light.intensity[0]}\n")
    surface = read_mesh(phantom / "object" / "outer.ply")
    write_mesh(tmp_path / "mesh.ply", Mesh(surface.vertices_mm / MM_PER_UNIT, surface.faces))

    # A photograph whose radiance is linear in the direction of the undistorted ray.
    raw.mkdir()
    (raw / "raw.toml").write_text(RAW % camera.size)
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = model.cameras[1].cam_from_img(np.stack([x.ravel(), y.ravel()], axis=1)).reshape(height, width, 2)
    level = np.load(phantom / truth.images[0].file).max()
    shown = level * (1 + 40 * rays[..., 0] + 70 * rays[..., 1])
    per_count = float(level) * EXPOSURE_S / 30_000
    np.save(raw / "l0.npy", np.round(shown * EXPOSURE_S / per_count).astype(np.uint16)[..., None])
    np.save(raw / "black.npy", np.zeros((height, width, 1), np.uint16))

    ran = dentine(
        "colmap", "sparse", "--out", "raw/calibration.json", "--scale", str(MM_PER_UNIT), "--lights", "lights.csv",
        "--channels", "green", "--radiance-per-count", str(per_count), "--mesh", "mesh.ply", folder=tmp_path,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    spec = JobSpec(kind="object", capture=raw, boundary="matched", motion="off", highlights=False)
    run_object(spec, LocalContext(tmp_path / "job"))
    folder, manifest = open_stage(tmp_path / "job", "prepared", PreparedManifest)
    np.testing.assert_allclose(np.array(manifest.cameras[0].camera_from_world), pose, atol=1e-9)
    level_reader = LevelReader(folder / "prepared.zarr", 0, 1)
    found, _ = level_reader.image(0, 0, manifest.cameras[0])
    bits = level_reader.bits(0, 0, manifest.cameras[0])
    valid = bits & ~np.uint16(MaskBit.HIGHLIGHT) == 0
    assert valid.sum() > 100
    rows, columns = np.nonzero(valid)
    undistorted = (columns + 0.5 - K[0, 2]) / K[0, 0], (rows + 0.5 - K[1, 2]) / K[1, 1]
    expected = level * (1 + 40 * undistorted[0] + 70 * undistorted[1])
    # Linear interpolation over a pixel of a photograph that the lens curves by some 0.1 %.
    np.testing.assert_allclose(found[valid], expected, rtol=2e-3)
    # Without the lens the images would be off by more.
    assert np.abs(shown[valid] / expected - 1).max() > 0.01
