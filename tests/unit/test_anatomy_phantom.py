"""The virtual mouth is a capture folder like any other."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.anatomy.templates.incisor import build_incisor
from services.core.errors import InputError
from services.core.files.meshes import read_mesh, read_teeth, write_mesh
from services.core.records import FolderCapture
from services.core.store import read_record
from services.phantom.tooth import write_phantom

SMALL: dict[str, Any] = {"pixel_mm": 1.5, "cameras": 1, "lights": 4, "samples": 32}


def images(folder: Path) -> np.ndarray:
    capture = read_record(folder / "capture.json", FolderCapture)
    return np.stack([np.load(folder / entry.file) for entry in capture.images])


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small phantom, which nobody may change."""
    folder = tmp_path_factory.mktemp("plain")
    write_phantom(folder, **SMALL)
    return folder


def test_the_folder_is_a_complete_capture(plain: Path) -> None:
    capture = read_record(plain / "capture.json", FolderCapture)
    assert capture.channels == ("green",)
    assert [entry.held_out for entry in capture.images] == [False, False, False, True]
    (tooth,) = read_teeth(plain)
    assert tooth.dentin is not None
    width, height = capture.cameras[0].size
    for entry in capture.images:
        assert entry.variance_file is not None
        image, variance = np.load(plain / entry.file), np.load(plain / entry.variance_file)
        assert image.shape == variance.shape == (height, width, 1)
        assert image.dtype == np.float32
        assert (image >= 0).all()
        assert (variance[image > 0] > 0).all()
    pixels, depth = capture.cameras[0].project(tooth.outer.vertices_mm)
    assert (pixels > 1).all()
    assert (pixels < np.array(capture.cameras[0].size) - 1).all()
    np.testing.assert_allclose(depth, 1000, atol=10)
    truth = json.loads((plain / "truth.json").read_text())
    assert truth["channels"]["green"]["enamel"]["sigma_s_reduced"] == pytest.approx((1 - 0.8) * 0.997 * 4.5)


def test_the_same_seed_gives_the_same_images(plain: Path, tmp_path: Path) -> None:
    for seed in (1, 2):
        write_phantom(tmp_path / str(seed), **SMALL | {"seed": seed})
    assert np.array_equal(images(plain), images(tmp_path / "1"))
    assert not np.array_equal(images(plain), images(tmp_path / "2"))


def test_highlights_are_what_the_images_have_more(tmp_path: Path) -> None:
    options = SMALL | {"channels": 3, "boundary": "thin", "samples": 16, "lights": 2}
    write_phantom(tmp_path / "matte", **options)
    write_phantom(tmp_path / "glossy", **options, highlights=True)
    capture = read_record(tmp_path / "glossy/capture.json", FolderCapture)
    layer = np.stack([np.load(tmp_path / "glossy/highlights" / entry.file) for entry in capture.images])
    np.testing.assert_allclose(images(tmp_path / "glossy") - images(tmp_path / "matte"), layer, atol=1e-6)
    assert layer.max() > 0.1
    # The reflection has the light's colour, whatever the colour of the tooth.
    first = layer[0][layer[0].min(axis=-1) > 1e-3]
    np.testing.assert_allclose(first[:, 2] / first[:, 0], 0.9, rtol=1e-4)


def test_given_meshes_are_moved_to_the_origin(tmp_path: Path) -> None:
    tooth = build_incisor(24)
    for name, mesh in (("outer", tooth.outer), ("dentin", tooth.dentin)):
        write_mesh(tmp_path / f"{name}.ply", type(mesh)(mesh.vertices_mm + np.array([5.0, -3.0, 20.0]), mesh.faces))
    write_phantom(
        tmp_path / "out", **SMALL | {"lights": 1}, outer=tmp_path / "outer.ply", dentin=tmp_path / "dentin.ply", fdi=21
    )
    moved = read_mesh(tmp_path / "out/teeth/21/dentin.ply")
    np.testing.assert_allclose(np.sort(moved.vertices_mm, axis=0), np.sort(tooth.dentin.vertices_mm, axis=0), atol=1e-5)
    assert images(tmp_path / "out").max() > 0.05


def test_both_renderers_see_the_same_tooth(tmp_path: Path) -> None:
    options = SMALL | {"lights": 2, "samples": 256}
    scores = []
    for renderer in ("engine", "mitsuba"):
        write_phantom(tmp_path / renderer, **options, renderer=renderer)
    capture = read_record(tmp_path / "engine/capture.json", FolderCapture)
    for entry in capture.images:
        first, second = (np.load(tmp_path / name / entry.file).astype(float) for name in ("engine", "mitsuba"))
        noise = sum(np.load(tmp_path / name / str(entry.variance_file)).astype(float) for name in ("engine", "mitsuba"))
        halves = np.array_split(np.arange(first.shape[0]), 2)
        scores += [(first[half] - second[half]).sum() / np.sqrt(noise[half].sum()) for half in halves]
    # Four values from 16 batches on each side: |z| <= 4.5 fails at most one correct run in 2,000.
    assert len(scores) == 4
    assert np.abs(scores).max() <= 4.5


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"renderer": "mitsuba", "boundary": "thin"}, "Stock Mitsuba has no thin boundary"),
        ({"channels": 2}, "1 or 3 channels"),
        ({"highlights": True}, "no highlights"),
        ({"dentin": Path("d.ply")}, "without its enamel"),
        ({"outer": Path("o.ply"), "gums": True}, "procedural incisor only"),
        ({"fdi": 21}, "procedural incisor is tooth 11"),
        ({"outer": Path("o.ply"), "fdi": 19}, "19 is no tooth's FDI number"),
        ({"lights": 0}, "at least one camera, one light"),
    ],
)
def test_impossible_options_end_in_a_sentence(tmp_path: Path, options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        write_phantom(tmp_path / "out", **SMALL | options)
    assert not (tmp_path / "out").exists()
