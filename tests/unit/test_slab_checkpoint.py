"""The state of a slab's fit, kept in a journal: read back to the last digit, and ignored where its file is cut off or
belongs to another fit.
"""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np
import pytest

from services.slab.cell.dictionary import Material, henyey_greenstein
from services.slab.solve.checkpoint import Checkpoint, Checkpoints, CombinedRenders
from services.slab.solve.mixture import Mixture
from services.slab.solve.normal import DerivativeSums, ResidualSums
from services.tasks.journal import Journal


def checkpoint(material: Material, combined: CombinedRenders | None = None) -> Checkpoint:
    noise = tuple(np.random.default_rng(k).random((4, 2, 2)) for k in range(11))
    return Checkpoint(material, 1, 2, 7, True, 12, 345_678, noise, np.arange(12.0).reshape(3, 4), combined)


def in_journal(folder: Path, fingerprint: str, written: list[Checkpoint] | None = None) -> Checkpoints:
    """The checkpoints in a folder's journal; each that is written is appended to ``written``."""
    return Checkpoints(Journal(folder / "journal.jsonl", fingerprint), ([] if written is None else written).append)


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
    checkpoints, written = in_journal(tmp_path, "mark", written_states), checkpoint(material, combined)
    assert checkpoints.read() is None
    checkpoints.write(written)
    read = in_journal(tmp_path, "mark").read()
    assert read is not None
    assert same(read, written)
    assert written_states == [written]


def test_only_the_newest_state_is_kept(tmp_path: Path) -> None:
    checkpoints = in_journal(tmp_path, "mark")
    for material in (MEDIUM, henyey_greenstein(2.4, 0.6, 0.05)):
        checkpoints.write(checkpoint(material))
    assert len(list(tmp_path.glob("*.npz"))) == 1
    read = in_journal(tmp_path, "mark").read()
    assert read is not None
    assert same(read, checkpoint(henyey_greenstein(2.4, 0.6, 0.05)))


def test_a_checkpoint_of_another_fit_is_not_read(tmp_path: Path) -> None:
    in_journal(tmp_path, "mark").write(checkpoint(MEDIUM))
    assert in_journal(tmp_path, "other").read() is None


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.99])
def test_torn_arrays_are_set_aside_with_a_word_and_written_again(share: float, tmp_path: Path) -> None:
    in_journal(tmp_path, "mark").write(checkpoint(MEDIUM))
    (file,) = tmp_path.glob("*.npz")
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))])
    again = in_journal(tmp_path, "mark")
    assert again.read() is None
    assert again.journal.notes == [f"{file.name} is missing or altered; what it held is computed again."]
    again.write(checkpoint(MEDIUM))
    assert file.read_bytes() == content
    assert in_journal(tmp_path, "mark").read() is not None


def test_a_checkpoint_of_version_0_1_0_begins_anew(tmp_path: Path) -> None:
    (tmp_path / "steps.npz").write_bytes(b"PK")
    checkpoints = in_journal(tmp_path, "mark")
    assert checkpoints.read() is None
    assert checkpoints.journal.notes == []
