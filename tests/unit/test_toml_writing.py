"""Python's own TOML reader reads back a raw folder's description as it was written."""

from __future__ import annotations

import tomllib

from services.core.raw.toml_writing import description_toml


def test_what_was_written_is_read() -> None:
    tree = {
        "units": "mm",
        "camera": [{"name": 'a "b" \\ ü', "size": [4, 3], "bits": 12}, {"name": "c", "size": [1, 2], "bits": 8}],
        "scan": {"file": 'a "scan".ply', "scale": 1e-05, "is_upper": True},
        "landmark": [{"tooth": 11, "xyz_mm": [0.5, 1e-7, -2.0], "pixels": [{"camera": "c", "xy_px": [1.5, -2.0]}]}],
    }
    assert tomllib.loads(description_toml(tree).decode()) == tree


def test_what_is_none_is_left_out() -> None:
    assert tomllib.loads(description_toml({"frame": [{"light": None, "file": "x"}]}).decode()) == {
        "frame": [{"file": "x"}]
    }
