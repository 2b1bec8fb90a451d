"""Masks as PNG: every byte counts, however it is packed, and little of it is in memory at once."""

from __future__ import annotations

import struct
import tracemalloc
import zlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from services.api.masks import masks
from services.api.masks.images import require_mask
from services.api.masks.masks import Masks
from services.client.errors import MaskError
from services.core.files.image_headers import PNG_SIGNATURE
from services.core.geometry import Camera

AHEAD = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def camera(side: int) -> Camera:
    return Camera(
        name="c0", size=(side, side), K=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), camera_from_world=AHEAD
    )


def png(side: int, *packed: bytes) -> bytes:
    """A grey PNG whose compressed pixels are in these parts."""
    parts = [
        (b"IHDR", struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0)),
        *((b"IDAT", part) for part in packed),
        (b"IEND", b""),
    ]
    return PNG_SIGNATURE + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in parts
    )


@pytest.mark.attack("uploads", "a mask that inflates a thousandfold")
def test_a_mask_that_inflates_a_thousandfold_is_checked_in_little_memory() -> None:
    side = 6000
    content = png(side, zlib.compress(bytes(side * (1 + side)), 9))
    tracemalloc.start()
    try:
        require_mask(content, camera(side))
        _, most_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(content) < side * side / 900
    assert most_bytes < 2 * 2**20


@pytest.mark.parametrize("step", [1, 7, 1000, 10**7])
@pytest.mark.parametrize("side", [511, 512, 700])
@pytest.mark.parametrize("is_noisy", [True, False])
def test_every_byte_is_counted_however_a_mask_is_cut_into_parts(side: int, step: int, is_noisy: bool) -> None:
    size = side * (1 + side)
    rows = np.random.default_rng(1).bytes(size) if is_noisy and step > 7 else bytes(size)
    for missing, told in ((0, None), (1, "less than its header declares"), (-1, "more than its header declares")):
        packed = zlib.compress(rows[: size - missing] if missing >= 0 else rows + b"\0")
        content = png(side, *(packed[at : at + step] for at in range(0, len(packed), step)))
        if told is None:
            require_mask(content, camera(side))
        else:
            with pytest.raises(MaskError, match=told):
                require_mask(content, camera(side))


@pytest.mark.attack("exhaustion", "the prepared mask of a camera of 10¹² pixels")
def test_a_prepared_mask_of_too_many_pixels_is_refused_before_any_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    manifest = SimpleNamespace(cameras=[camera(10**6)], lights=[SimpleNamespace(name="l0")])
    monkeypatch.setattr(masks, "is_published", lambda *_: True)
    monkeypatch.setattr(masks, "open_stage", lambda *_, **__: (Path(), manifest))
    monkeypatch.setattr(masks, "StoredArray", lambda _: pytest.fail("it was opened"))
    jobs, job = SimpleNamespace(present_folder=lambda _: Path()), SimpleNamespace(id="0123456789ab")
    with pytest.raises(MaskError, match=r"Camera c0 has 1000000 x 1000000 pixels, and .* bin its images\."):
        Masks(cast("Any", jobs)).prepared(cast("Any", job), "c0", "l0")
