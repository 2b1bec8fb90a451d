"""Masks drawn by hand: pixels that a person excludes from a job's fit. Their files lie beside the job's stages.

::

    JOB/masks/<camera>@<light>.png     names percent-encoded; light 'all' for every light of the camera

A mask is a grey PNG of the camera's size; its pixels that are not 0 are excluded. Where the jaws moved between frames,
a mask refers to their position in the first frame.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from urllib.parse import quote, unquote

from services.core.errors import CaptureInputError, CorruptStoreError
from services.core.store import is_published, published_record

FOLDER = "masks"
ALL_LIGHTS = "all"
LONGEST_NAME = 200


def mask_path(root: Path, camera: str, light: str) -> Path:
    """Path of a job's mask of a camera under one light, or under all lights."""
    return root / FOLDER / f"{quote(camera, safe='')}@{quote(light, safe='')}.png"


def read_masks(root: Path) -> Mapping[tuple[str, str], bytes]:
    """Read the masks of a job: (camera, light) -> content of the PNG file.

    Raises:
        CaptureInputError: a file in the folder does not have the name of a mask.
    """
    found = {}
    for path in sorted((root / FOLDER).glob("[!.]*")):
        camera, separator, light = path.stem.partition("@")
        if not separator or path.suffix != ".png":
            raise CaptureInputError(f"{path} is no mask by its name; call it CAMERA@LIGHT.png, or remove it.")
        found[unquote(camera), unquote(light)] = path.read_bytes()
    return found


def digest_of(masks: Mapping[tuple[str, str], bytes]) -> str:
    """A digest that identifies masks by camera, light and content; empty where there are no masks."""
    rows = sorted((*of, hashlib.sha256(content).hexdigest()) for of, content in masks.items())
    return hashlib.sha256(json.dumps(rows).encode()).hexdigest() if rows else ""


def is_stale(root: Path) -> bool:
    """Whether the job's published preparation was made with other masks than the present ones.

    A preparation whose record cannot be read counts as not stale.
    """
    if not is_published(root, "prepared"):
        return False
    try:
        record = published_record(root, "prepared")
    except CorruptStoreError:
        return False
    return bool(record.get("masks", "") != digest_of(read_masks(root)))
