"""A mask is the same wherever it comes from: plain grey, and everything else is refused by what it is."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from services.api.masks.images import require_mask
from services.client.errors import MaskError
from services.core.errors import CaptureInputError
from services.core.geometry import Camera
from services.core.masks import mask_path
from services.core.records import FolderCapture, MaskBit
from services.preprocess.masking.masks import HandMasks
from tests.support.shared_data import shared_path

SIZE = (40, 30)
DRAWN = np.zeros(SIZE[::-1], dtype=bool)
DRAWN[10:20, 10:30] = True
CAMERA = Camera(
    name="c0", size=SIZE, K=((50.0, 0.0, 20.0), (0.0, 50.0, 15.0), (0.0, 0.0, 1.0)),
    camera_from_world=((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0)),
)  # fmt: skip


def encoded(image: Image.Image, root: Path) -> bytes:
    image.save(root / "mask.png")
    return (root / "mask.png").read_bytes()


def palette(root: Path) -> bytes:
    image = Image.fromarray(DRAWN.astype(np.uint8), mode="P")
    image.putpalette([255, 255, 255, 10, 0, 0])
    return encoded(image, root)


def stroke(root: Path) -> bytes:
    pixels = np.zeros((*DRAWN.shape, 4), np.uint8)
    pixels[DRAWN, 3] = 255
    return encoded(Image.fromarray(pixels), root)


def bits_of(content: bytes, root: Path, camera: Camera = CAMERA) -> NDArray[np.uint16]:
    path = mask_path(root, camera.name, "all")
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content)
    described = FolderCapture(units="mm", channels=("grey",), cameras=(), lights=())
    described = described.model_copy(update={"cameras": (camera,), "lights": ()})
    return HandMasks(root, described).bits(camera.name, "L0", camera.size)


@pytest.mark.parametrize("value", [1, 128, 255])
def test_every_grey_that_is_not_black_is_excluded(value: int, tmp_path: Path) -> None:
    content = cv2.imencode(".png", (DRAWN * value).astype(np.uint8))[1].tobytes()
    require_mask(content, CAMERA)
    np.testing.assert_array_equal(bits_of(content, tmp_path) == MaskBit.MANUAL, DRAWN)


def test_one_bit_a_pixel_is_enough(tmp_path: Path) -> None:
    content = encoded(Image.fromarray(DRAWN), tmp_path)
    require_mask(content, CAMERA)
    np.testing.assert_array_equal(bits_of(content, tmp_path) == MaskBit.MANUAL, DRAWN)


REFUSED: dict[str, tuple[Callable[[Path], bytes], str]] = {
    "16-bit labels": (lambda _: cv2.imencode(".png", DRAWN.astype(np.uint16))[1].tobytes(), "it has 16 bits"),
    "a palette": (palette, "it has a palette"),
    "a transparent stroke": (stroke, "it has colours and transparency"),
    "colours": (lambda root: encoded(Image.new("RGB", SIZE), root), "it has colours"),
    "grey with alpha": (lambda root: encoded(Image.new("LA", SIZE), root), "it has transparency"),
    "another size": (lambda root: encoded(Image.new("L", SIZE[::-1]), root), "it has 30 x 40 pixels"),
    "cut off": (lambda root: encoded(Image.new("L", SIZE), root)[:-20], "it is cut off"),
    "empty": (lambda _: b"", "it is no PNG"),
    "grey with a transparent value": (
        lambda root: encoded(_with_transparency(Image.new("L", SIZE)), root), "it has transparency",
    ),
}  # fmt: skip


def _with_transparency(image: Image.Image) -> Image.Image:
    image.info["transparency"] = 0
    return image


@pytest.mark.parametrize("case", REFUSED)
def test_folder_and_server_refuse_the_same_in_the_same_words(case: str, tmp_path: Path) -> None:
    make, words = REFUSED[case]
    content = make(tmp_path)
    with pytest.raises(MaskError, match=words):
        require_mask(content, CAMERA)
    with pytest.raises(CaptureInputError, match=f"{words}.*; save it with 0"):
        bits_of(content, tmp_path)


@pytest.mark.parametrize(
    ("file", "words"),
    [
        ("grey16-label-1", "16 bits"),
        ("palette-white-bg", "a palette"),
        ("rgba-black-stroke", "transparency"),
        ("grey8-255", None),
    ],
)
def test_masks_of_strangers(file: str, words: str | None, tmp_path: Path) -> None:
    path = shared_path("data/strangers-files/masks") / f"{file}.png"
    with Image.open(path) as image:
        camera = CAMERA.model_copy(update={"size": image.size})
    if words is None:
        assert (bits_of(path.read_bytes(), tmp_path, camera) > 0).sum() == 200
        return
    with pytest.raises(CaptureInputError, match=words):
        bits_of(path.read_bytes(), tmp_path, camera)
