"""The state of a slab's fit, kept in a file: read back to the last digit, and ignored where the file is cut off or
belongs to another fit.
"""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np
import pytest

from services.slab.cell.dictionary import Material, henyey_greenstein
from services.slab.solve.checkpoint import FILE, Checkpoint, CheckpointFile, CombinedRenders
from services.slab.solve.mixture import Mixture
from services.slab.solve.normal import DerivativeSums, ResidualSums


def checkpoint(material: Material, combined: CombinedRenders | None = None) -> Checkpoint:
    noise = tuple(np.random.default_rng(k).random((4, 2, 2)) for k in range(11))
    return Checkpoint(material, 1, 2, 7, True, 12, 345_678, noise, np.arange(12.0).reshape(3, 4), combined)


def parts(one: object) -> list[np.ndarray]:
    """Every number of a record, down through the records in it."""
    if is_dataclass(one):
        return [part for field in fields(one) for part in parts(getattr(one, field.name))]
    if isinstance(one, tuple):
        return [part for each in one for part in parts(each)]
    return [] if one is None else [np.asarray(one)]


def same(one: Checkpoint, other: Checkpoint) -> bool:
    pairs = zip(parts(one), parts(other), strict=True)
    return type(one.material) is type(other.material) and all(np.array_equal(a, b) for a, b in pairs)


MEDIUM = henyey_greenstein(1.2, 0.6, 0.05)


COMBINED = CombinedRenders(
    DerivativeSums(
        np.random.default_rng(3).random((2, 8, 201)), np.random.default_rng(4).random((2, 201, 201)), (4, 5)
    ),
    ResidualSums(np.arange(8.0), np.arange(201.0), 6, -np.arange(201.0)),
    (np.arange(4.0), np.arange(3.0)),
)


@pytest.mark.parametrize("combined", [None, COMBINED])
@pytest.mark.parametrize("material", [MEDIUM, Mixture(MEDIUM.scattering, 0.05, np.array([0.1, 1.1]))])
def test_a_checkpoint_is_read_as_it_was_written(
    material: Material, combined: CombinedRenders | None, tmp_path: Path
) -> None:
    written_states: list[Checkpoint] = []
    file, written = CheckpointFile(tmp_path / "532", "mark", written_states.append), checkpoint(material, combined)
    assert file.read() is None
    file.write(written)
    read = file.read()
    assert read is not None
    assert same(read, written)
    assert written_states == [written]
    file.remove()
    assert file.read() is None


def test_a_checkpoint_of_another_fit_is_not_read(tmp_path: Path) -> None:
    CheckpointFile(tmp_path, "mark").write(checkpoint(MEDIUM))
    assert CheckpointFile(tmp_path, "other").read() is None


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.99])
def test_a_torn_file_is_not_read(share: float, tmp_path: Path) -> None:
    file = CheckpointFile(tmp_path, "mark")
    file.write(checkpoint(MEDIUM))
    content = (tmp_path / FILE).read_bytes()
    (tmp_path / FILE).write_bytes(content[: int(share * len(content))])
    assert file.read() is None
