"""A raw folder as a capture on a server: its description is checked before the capture is accepted."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from services.api.captures.contents import content_fault
from services.api.captures.descriptions import describe
from services.client.capture_paths import require_paths
from services.core.settings import UploadLimits
from tests.support.mouth import write_mouth
from tests.support.raw_captures import write_raw_capture
from tests.support.raw_folders import Tree, write_toml
from tests.support.raw_sensor import Sensor


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Tree]:
    root = tmp_path_factory.mktemp("whole")
    write_mouth(root / "mouth", lights=2, sizes=((24, 18),))
    return root / "raw", write_raw_capture(root / "raw", root / "mouth", Sensor(), tracking=0)


def names(root: Path) -> frozenset[str]:
    return frozenset(path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file())


def test_a_raw_folder_is_a_capture(whole: tuple[Path, Tree]) -> None:
    root, _ = whole
    require_paths(names(root))
    for name in names(root):
        assert content_fault(root / name, name, UploadLimits(), names(root)) is None
    told = describe(root)
    assert [light.name for light in told.calibration.lights] == ["l0", "l1"]
    assert told.image_px == 2 * 24 * 18


def test_a_description_with_a_fault_is_refused_in_one_sentence(whole: tuple[Path, Tree], tmp_path: Path) -> None:
    root, limits = tmp_path / "raw", UploadLimits()
    shutil.copytree(whole[0], root)
    path, every = root / "raw.toml", names(root)
    lacking = every - {"c0_l1_0.05.npy"}
    assert content_fault(path, "raw.toml", limits, lacking) == (
        "raw.toml names image file c0_l1_0.05.npy, which is not among the files; add it or remove its entry."
    )
    outside = whole[1] | {"calibration": {"file": "../../etc/calibration.json"}}
    write_toml(root, outside)
    found = content_fault(path, "raw.toml", limits, every)
    assert found is not None
    assert "names calibration ../../etc/calibration.json, which is not among the files" in found
    write_toml(root, whole[1] | {"camera": [whole[1]["camera"][0] | {"size": [60000, 60000]}]})
    found = content_fault(path, "raw.toml", limits, every)
    assert found is not None
    assert "camera c0 has 60000 x 60000 pixels" in found
    write_toml(root, whole[1] | {"colour": 1})
    assert str(content_fault(path, "raw.toml", limits, every)).startswith("raw.toml: unknown key 'colour'")
