"""A slab folder as a capture on a server: its description is checked before the capture is accepted."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from services.api.captures.contents import content_fault
from services.client.capture_paths import require_paths
from services.core.settings import UploadLimits
from tests.support.small_slab import description


def fault(root: Path, told: dict[str, Any], names: frozenset[str] | None = None) -> str | None:
    """What is wrong with a description beside these files; by default all files that it names are there."""
    path = root / "slab.json"
    path.write_text(json.dumps(told))
    return content_fault(
        path, "slab.json", UploadLimits(), names or frozenset(image["file"] for image in told["images"])
    )


def test_a_folder_with_a_slabs_description_is_a_capture(tmp_path: Path) -> None:
    told = description()
    require_paths(["slab.json", *(image["file"] for image in told["images"])])
    assert fault(tmp_path, told) is None


@pytest.mark.parametrize(
    ("changes", "names", "sentence"),
    [
        ({}, frozenset({"b0_l0.npy"}), "slab.json names image file f0_l0.npy, which is not among the files"),
        ({"cell": {"width_mm": 0}}, None, "slab.json: cell.width_mm: "),
        ({"glass": 1}, None, "slab.json: unknown key 'glass'; known keys are "),
        ({"pixels": description()["pixels"] | {"columns": 4096, "rows": 4096}}, None, None),
    ],
)
def test_a_description_with_a_fault_is_refused_in_one_sentence(
    tmp_path: Path,
    changes: dict[str, Any],
    names: frozenset[str] | None,
    sentence: str | None,
) -> None:
    found = fault(tmp_path, description(**changes), names)
    assert (found is None) if sentence is None else (found is not None and found.startswith(sentence))


def test_images_that_would_not_fit_into_memory_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "slab.json"
    path.write_text(json.dumps(description()))
    names = frozenset(image["file"] for image in description()["images"])
    found = content_fault(path, "slab.json", UploadLimits(largest_image_bytes=100), names)
    assert found == "slab.json has images of 8 x 8 pixels, more than 100 bytes; bin them."
