"""Location of the reference data, where this machine has them; they are not part of the project."""

from __future__ import annotations

from pathlib import Path

import pytest


def shared_path(name: str) -> Path:
    """Path below the ``shared`` folder beside the checkout; skips the test where it is absent."""
    path = Path(__file__).resolve().parents[3] / "shared" / name
    if not path.exists():
        pytest.skip(f"reference data {name} not beside the checkout")
    return path
