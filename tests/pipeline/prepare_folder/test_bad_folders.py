"""Folders that cannot be prepared end in one sentence that names the file and the remedy."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from services.core.errors import CaptureInputError, DentineError, MeshError, SettingsError
from services.core.files.meshes import write_mesh
from services.core.geometry import Mesh
from tests.support.folder_captures import Tree, prepare, rename_camera, write_folder, write_tree


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


@pytest.mark.parametrize(
    ("options", "pattern"),
    [
        ({"held_out_lights": ("sun",)}, r"'held_out_lights' names sun, but the capture has left, right"),
        ({"held_out_lights": ("left", "right")}, r"keeps every light from the fit"),
        ({"held_out_cameras": ("moon",)}, r"'held_out_cameras' names moon, but the capture has front, side"),
        ({"held_out_cameras": ("front", "side")}, r"keeps every camera from the fit"),
        ({"channels": ()}, r"'channels' is empty"),
        ({"channels": ("red",)}, r"'channels' names red, but the capture has green, blue"),
    ],
)
def test_options_that_do_not_fit_the_capture(options: Tree, pattern: str, tmp_path: Path) -> None:
    write_folder(tmp_path)
    with pytest.raises(SettingsError, match=pattern):
        prepare(tmp_path, tmp_path / "job", **options)
