"""A COLMAP model as a calibration: lenses and poses against pycolmap and OpenCV, scale, lights, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.calibrate.photogrammetry.colmap import ColmapModel, KnownDistance, named_images
from services.calibrate.photogrammetry.lights_table import read_lights
from services.calibrate.photogrammetry.record import cameras_of, scale_of
from services.core.calibration.record import Calibration
from services.core.errors import CaptureInputError
from services.core.store import read_record
from tests.support.command_line import dentine

NOT_INSTALLED = "pycolmap comes with the extra colmap"
LENSES = {
    "SIMPLE_PINHOLE": [620.0, 321.5, 238.0],
    "PINHOLE": [620.0, 610.0, 321.5, 238.0],
    "SIMPLE_RADIAL": [620.0, 321.5, 238.0, -0.08],
    "RADIAL": [620.0, 321.5, 238.0, -0.08, 0.03],
    "OPENCV": [620.0, 610.0, 321.5, 238.0, -0.08, 0.03, 1e-3, -2e-3],
    "FULL_OPENCV": [620.0, 610.0, 321.5, 238.0, -0.08, 0.03, 1e-3, -2e-3, 0.01, 0.02, -0.01, 0.005],
}
SIZE = (640, 480)
MM_PER_UNIT = 37.5
ROUNDING_PX = 1e-9
"""Rounding of double precision in pixels of some hundreds, times the thousand operations of a lens."""


def write_model(folder: Path, lens: str = "OPENCV", kind: str = "bin") -> Any:
    """A model of five images by one camera, written by pycolmap, and pycolmap's own record of it."""
    pycolmap = pytest.importorskip("pycolmap", reason=NOT_INSTALLED)
    pycolmap.set_random_seed(3)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_points3D=40)
    options.camera_width, options.camera_height = SIZE
    options.camera_model_id = pycolmap.CameraModelId.__members__[lens]
    options.camera_params = LENSES.get(lens, [620.0, 610.0, 321.5, 238.0, 0.01, 0.0, 0.0, 0.0])
    model = pycolmap.synthesize_dataset(options)
    folder.mkdir(parents=True, exist_ok=True)
    (model.write_binary if kind == "bin" else model.write_text)(str(folder))
    return model


@pytest.mark.parametrize("kind", ["bin", "txt"])
@pytest.mark.parametrize("lens", LENSES)
def test_points_are_projected_as_by_pycolmap_and_by_opencv(tmp_path: Path, lens: str, kind: str) -> None:
    import cv2

    theirs = write_model(tmp_path, lens, kind)
    model = ColmapModel(tmp_path)
    assert len(model.images) == 5
    points = np.array([point.xyz for point in theirs.points3D.values()])
    for name in model.images[:2]:
        image, ours = theirs.find_image_with_name(name), model.camera(name, "left", MM_PER_UNIT)
        pose = np.array(ours.camera_from_world)
        expected = np.array([image.project_point(point) for point in points], dtype=np.float64)
        rotation = cv2.Rodrigues(pose[:3, :3])[0]
        distortion = np.array(ours.distortion) if ours.distortion is not None else None
        found, _ = cv2.projectPoints(points * MM_PER_UNIT, rotation, pose[:3, 3], np.array(ours.K), distortion)
        seen = np.isfinite(expected).all(axis=1)
        assert seen.sum() > 20
        np.testing.assert_allclose(found[seen, 0], expected[seen], atol=ROUNDING_PX)


@pytest.mark.parametrize("lens", ["SIMPLE_RADIAL", "OPENCV", "FULL_OPENCV"])
def test_photographs_are_undistorted_as_by_pycolmap(tmp_path: Path, lens: str) -> None:
    from services.preprocess.raw.lens import Lens
    from services.preprocess.views.window import Window

    theirs = write_model(tmp_path, lens)
    name = ColmapModel(tmp_path).images[0]
    camera = ColmapModel(tmp_path).camera(name, "left", MM_PER_UNIT)
    found = Lens(camera, (0.0, 0.0, 0.0)).distorted_positions(Window(0, SIZE[1], 0, SIZE[0]))
    assert found is not None
    rows, columns = np.mgrid[0 : SIZE[1] : 60, 0 : SIZE[0] : 60]
    K = np.array(camera.K)
    rays = np.stack([(columns + 0.5 - K[0, 2]) / K[0, 0], (rows + 0.5 - K[1, 2]) / K[1, 1]], axis=-1).reshape(-1, 2)
    theirs_camera = theirs.find_image_with_name(name).camera
    expected = np.array([theirs_camera.img_from_cam(np.append(ray, 1.0)) for ray in rays])
    # Single precision of pixel numbers up to 1000.
    np.testing.assert_allclose(found[rows.ravel(), columns.ravel()] + 0.5, expected, atol=1e-3)


def test_a_known_distance_between_points_or_images_scales_the_model(tmp_path: Path) -> None:
    theirs = write_model(tmp_path)
    model = ColmapModel(tmp_path)
    first, second, *_ = sorted(theirs.points3D)
    units = float(np.linalg.norm(theirs.points3D[first].xyz - theirs.points3D[second].xyz))
    known = KnownDistance(str(first), str(second), 42.0)
    assert scale_of(model, None, known) == pytest.approx(42.0 / units, rel=1e-12)
    a, b = (theirs.find_image_with_name(name).projection_center() for name in model.images[:2])
    scale = scale_of(model, None, KnownDistance(model.images[0], model.images[1], 90.0))
    cameras = cameras_of(model, (), scale)
    centres = [camera.rays(np.zeros(1), np.zeros(1))[0] for camera in cameras[:2]]
    assert scale == pytest.approx(90.0 / float(np.linalg.norm(a - b)), rel=1e-12)
    assert np.linalg.norm(centres[0] - centres[1]) == pytest.approx(90.0, rel=1e-9)


def test_the_command_writes_a_calibration_and_the_surface_in_mm(tmp_path: Path) -> None:
    import trimesh

    write_model(tmp_path / "sparse")
    name = ColmapModel(tmp_path / "sparse").images[1]
    (tmp_path / "lights.csv").write_text("name,x,y,z,intensity\nL1,0,1,-4,2.5\nL2,1,0,-4,3\n")
    trimesh.creation.box(extents=(0.2, 0.2, 0.2)).export(tmp_path / "box.ply")
    ran = dentine(
        "colmap", "sparse", "--out", "raw/calibration.json", "--scale", "50", "--lights", "lights.csv", "--channels",
        "green", "--camera", f"left={name}", "--radiance-per-count", "0.125", "--mesh", "box.ply", folder=tmp_path,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    record = read_record(tmp_path / "raw" / "calibration.json", Calibration)
    (camera,) = record.cameras
    assert (camera.name, camera.size, camera.radiance_per_count) == ("left", SIZE, (0.125,))
    assert record.lights[0].position_mm == (0.0, 50.0, -200.0)
    assert record.lights[1].intensity == (3.0,)
    assert record.inputs is not None
    assert {"cameras.bin", "images.bin", "lights.csv"} <= record.inputs.keys()
    surface = trimesh.load(tmp_path / "raw" / "object" / "outer.ply")
    np.testing.assert_allclose(surface.extents, 10.0, rtol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ((), "has no unit of length; give either --scale"),
        (("--scale", "0"), "must be more than 0 mm per unit"),
        (("--distance", "999999", "1", "5"), "has no 3D point 999999"),
        (("--distance", "absent.png", "1", "5"), "has no pose of image absent.png"),
        (("--distance", "1", "1", "5"), "1 and 1 lie at one place"),
        (("--scale", "1", "--camera", "left"), "--camera left is not CAMERA=IMAGE"),
        (("--scale", "1", "--camera", "a/b=absent.png"), "has no pose of image absent.png"),
        (("--scale", "1e9"), "mm away; its pose must be in millimetres"),
    ],
)
def test_what_a_model_lacks_is_one_sentence(tmp_path: Path, arguments: tuple[str, ...], told: str) -> None:
    write_model(tmp_path / "sparse")
    (tmp_path / "lights.csv").write_text("name;x;y;z\nL1;0;1;-4,5\n")
    given = ("colmap", "sparse", "--out", "calibration.json", "--lights", "lights.csv", *arguments)
    ran = dentine(*given, folder=tmp_path)
    assert ran.returncode == 2
    assert told in ran.stderr
    assert ran.stderr.count("\n") == 1
    assert not (tmp_path / "calibration.json").exists()


def test_a_lens_model_that_opencv_lacks_is_refused_by_name(tmp_path: Path) -> None:
    write_model(tmp_path, "OPENCV_FISHEYE")
    with pytest.raises(CaptureInputError, match="lens model OPENCV_FISHEYE, and only SIMPLE_PINHOLE, PINHOLE,"):
        cameras_of(ColmapModel(tmp_path), (), 1.0)


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda model: (model / "cameras.txt").write_text("1 WIDE 640 480 500 320 240\n"), "no lens model WIDE"),
        (lambda model: (model / "cameras.txt").write_text("1 PINHOLE 640 480 500\n"), "pycolmap says"),
        (lambda model: (model / "points3D.txt").unlink(), "pycolmap says"),
        (lambda model: (model / "cameras.txt").unlink(), "neither cameras.bin nor cameras.txt"),
    ],
)
def test_a_model_that_cannot_be_read_is_one_sentence(tmp_path: Path, spoil: Any, told: str) -> None:
    write_model(tmp_path, kind="txt")
    spoil(tmp_path)
    with pytest.raises(CaptureInputError, match=told):
        ColmapModel(tmp_path)


def test_images_name_their_cameras_and_each_camera_took_one() -> None:
    assert named_images(["a/left_1.jpg", "right.png"]) == {"left_1": "a/left_1.jpg", "right": "right.png"}
    assert named_images(["a/1.jpg", "b/1.jpg"], ["left=a/1.jpg"]) == {"left": "a/1.jpg"}
    with pytest.raises(CaptureInputError, match=r"Images a/1\.jpg and b/1\.jpg would both be of camera 1"):
        named_images(["a/1.jpg", "b/1.jpg"])


@pytest.mark.parametrize(
    ("table", "told"),
    [
        ("name,x,y\nL1,0,1\n", "lacks column z"),
        ("name,x,y,z,watt\nL1,0,1,2,3\n", "has column 'watt'"),
        ("name,x,y,z\nL1,0,1\n", "Line 2 of .* has 3 cells under 4 names"),
        ("name,x,y,z\nL1,0,one,2\n", "Line 2 of .* has 'one' as y"),
        ("name,x,y,z\nL1,0,nan,2\n", "Line 2 of .*: position_mm.1: "),
        ("name,x,y,z\n", "lists no light"),
        ("", "lacks column name"),
    ],
)
def test_a_wrong_table_of_lights_is_one_sentence(tmp_path: Path, table: str, told: str) -> None:
    (tmp_path / "lights.csv").write_text(table)
    with pytest.raises(CaptureInputError, match=told):
        read_lights(tmp_path / "lights.csv", ["red"])


def test_lights_have_an_intensity_for_each_channel(tmp_path: Path) -> None:
    (tmp_path / "lights.csv").write_text("name,x,y,z,intensity_red,intensity_blue\nL1,1,2,3,4,5\n")
    (light,) = read_lights(tmp_path / "lights.csv", ["blue", "red"], 10.0)
    assert (light.position_mm, light.intensity) == ((10.0, 20.0, 30.0), (5.0, 4.0))


def model_of(folder: Path, cameras: tuple[Any, ...], mm_per_unit: float) -> None:
    """A COLMAP model of cameras of a rig: image ``NAME.png`` of each, and three points about the subject."""
    pycolmap = pytest.importorskip("pycolmap", reason=NOT_INSTALLED)
    model = pycolmap.Reconstruction()
    for number, camera in enumerate(cameras, start=1):
        K, pose = np.array(camera.K), np.array(camera.camera_from_world)
        params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *(camera.distortion or (0.0,) * 4)[:4]]
        width, height = camera.size
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(model="OPENCV", width=width, height=height, params=params, camera_id=number)
        )
        image = pycolmap.Image(name=f"{camera.name}.png", camera_id=number, image_id=number)
        world = pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:3, :3]), pose[:3, 3] / mm_per_unit)
        model.add_image_with_trivial_frame(image, world)
    for point in ((0.0, 0.0, 0.0), (10.0, 0.0, 0.0), (0.0, 10.0, 0.0)):
        model.add_point3D(np.array(point) / mm_per_unit, pycolmap.Track(), np.zeros(3, np.uint8))
    folder.mkdir(parents=True)
    model.write_binary(str(folder))


def test_a_mirror_sphere_shows_the_lights_of_a_model(tmp_path: Path) -> None:
    from services.phantom.lab.rig import RigSize, true_rig
    from services.phantom.lab.sensor import Sensor
    from services.phantom.lab.session import write_session

    pytest.importorskip("pycolmap", reason=NOT_INSTALLED)
    sensor = Sensor(mosaic="none")
    rig = true_rig(RigSize((640, 480), 0.13, 2, 4), sensor.black, 1)
    write_session(tmp_path / "raw", rig, sensor, 1, n_boards=1, n_mirror=2, n_white=1)
    model_of(tmp_path / "sparse", rig.cameras, 25.0)
    given = ("colmap", "sparse", "--out", "calibration.json", "--scale", "25", "--raw", "raw")
    ran = dentine(*given, folder=tmp_path)
    assert ran.returncode == 0, ran.stderr
    record = read_record(tmp_path / "calibration.json", Calibration)
    assert [camera.name for camera in record.cameras] == [camera.name for camera in rig.cameras]
    assert all(camera.radiance_per_count is not None for camera in record.cameras)
    assert record.uncertainty is not None
    truth = {light.name: light for light in rig.lights}
    names, matrix = list(record.uncertainty.names), record.uncertainty.matrix
    off = []
    for light in record.lights:
        own = [names.index(f"light.{light.name}.{axis}") for axis in "xyz"]
        error = np.array(light.position_mm) - truth[light.name].position_mm
        off.append(np.linalg.solve(np.linalg.cholesky(matrix[np.ix_(own, own)]), error))
    # Twelve values: a rms of whitened errors beyond 1.7 has a chance below 0.1 %.
    assert np.sqrt(np.mean(np.square(off))) < 1.7
    # The photographs' noise and the lights' places leave about 1 % of the relative intensities open.
    found = np.array([light.intensity for light in record.lights])
    expected = np.array([truth[light.name].intensity for light in record.lights])
    np.testing.assert_allclose(found / found.mean(axis=0), expected / expected.mean(axis=0), rtol=0.05)


def test_lights_are_told_in_one_way(tmp_path: Path) -> None:
    write_model(tmp_path / "sparse")
    ran = dentine("colmap", "sparse", "--out", "calibration.json", "--scale", "1", folder=tmp_path)
    assert (ran.returncode, "by either --lights or --raw" in ran.stderr) == (2, True)
