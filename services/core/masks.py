"""Masks by hand: what a person keeps from a job's fit. They lie beside its stages.

::

    JOB/masks/<camera>@<light>.png     names percent-encoded; light 'all' for every light of the camera

A grey PNG of the camera's size; a pixel that is not 0 is not used. Where the jaws moved between frames it is meant
where they were in the first one.
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
    """Where a job keeps the mask of a camera under a light, or under all."""
    return root / FOLDER / f"{quote(camera, safe='')}@{quote(light, safe='')}.png"


def read_masks(root: Path) -> Mapping[tuple[str, str], bytes]:
    """Every mask of a job by camera and light, as it lies on the disk.

    Raises:
        CaptureInputError: a file there is no mask by its name.
    """
    found = {}
    for path in sorted((root / FOLDER).glob("[!.]*")):
        camera, separator, light = path.stem.partition("@")
        if not separator or path.suffix != ".png":
            raise CaptureInputError(f"{path} is no mask by its name; call it CAMERA@LIGHT.png, or remove it.")
        found[unquote(camera), unquote(light)] = path.read_bytes()
    return found


def digest_of(masks: Mapping[tuple[str, str], bytes]) -> str:
    """Identifies masks by their content; empty where there are none."""
    rows = sorted((*of, hashlib.sha256(content).hexdigest()) for of, content in masks.items())
    return hashlib.sha256(json.dumps(rows).encode()).hexdigest() if rows else ""


def is_stale(root: Path) -> bool:
    """Whether the job's published preparation was made with other masks than there are now; not where it does not say,
    as it is damaged.
    """
    if not is_published(root, "prepared"):
        return False
    try:
        record = published_record(root, "prepared")
    except CorruptStoreError:
        return False
    return bool(record.get("masks", "") != digest_of(read_masks(root)))
