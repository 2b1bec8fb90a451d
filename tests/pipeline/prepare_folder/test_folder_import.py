"""Result of importing a folder capture: radiance, noise, masks, and messages."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import zarr
from zarr.core.metadata import ArrayV3Metadata

from services.core.errors import CaptureInputError
from services.core.records import MaskBit
from services.core.results import PreparedManifest
from services.core.store import open_stage
from services.preprocess.masking import valid as valid_masks
from tests.support.folder_captures import prepare, rename_camera, write_folder, write_tree
from tests.support.shared_data import shared_path


def test_incisor_imports_whole(tmp_path: Path) -> None:
    """Valid pixels are those found by ray tracing of centres and corners; images and variances keep every bit."""
    folder = shared_path("data/tooth-ur1-truth")
    manifest = prepare(folder, tmp_path, boundary="matched", dentin="known")
    published, _ = open_stage(tmp_path, "prepared", PreparedManifest)
    radiance, variance, valid = (
        zarr.open_array(published / "prepared.zarr" / name, mode="r") for name in ("radiance", "variance", "valid")
    )
    assert radiance.shape == (3, 8, 34, 28, 1)
    assert isinstance(valid.metadata, ArrayV3Metadata)
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
    stored = np.asarray(variance[0, 1, :16, :20])
    np.testing.assert_allclose(stored, (0.03 * image) ** 2 + (0.01 * image.max()) ** 2, rtol=1e-5)


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


def test_highlights_are_masked_unless_a_job_says_otherwise(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_folder(tmp_path)
    # A mask that takes every second row for highlights, given the mask of the pixels that could be one.
    monkeypatch.setattr(
        valid_masks, "highlight_mask", lambda *given: given[2] & (np.arange(len(given[2])) % 2 == 0)[:, None]
    )
    for option in (True, False):
        root = tmp_path / str(option)
        prepare(tmp_path, root, highlights=option)
        valid = np.asarray(zarr.open_array(root / "prepared" / "prepared.zarr" / "valid", mode="r"))
        assert (valid & np.uint16(MaskBit.HIGHLIGHT) > 0).any() == option


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


def test_a_camera_is_kept_from_the_fit_under_all_lights(tmp_path: Path) -> None:
    tree = write_folder(tmp_path)
    tree["images"][0]["held_out"] = True
    write_tree(tmp_path, tree)
    side = (("side", "left"), ("side", "right"))
    assert prepare(tmp_path, tmp_path / "camera", held_out_cameras=("side",)).held_out == side
    both = prepare(tmp_path, tmp_path / "both", held_out_cameras=("side",), held_out_lights=("left",)).held_out
    assert both == (("front", "left"), *side)


def test_a_camera_may_be_named_in_any_script(tmp_path: Path) -> None:
    tree = write_folder(tmp_path)
    rename_camera(tree, "Kamera 2.1 – öben")
    write_tree(tmp_path, tree)
    assert prepare(tmp_path, tmp_path / "job").cameras[0].name == "Kamera 2.1 – öben"
    assert (tmp_path / "job" / "prepared" / "quality" / "Kamera 2.1 – öben_left.png").is_file()


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
    with pytest.raises(CaptureInputError, match=r"holds neither capture\.json, raw\.toml nor a published capture"):
        prepare(tmp_path / "empty", tmp_path / "job")
    with pytest.raises(CaptureInputError, match=r"capture\.json does not exist"):
        prepare(tmp_path / "absent", tmp_path / "job")
