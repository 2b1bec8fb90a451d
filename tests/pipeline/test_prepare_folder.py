"""Import of folder captures: the real incisor's, and everything that can be wrong with one."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import zarr

from services.core.errors import CaptureInputError, DentineError, MeshError, SettingsError
from services.core.files.meshes import write_mesh
from services.core.geometry import Mesh
from services.core.records import JobSpec, MaskBit, PreparedManifest
from services.core.stage import LocalContext
from services.core.store import open_stage
from services.preprocess.stage import run
from tests.support.shared_data import shared_path

Tree = dict[str, Any]


def write_folder(root: Path) -> Tree:
    """A minimal capture: a ball, two cameras of different size, two lights, two channels."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=4)
    write_mesh(
        root / "teeth" / "11" / "outer.ply", Mesh(np.asarray(ball.vertices), np.asarray(ball.faces, dtype=np.int32))
    )
    tree: Tree = {"units": "mm", "channels": ["green", "blue"], "cameras": [], "lights": [], "images": []}
    for name, size in (("front", (20, 16)), ("side", (24, 18))):
        K = [[1500, 0, size[0] / 2], [0, 1500, size[1] / 2], [0, 0, 1]]
        pose = np.eye(4)
        pose[2, 3] = 1000
        tree["cameras"].append({"name": name, "size": size, "K": K, "camera_from_world": pose.tolist()})
    for k, name in enumerate(("left", "right")):
        tree["lights"].append({"name": name, "position_mm": [(-900, 900)[k], 0, -400], "intensity": [1e6, 1e6]})
    rng = np.random.default_rng(3)
    for camera in tree["cameras"]:
        for light in tree["lights"]:
            file = f"{camera['name']}_{light['name']}.npy"
            width, height = camera["size"]
            np.save(root / file, rng.uniform(0.5, 1, (height, width, 2)).astype(np.float32))
            tree["images"].append({"camera": camera["name"], "light": light["name"], "file": file})
    write_tree(root, tree)
    return tree


def write_tree(root: Path, tree: Tree) -> None:
    (root / "capture.json").write_text(json.dumps(tree))


def prepare(folder: Path, root: Path, **options: Any) -> PreparedManifest:
    return run(JobSpec(capture=folder, **options), LocalContext(root))


def test_incisor_imports_whole(tmp_path: Path) -> None:
    """Valid pixels are those that ray tracing of centres and corners gives; images and variances arrive bit by bit."""
    folder = shared_path("data/tooth-ur1-truth")
    manifest = prepare(folder, tmp_path, boundary="matched", dentin="known")
    published, _ = open_stage(tmp_path, "prepared", PreparedManifest)
    radiance, variance, valid = (
        zarr.open_array(published / "prepared.zarr" / name, mode="r") for name in ("radiance", "variance", "valid")
    )
    assert radiance.shape == (3, 8, 34, 28, 1)
    assert valid.metadata.dimension_names == ("camera", "light", "y", "x")
    counts = (np.asarray(valid) == 0).sum(axis=(2, 3))
    np.testing.assert_array_equal(counts, np.repeat([[367], [380], [370]], 8, axis=1))
    np.testing.assert_array_equal(radiance[2, 5], np.load(folder / "c2_l5.npy"))
    np.testing.assert_array_equal(variance[1, 3], np.load(folder / "c1_l3_var.npy"))
    assert set(manifest.held_out) == {(f"c{k}", f"l{j}") for k in range(3) for j in (5, 6, 7)}
    assert (manifest.fdi, manifest.dentin_known, manifest.median_motion_px, manifest.valid_fraction) == (
        (11,),
        (11,),
        None,
        1.0,
    )
    assert (published / "teeth" / "11" / "dentin.ply").is_file()


def test_noise_model_fills_in_for_missing_variance(tmp_path: Path) -> None:
    write_folder(tmp_path)
    prepare(tmp_path, tmp_path / "job", sensor_noise_relative=0.03, sensor_noise_floor=0.01)
    image = np.load(tmp_path / "front_right.npy").astype(np.float64)
    variance = zarr.open_array(tmp_path / "job" / "prepared" / "prepared.zarr" / "variance", mode="r")
    np.testing.assert_allclose(variance[0, 1, :16, :20], (0.03 * image) ** 2 + (0.01 * image.max()) ** 2, rtol=1e-5)


def test_padding_and_absent_pairs_are_not_valid(tmp_path: Path) -> None:
    tree = write_folder(tmp_path)
    tree["images"] = tree["images"][:-1]
    write_tree(tmp_path, tree)
    prepare(tmp_path, tmp_path / "job")
    valid = np.asarray(zarr.open_array(tmp_path / "job" / "prepared" / "prepared.zarr" / "valid", mode="r"))
    assert valid.shape == (2, 2, 18, 24)
    assert (valid[0, :, 16:] == MaskBit.OUTSIDE).all()
    assert (valid[0, :, :, 20:] == MaskBit.OUTSIDE).all()
    assert (valid[1, 1] & MaskBit.UNLIT > 0).all()
    assert (valid[1, 0] == 0).any()


def test_few_dead_pixels_and_zero_variance_are_masked(tmp_path: Path) -> None:
    tree = write_folder(tmp_path)
    image = np.load(tmp_path / "front_left.npy")
    image[8, 10, 0] = np.nan
    np.save(tmp_path / "front_left.npy", image)
    variance = np.full((16, 20, 2), 1e-4, dtype=np.float32)
    variance[8, 11] = 0
    np.save(tmp_path / "variance.npy", variance)
    tree["images"][0]["variance_file"] = "variance.npy"
    write_tree(tmp_path, tree)
    prepare(tmp_path, tmp_path / "job")
    store = tmp_path / "job" / "prepared" / "prepared.zarr"
    valid, radiance = (np.asarray(zarr.open_array(store / name, mode="r")) for name in ("valid", "radiance"))
    assert (valid[0, 0, 8, [10, 11]] & MaskBit.NOT_FINITE > 0).all()
    assert valid[0, 0, 8, 9] & MaskBit.NOT_FINITE == 0
    assert np.isfinite(radiance).all()


def test_a_dark_image_is_left_out_and_said(tmp_path: Path) -> None:
    tree = write_folder(tmp_path)
    np.save(tmp_path / "side_left.npy", 1e-3 * np.random.default_rng(1).standard_normal((18, 24, 2)).astype(np.float32))
    np.save(tmp_path / "variance.npy", np.full((18, 24, 2), 1e-6, dtype=np.float32))
    tree["images"][2]["variance_file"] = "variance.npy"
    write_tree(tmp_path, tree)
    manifest = prepare(tmp_path, tmp_path / "job")
    assert [note for note in manifest.notes if note.startswith("Dark and left out: camera side under light left;")]
    valid = np.asarray(zarr.open_array(tmp_path / "job" / "prepared" / "prepared.zarr" / "valid", mode="r"))
    assert (valid[1, 0] & MaskBit.UNLIT > 0).all()
    assert (valid[1, 1] == 0).any()


def test_a_light_unlike_the_others_is_said(tmp_path: Path) -> None:
    tree = write_folder(tmp_path)
    assert prepare(tmp_path, tmp_path / "before").notes == ()
    tree["lights"][1]["intensity"] = [1e8, 1e8]
    write_tree(tmp_path, tree)
    (note,) = prepare(tmp_path, tmp_path / "job").notes
    assert "under light " in note
    assert "check both" in note


def test_broken_pixels_are_counted_and_said(tmp_path: Path) -> None:
    write_folder(tmp_path)
    for name, rows in (("front_left", slice(6, 8)), ("side_right", slice(7, 11))):
        image = np.load(tmp_path / f"{name}.npy")
        image[rows] = np.nan
        np.save(tmp_path / f"{name}.npy", image)
    manifest = prepare(tmp_path, tmp_path / "job")
    published, _ = open_stage(tmp_path / "job", "prepared", PreparedManifest)
    valid = np.asarray(zarr.open_array(published / "prepared.zarr" / "valid", mode="r"))
    lost = ((valid & MaskBit.NOT_FINITE > 0) & (valid & MaskBit.OUTSIDE == 0)).sum(axis=(2, 3))
    assert lost[0, 0] > 0
    (note,) = manifest.notes
    assert note.startswith(f"{lost.sum()} pixels of teeth in 2 images have no finite value")
    assert f"({lost.max()}) in camera side under light right" in note


def test_held_out_lights_of_the_job_replace_the_captures(tmp_path: Path) -> None:
    tree = write_folder(tmp_path)
    tree["images"][0]["held_out"] = True
    write_tree(tmp_path, tree)
    assert prepare(tmp_path, tmp_path / "own").held_out == (("front", "left"),)
    assert prepare(tmp_path, tmp_path / "asked", held_out_lights=("right",)).held_out == (
        ("front", "right"),
        ("side", "right"),
    )
    assert prepare(tmp_path, tmp_path / "none", held_out_lights=()).held_out == ()


def edit(change: Callable[[Tree], object]) -> Callable[[Path, Tree], None]:
    def damage(root: Path, tree: Tree) -> None:
        change(tree)
        write_tree(root, tree)

    return damage


def replace_image(make: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path, Tree], None]:
    return lambda root, _: np.save(root / "side_left.npy", make(np.load(root / "side_left.npy")))


def rescale_mesh(factor: float) -> Callable[[Path, Tree], None]:
    def damage(root: Path, _: Tree) -> None:
        ball = trimesh.creation.icosphere(subdivisions=3, radius=4 * factor)
        write_mesh(
            root / "teeth" / "11" / "outer.ply", Mesh(np.asarray(ball.vertices), np.asarray(ball.faces, dtype=np.int32))
        )

    return damage


def open_mesh(root: Path, _: Tree) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=4)
    write_mesh(
        root / "teeth" / "11" / "outer.ply", Mesh(np.asarray(ball.vertices), np.asarray(ball.faces[3:], dtype=np.int32))
    )


def darken_all(root: Path, tree: Tree) -> None:
    np.save(root / "noise.npy", np.full((18, 24, 2), 1e-4, dtype=np.float32))
    tree["cameras"][0]["size"] = tree["cameras"][1]["size"]
    for image in tree["images"]:
        np.save(
            root / image["file"],
            1e-2 * np.random.default_rng(len(image["file"])).standard_normal((18, 24, 2)).astype(np.float32),
        )
        image["variance_file"] = "noise.npy"
    write_tree(root, tree)


def move_camera(distance: float) -> Callable[[Tree], object]:
    return lambda tree: tree["cameras"][1]["camera_from_world"][2].__setitem__(3, distance)


def rename_camera(tree: Tree, name: str) -> None:
    for image in tree["images"]:
        image["camera"] = name if image["camera"] == tree["cameras"][0]["name"] else image["camera"]
    tree["cameras"][0]["name"] = name


def npy(header: bytes) -> bytes:
    """A .npy file with this header and no content."""
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header


def declare(shape: tuple[int, ...]) -> Callable[[Path, Tree], object]:
    header = repr({"descr": "<f4", "fortran_order": False, "shape": shape}).encode() + b"\n"
    return lambda root, _: (root / "side_left.npy").write_bytes(npy(header))


def double_mesh(root: Path, _: Tree) -> None:
    path = root / "teeth" / "11" / "outer.ply"
    ball = trimesh.load_mesh(path)
    moved = ball.copy()
    moved.apply_translation((1.0, 0.0, 0.0))
    (ball + moved).export(path)


BAD: dict[str, tuple[Callable[[Path, Tree], object], type[DentineError], str]] = {
    "missing file": (
        lambda root, _: (root / "front_right.npy").unlink(),
        CaptureInputError,
        r"front_right\.npy \(camera front, light right\) does not exist",
    ),
    "truncated file": (
        lambda root, _: (root / "side_left.npy").write_bytes((root / "side_left.npy").read_bytes()[:300]),
        CaptureInputError,
        r"side_left\.npy \(camera side, light left\) cannot be read .*truncated",
    ),
    "not a file of arrays": (
        lambda root, _: (root / "side_left.npy").write_bytes(b""),
        CaptureInputError,
        r"side_left\.npy .*cannot be read",
    ),
    "wrong shape": (
        replace_image(lambda image: image[1:]),
        CaptureInputError,
        r"side_left\.npy .* shape \(17, 24, 2\) instead of \(18, 24, 2\)",
    ),
    "whole numbers": (
        replace_image(lambda image: (255 * image).astype(np.uint8)),
        CaptureInputError,
        r"side_left\.npy .*floating-point radiance",
    ),
    "NaN": (
        replace_image(lambda image: image * np.nan),
        CaptureInputError,
        r"side_left\.npy \(camera side, light left\) is not finite at \d+ tooth pixels",
    ),
    "no image": (edit(lambda tree: tree.update(images=[])), CaptureInputError, r"lists no image"),
    "unknown camera": (
        edit(lambda tree: tree["images"][1].update(camera="rear")),
        CaptureInputError,
        r"front_right\.npy names camera rear",
    ),
    "unknown light": (
        edit(lambda tree: tree["images"][1].update(light="sun")),
        CaptureInputError,
        r"front_right\.npy names light sun",
    ),
    "same pair twice": (
        edit(lambda tree: tree["images"].append(tree["images"][0])),
        CaptureInputError,
        r"camera front under light left twice",
    ),
    "same light twice": (
        edit(lambda tree: tree["lights"].append(tree["lights"][0])),
        CaptureInputError,
        r"light left twice",
    ),
    "channel without intensity": (
        edit(lambda tree: tree["lights"][1].update(intensity=[1e6])),
        CaptureInputError,
        r"light right has 1 intensities for 2",
    ),
    "other format": (
        edit(lambda tree: tree["images"][0].update(file="capture.json")),
        CaptureInputError,
        r"no \.npy file",
    ),
    "file elsewhere": (
        edit(lambda tree: tree["images"][0].update(file="../secret.npy")),
        CaptureInputError,
        r"secret\.npy lies outside",
    ),
    "camera whose name leads elsewhere": (
        edit(lambda tree: rename_camera(tree, "../../c0")),
        CaptureInputError,
        r"cameras\.0\.name: a name has 1 to 64 bytes",
    ),
    "light whose name leads elsewhere": (
        edit(lambda tree: tree["lights"][1].update(name="/tmp/l")),
        CaptureInputError,
        r"lights\.1\.name: .* no slash",
    ),
    "channel without a name": (
        edit(lambda tree: tree.update(channels=["green", ""])),
        CaptureInputError,
        r"channels\.1: a name has 1 to 64 bytes",
    ),
    "not JSON": (lambda root, _: (root / "capture.json").write_text("{"), CaptureInputError, r"capture\.json"),
    "other units": (edit(lambda tree: tree.update(units="m")), CaptureInputError, r"capture\.json: units"),
    "no mesh": (
        lambda root, _: (root / "teeth" / "11" / "outer.ply").unlink(),
        CaptureInputError,
        r"outer\.ply does not exist",
    ),
    "mesh in metres": (rescale_mesh(1e-3), MeshError, r"teeth/11/outer\.ply is 0\.008 units across.*rescale"),
    "mesh with holes": (open_mesh, MeshError, r"teeth/11/outer\.ply is not watertight"),
    "pose in metres": (edit(move_camera(1.0)), CaptureInputError, r"Camera side stands 1 mm from the teeth"),
    "pose in micrometres": (edit(move_camera(1e6)), CaptureInputError, r"teeth span 0\.012 px in camera side"),
    "light in metres": (
        edit(lambda tree: tree["lights"][0].update(position_mm=[-0.9, 0, -0.4])),
        CaptureInputError,
        r"Light left stands 0\.985 mm",
    ),
    "light in micrometres": (
        edit(
            lambda tree: [light.update(position_mm=[1e3 * x for x in light["position_mm"]]) for light in tree["lights"]]
        ),
        CaptureInputError,
        r"times as bright as a white surface .* positions in mm",
    ),
    "intensity in metres": (
        edit(lambda tree: [light.update(intensity=[1.0, 1.0]) for light in tree["lights"]]),
        CaptureInputError,
        r"times as bright as a white surface .* intensities per steradian with mm",
    ),
    "all images dark": (darken_all, CaptureInputError, r"Every image of .* is dark.*check exposure, lights"),
    "header beyond all memory": (
        declare((10**9, 10**9, 2)),
        CaptureInputError,
        r"side_left\.npy \(camera side, light left\) cannot be read as npy",
    ),
    "header beyond all integers": (declare((10**40, 3)), CaptureInputError, r"side_left\.npy .*cannot be read as npy"),
    "header of brackets": (
        lambda root, _: (root / "side_left.npy").write_bytes(npy(b"(" * 5000)),
        CaptureInputError,
        r"side_left\.npy .*cannot be read as npy",
    ),
    "camera beyond all memory": (
        edit(lambda tree: tree["cameras"][1].update(size=[2 * 10**9, 1])),
        CaptureInputError,
        r"camera side has 2000000000 x 1 pixels",
    ),
    "dark light": (
        edit(lambda tree: tree["lights"][1].update(intensity=[1e6, 0.0])),
        CaptureInputError,
        r"light right has intensity 0 in channel blue",
    ),
    "NUL in a path": (
        edit(lambda tree: tree["images"][0].update(file="a\0.npy")),
        CaptureInputError,
        r"images\.0\.file: .*character NUL",
    ),
    "a tooth that nobody has": (
        lambda root, _: (root / "teeth" / "11").rename(root / "teeth" / "99"),
        CaptureInputError,
        r"tooth 99, which is no FDI number",
    ),
    "a tooth that no integer names": (
        lambda root, _: (root / "teeth" / "11").rename(root / "teeth" / "\u00b2"),
        CaptureInputError,
        r"No tooth mesh",
    ),
    "mesh in fifths of a mm": (
        rescale_mesh(6.0),
        MeshError,
        r"teeth/11/outer\.ply is 48 units across, outside 2 to 45 mm",
    ),
    "two shells in each other": (double_mesh, MeshError, r"teeth/11/outer\.ply holds 2 separate shells"),
    "two teeth in each other": (
        lambda root, _: shutil.copytree(root / "teeth" / "11", root / "teeth" / "12"),
        MeshError,
        r"Teeth 11 and 12 lie in each other",
    ),
    "lights beyond any rig": (
        edit(lambda tree: tree["lights"].extend({**tree["lights"][0], "name": f"l{k}"} for k in range(10_000))),
        CaptureInputError,
        r"lists 10002 lights, more than any rig has \(1000\)",
    ),
    "beyond single precision": (
        replace_image(lambda image: image.astype(np.float64) * 1e200),
        CaptureInputError,
        r"side_left\.npy .* beyond single precision",
    ),
    "negative focal length": (
        edit(lambda tree: tree["cameras"][1]["K"][0].__setitem__(0, -1500)),
        CaptureInputError,
        r"camera side has focal lengths K\[0\]\[0\] = -1500",
    ),
    "matrix of another kind": (
        edit(lambda tree: tree["cameras"][1]["K"][2].__setitem__(2, 2)),
        CaptureInputError,
        r"camera side has a K that is not",
    ),
    "pose without its last row": (
        edit(lambda tree: tree["cameras"][1]["camera_from_world"][3].__setitem__(3, 0)),
        CaptureInputError,
        r"last row of camera_from_world",
    ),
    "channel twice": (
        edit(lambda tree: tree.update(channels=["green", "green"])),
        CaptureInputError,
        r"lists channel green twice",
    ),
    "tooth out of view": (
        edit(lambda tree: tree["cameras"][0]["camera_from_world"][0].__setitem__(3, 300.0)),
        CaptureInputError,
        r"No tooth .* camera front",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_ends_in_one_sentence(case: str, tmp_path: Path) -> None:
    folder, job = tmp_path / "capture", tmp_path / "job"
    folder.mkdir()
    damage, kind, pattern = BAD[case]
    damage(folder, write_folder(folder))
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    with pytest.raises(kind, match=pattern) as caught:
        prepare(folder, job)
    assert caught.value.message.endswith(".")
    assert "\n" not in caught.value.message
    assert not (job / "prepared").exists()
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_a_camera_may_be_named_in_any_script(tmp_path: Path) -> None:
    tree = write_folder(tmp_path)
    rename_camera(tree, "Kamera 2.1 – öben")
    write_tree(tmp_path, tree)
    assert prepare(tmp_path, tmp_path / "job").cameras[0].name == "Kamera 2.1 – öben"
    assert (tmp_path / "job" / "prepared" / "quality" / "Kamera 2.1 – öben_left.png").is_file()


@pytest.mark.parametrize(
    ("options", "pattern"),
    [
        ({"held_out_lights": ("sun",)}, r"'held_out_lights' names sun, but the capture has left, right"),
        ({"held_out_lights": ("left", "right")}, r"keeps every light from the fit"),
        ({"channels": ()}, r"'channels' is empty"),
        ({"channels": ("red",)}, r"'channels' names red, but the capture has green, blue"),
    ],
)
def test_options_that_do_not_fit_the_capture(options: Tree, pattern: str, tmp_path: Path) -> None:
    write_folder(tmp_path)
    with pytest.raises(SettingsError, match=pattern):
        prepare(tmp_path, tmp_path / "job", **options)


def test_a_failed_import_leaves_the_published_one(tmp_path: Path) -> None:
    write_folder(tmp_path)
    first = prepare(tmp_path, tmp_path / "job")
    (tmp_path / "front_left.npy").unlink()
    with pytest.raises(CaptureInputError):
        prepare(tmp_path, tmp_path / "job")
    assert open_stage(tmp_path / "job", "prepared", PreparedManifest)[1] == first


def test_lights_without_an_image_are_told(tmp_path: Path) -> None:
    tree = write_folder(tmp_path)
    tree["lights"].extend({**tree["lights"][0], "name": f"spare{k}"} for k in range(5))
    write_tree(tmp_path, tree)
    notes = prepare(tmp_path, tmp_path / "job").notes
    assert [note for note in notes if "spare0, spare1, spare2 and 2 more" in note]


def test_neither_folder_nor_store(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(CaptureInputError, match=r"holds neither capture\.json nor a published capture"):
        prepare(tmp_path / "empty", tmp_path / "job")
    with pytest.raises(CaptureInputError, match=r"capture\.json does not exist"):
        prepare(tmp_path / "absent", tmp_path / "job")
