"""Slab folders: what is read, and the sentence for what cannot be read."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.core.errors import CaptureInputError
from services.core.slab.folder import read_folder
from services.slab.read.images import read_images, shot_noise
from tests.support.small_slab import WAVELENGTH_NM, description, write_folder

Change = Callable[[dict[str, Any]], object]


def test_images_are_folded_at_the_plane_of_the_beams(tmp_path: Path) -> None:
    image = 1e-3 * (np.arange(64.0).reshape(8, 8) + 1)
    root = write_folder(tmp_path, description(), image)
    measured = read_images(root, read_folder(root), WAVELENGTH_NM)
    assert measured.values.shape == (4, 32)
    assert measured.assumed_noise
    # The first folded row averages the two rows beside y = 0.
    np.testing.assert_allclose(measured.values[0, :8], (image[3] + image[4]) / 2)
    noise = shot_noise(image)
    np.testing.assert_allclose(measured.variances[0, :8], (noise[3] + noise[4]) / 4)


def test_an_uneven_grid_is_not_folded(tmp_path: Path) -> None:
    pixels = description()["pixels"] | {"y_mm": [-3.0, 5.0]}
    root = write_folder(tmp_path, description(pixels=pixels))
    assert read_images(root, read_folder(root), WAVELENGTH_NM).values.shape == (4, 64)


def test_a_pixel_that_is_not_finite_counts_for_nothing(tmp_path: Path) -> None:
    image = np.full((8, 8), 0.01)
    image[4, 2], image[0, 0], image[7, 0] = np.nan, np.inf, np.nan
    root = write_folder(tmp_path, description(), image)
    measured = read_images(root, read_folder(root), WAVELENGTH_NM)
    # Of the first folded pixel one half is valid, of the second nothing.
    assert measured.variances[0, 2] == pytest.approx(2 * measured.variances[0, 3])
    assert np.isinf(measured.variances[0, 24])
    assert np.isfinite(measured.values).all()


BAD: dict[str, tuple[Change, str]] = {
    "unknown key": (lambda d: d.update(colour="red"), "unknown key 'colour'; known keys are beam, cameras, cell"),
    "unknown key of the cell": (lambda d: d["cell"].update(width=1), "unknown key 'cell.width'; known keys are bo"),
    "missing key": (lambda d: d["cell"].pop("width_mm"), "'cell.width_mm' is missing; add it"),
    "another kind": (lambda d: d.update(kind="tooth"), "kind"),
    "other units": (lambda d: d.update(units="cm"), "units"),
    "no image": (lambda d: d.update(images=[]), "images"),
    "negative width": (lambda d: d["cell"].update(width_mm=-1), "cell.width_mm"),
    "index below one": (lambda d: d["cell"].update(index=0.5), "cell.index"),
    "no index": (lambda d: d["cell"].update(index=None), "give the sample's index"),
    "matched with glass": (
        lambda d: d["cell"].update(boundary="matched", glass={"index": 1.5, "thickness_mm": 1}), "has no glass",
    ),
    "disc with sigma": (lambda d: d["beam"].update(profile="disc"), "radius_mm alone"),
    "grid backwards": (lambda d: d["pixels"].update(x_mm=[4, -4]), "x_mm must go from a smaller"),
    "grazing camera": (lambda d: d["cameras"][0].update(angle_deg=90), "angle_deg"),
    "unknown kind of camera": (lambda d: d["cameras"][0].update(kind="pinhole"), "kind"),
    "perspective from nowhere": (lambda d: d["cameras"][0].update(kind="perspective"), "has a distance_mm"),
    "orthographic at a distance": (lambda d: d["cameras"][0].update(distance_mm=300), "has a distance_mm"),
    "two lights of one name": (lambda d: d["lights"][1].update(name="l0"), "light l0 is listed twice"),
    "unknown camera": (lambda d: d["images"][0].update(camera="x"), "names camera x"),
    "unknown light": (lambda d: d["images"][0].update(light="x"), "names light x"),
    "same image twice": (lambda d: d["images"].append(d["images"][0]), "is listed twice"),
    "unknown wavelength": (lambda d: d["images"][0].update(wavelength_nm=700), "wavelength_nm 700"),
    "wavelength left out": (lambda d: d.update(wavelengths_nm=[532, 633]), "has no wavelength_nm"),
    "width in micrometres": (
        lambda d: d["cell"].update(width_mm=1000), "cell.width_mm is 1000, more than 20 times the 8 mm",
    ),
    "missing file": (lambda d: d["images"][0].update(file="gone.npy"), "does not exist"),
    "file outside": (lambda d: d["images"][0].update(file="../gone.npy"), "lies outside the slab folder"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_descriptions_are_refused_by_a_sentence(tmp_path: Path, name: str) -> None:
    change, told = BAD[name]
    wrong = copy.deepcopy(description())
    change(wrong)
    root = write_folder(tmp_path, description())
    (root / "slab.json").write_text(json.dumps(wrong))
    with pytest.raises(CaptureInputError) as refused:
        read_folder(root)
    assert told in str(refused.value)
    assert "\n" not in str(refused.value)
    assert "Value error" not in str(refused.value)
    assert str(refused.value).count("; ") == 1  # one remedy


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (np.zeros((4, 4)), r"\(4, 4\) instead of floats \(8, 8\)"),
        (np.zeros((8, 8), np.int32), "int32"),
        (np.full((8, 8), np.nan), "no pixel that is finite"),
        (np.zeros((8, 8)), "holds no light: its mean is not above zero"),
        (np.full((8, 8), 50.0), r"f0_l0.npy .* no material sends more than 6\.6 there; give radiance per"),
        (b"no image", "cannot be read"),
    ],
)
def test_bad_images_are_refused_by_a_sentence(tmp_path: Path, content: Any, told: str) -> None:
    root = write_folder(tmp_path, description())
    if isinstance(content, bytes):
        (root / "f0_l0.npy").write_bytes(content)
    else:
        np.save(root / "f0_l0.npy", content)
    with pytest.raises(CaptureInputError, match=told):
        read_images(root, read_folder(root), WAVELENGTH_NM)


def test_a_folder_where_all_is_held_out_is_refused(tmp_path: Path) -> None:
    told = description()
    for entry in told["images"]:
        entry["held_out"] = True
    root = write_folder(tmp_path, told)
    with pytest.raises(CaptureInputError, match="leave some to be fitted"):
        read_images(root, read_folder(root), WAVELENGTH_NM)
