"""A virtual jaw from the command that writes it to the prepared store: surface and mask of every pixel agree with a ray
tracer.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import zarr
from numpy.typing import NDArray
from typer.testing import CliRunner

from services.cli.app import build_app
from services.core.errors import CaptureInputError, MeshError
from services.core.files.meshes import read_mesh, read_teeth, write_mesh
from services.core.geometry import Camera, Mesh
from services.core.records import FolderCapture, JobSpec, MaskBit
from services.core.results import PreparedManifest
from services.core.stage import LocalContext
from services.core.store import read_record
from services.preprocess.stage import run
from services.transport.rays import RayScene, pixel_rays

FDI = (*range(11, 18), *range(21, 28))
GUMS, CAVITY = len(FDI), len(FDI) + 1


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("jaw") / "capture"
    options = "--jaw --subject 1 --pixel-mm 2 --cameras 2 --lights 2 --held-out 1 --samples 64"
    outcome = CliRunner().invoke(
        build_app(), ["phantom", "--out", str(folder), *options.split()], catch_exceptions=False
    )
    assert outcome.exit_code == 0
    return folder


def prepare(
    capture: Path, root: Path, kind: str = "jaw", log: list[str] | None = None
) -> tuple[PreparedManifest, dict[str, NDArray[Any]]]:
    spec = JobSpec.model_validate({"kind": kind, "capture": capture})
    manifest = run(spec, LocalContext(root, listener=None if log is None else lambda event: log.append(event.message)))
    store = root / "prepared" / "prepared.zarr"
    return manifest, {
        name: np.asarray(zarr.open_array(store / name, mode="r"))
        for name in ("radiance", "variance", "valid", "surface")
    }


@pytest.fixture(scope="module")
def scene(capture: Path) -> RayScene:
    return RayScene(
        *(tooth.outer for tooth in read_teeth(capture)),
        read_mesh(capture / "gums.ply"),
        read_mesh(capture / "cavity.ply"),
    )


def first_surface(scene: RayScene, camera: Camera, offset: tuple[float, float]) -> NDArray[np.int64]:
    """Index (H, W) of the surface that a ray through each pixel hits first, -1 for none."""
    hits = scene.first_hits(*pixel_rays(camera, offset))
    return np.where(hits.hit, hits.mesh, -1).reshape(camera.size[::-1])


@pytest.mark.dear("It waits for the jaw that the command writes: the engine renders fourteen teeth.")
def test_the_folder_says_what_it_shows(capture: Path) -> None:
    description = read_record(capture / "capture.json", FolderCapture)
    assert len(description.images) == 4
    assert {entry.light for entry in description.images if entry.held_out} == {"l1"}
    assert tuple(tooth.fdi for tooth in read_teeth(capture)) == FDI
    assert all(tooth.dentin is not None for tooth in read_teeth(capture))
    truth = json.loads((capture / "truth.json").read_text())
    green = truth["channels"]["green"]
    assert set(green["teeth"]) == {str(number) for number in FDI}
    assert set(green["teeth"]["11"]) == {"enamel", "dentin"}
    assert set(green["gums"]) >= {"sigma", "alpha", "beta", "g1", "g2", "sigma_s_reduced", "alpha_reduced"}
    assert 0 < green["cavity_reflectance"] < 1
    assert (truth["subject"], truth["renderer"], truth["boundary"]) == (1, "engine", "matched")
    for entry in description.images:
        image = np.load(capture / entry.file)
        assert image.dtype == np.float32
        assert (image >= 0).all()
    assert max(np.load(capture / entry.file).max() for entry in description.images) > 0.02


def test_everything_but_the_background_is_valid_for_a_jaw(capture: Path, scene: RayScene, tmp_path: Path) -> None:
    manifest, arrays = prepare(capture, tmp_path)
    assert (manifest.fdi, manifest.gums, manifest.cavity, manifest.dentin_known) == (FDI, True, True, FDI)
    for part in ("gums.ply", "cavity.ply", "teeth/17/dentin.ply"):
        assert (tmp_path / "prepared" / part).read_bytes() == (capture / part).read_bytes()
    shown: set[int] = set()
    for k, camera in enumerate(manifest.cameras):
        width, height = camera.size
        surface, valid = arrays["surface"][k, :height, :width], arrays["valid"][k, :, :height, :width]
        traced = first_surface(scene, camera, (0.5, 0.5))
        # A ray along an edge may hit either side of it; the z-buffer counts edges as inside.
        assert np.count_nonzero(surface != traced) <= 2
        shown |= set(surface.reshape(-1).tolist())
        met = [first_surface(scene, camera, offset) >= 0 for offset in ((0.5, 0.5), (0, 0), (1, 0), (0, 1), (1, 1))]
        outside = valid & MaskBit.OUTSIDE > 0
        assert all(np.count_nonzero(one != ~np.all(met, axis=0)) <= 2 for one in outside)
        assert (arrays["surface"][k, height:] == -1).all()
        # Of the other pixels only unlit ones, whose variance is 0, are not valid, because a matched surface has no
        # highlights.
        assert set(np.unique(valid[~outside]).tolist()) <= {0, int(MaskBit.NOT_FINITE)}
        dark = arrays["variance"][k, :, :height, :width, 0] == 0
        assert np.array_equal(valid & MaskBit.NOT_FINITE > 0, dark)
    assert shown >= {-1, GUMS, CAVITY, FDI.index(11), FDI.index(21)}
    counted = [
        int(np.count_nonzero((arrays["valid"] == 0) & (arrays["surface"][:, None] == number)))
        for number in range(len(FDI))
    ]
    assert manifest.tooth_pixels == tuple(counted)
    assert min(counted[FDI.index(number)] for number in (11, 12, 13, 21, 22, 23)) > 0


def test_gums_are_in_the_way_where_teeth_alone_are_fitted(capture: Path, scene: RayScene, tmp_path: Path) -> None:
    manifest, arrays = prepare(capture, tmp_path, kind="tooth")
    assert (manifest.gums, manifest.cavity) == (False, False)
    for k, camera in enumerate(manifest.cameras):
        width, height = camera.size
        traced = first_surface(scene, camera, (0.5, 0.5))
        surface = arrays["surface"][k, :height, :width]
        assert np.count_nonzero(surface != np.where(traced < GUMS, traced, -1)) <= 2
        assert ((arrays["valid"][k, :, :height, :width] & MaskBit.OUTSIDE > 0) | (surface >= 0)).all()


def test_a_hidden_tooth_is_named_and_does_no_harm(capture: Path, tmp_path: Path) -> None:
    description = read_record(capture / "capture.json", FolderCapture)
    side = description.cameras[0]
    images = tuple(entry for entry in description.images if entry.camera == side.name)
    shutil.copytree(capture, tmp_path / "capture")
    one = description.model_copy(update={"cameras": (side,), "images": images})
    (tmp_path / "capture" / "capture.json").write_text(one.model_dump_json())
    log: list[str] = []
    manifest, _ = prepare(tmp_path / "capture", tmp_path, log=log)
    pixels = dict(zip(manifest.fdi, manifest.tooth_pixels, strict=True))
    # Seen from the patient's right, the last teeth on the left are hidden by the front ones.
    assert pixels[27] == 0 < pixels[11]
    (line,) = [message for message in log if "nothing will be known" in message]
    assert "27" in line
    assert "11" not in line.split("tooth")[1]


def test_surroundings_that_bound_nothing_are_refused(capture: Path, tmp_path: Path) -> None:
    gums = read_mesh(capture / "gums.ply")

    def with_gums(name: str, mesh: Mesh) -> Path:
        shutil.copytree(capture, tmp_path / name)
        write_mesh(tmp_path / name / "gums.ply", mesh)
        return tmp_path / name

    with pytest.raises(MeshError, match=r"gums\.ply is not watertight"):
        prepare(with_gums("open", Mesh(gums.vertices_mm, gums.faces[1:])), tmp_path / "a")
    with pytest.raises(MeshError, match=r"gums\.ply is 0\.06.* units across"):
        prepare(with_gums("metres", Mesh(gums.vertices_mm / 1000, gums.faces)), tmp_path / "b")
    # These gums cover all teeth.
    cover = trimesh.creation.icosphere(radius=45.0)
    with pytest.raises(CaptureInputError, match="No tooth projects"):
        prepare(
            with_gums("cover", Mesh(np.asarray(cover.vertices), np.asarray(cover.faces, dtype=np.int32))),
            tmp_path / "c",
        )
