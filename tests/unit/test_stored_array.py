"""A stored array reports damage as damage, and lets its readers' own errors through."""

from pathlib import Path

import numpy as np
import pytest

from services.core.errors import CorruptStoreError
from services.core.store import StoredArray, create_array, image_pieces

SHAPE = (2, 8)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    array = create_array(tmp_path, "numbers.zarr", SHAPE, (1, 8), "uint16", ("row", "column"))
    array[:] = np.arange(16, dtype=np.uint16).reshape(SHAPE)
    return tmp_path / "numbers.zarr"


def test_what_was_written_is_read(path: Path) -> None:
    np.testing.assert_array_equal(StoredArray(path)[1], np.arange(8, 16))


def test_a_missing_array_is_named(tmp_path: Path) -> None:
    with pytest.raises(CorruptStoreError, match=r"nothing\.zarr cannot be read"):
        StoredArray(tmp_path / "nothing.zarr")


def test_a_damaged_shard_is_told_when_it_is_read_and_the_rest_stays_readable(path: Path) -> None:
    shard = path / "c" / "1" / "0"
    shard.write_bytes(shard.read_bytes()[:-3])
    array = StoredArray(path)
    np.testing.assert_array_equal(array[0], np.arange(8))
    with pytest.raises(CorruptStoreError, match=r"numbers\.zarr cannot be read"):
        array[1]


def test_a_window_is_read_without_the_rest_of_its_image(tmp_path: Path) -> None:
    image = np.random.default_rng(1).integers(0, 4096, (1000, 900)).astype(np.uint16)
    chunk, shard = image_pieces(*image.shape)
    assert (chunk, shard) == ((512, 512), (1024, 1024))
    create_array(tmp_path, "image.zarr", image.shape, shard, "uint16", ("y", "x"), chunk)[:] = image
    (file,) = (tmp_path / "image.zarr" / "c").rglob("*/*")
    content = bytearray(file.read_bytes())
    # The last piece lies before the index of 4 x 16 bytes and its checksum
    content[-100] ^= 1
    file.write_bytes(content)
    array = StoredArray(tmp_path / "image.zarr")
    np.testing.assert_array_equal(array[100:512, 10:500], image[100:512, 10:500])
    with pytest.raises(CorruptStoreError):
        array[600:, 600:]


def test_an_index_beyond_the_end_is_not_called_damage(path: Path) -> None:
    with pytest.raises(IndexError):
        StoredArray(path)[7]


@pytest.mark.parametrize(
    ("selection", "kind"), [(np.s_[::0], ValueError), (np.s_[0, 0, 0], IndexError), ("row", IndexError)]
)
def test_a_selection_that_cannot_be_is_the_readers_own_error(
    path: Path, selection: object, kind: type[Exception]
) -> None:
    with pytest.raises(kind):
        StoredArray(path)[selection]
