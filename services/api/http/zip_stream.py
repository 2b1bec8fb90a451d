"""A zip file that is made while it is sent. Its entries are stored without compression, in pieces, so that it takes up
neither memory nor disk.
"""

from __future__ import annotations

import io
import time
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

PIECE_BYTES = 2**18
_EARLIEST = (1980, 1, 1, 0, 0, 0)
"""Earliest time that an entry of a zip file can have: year, month, day, hour, minute, second."""


def stream_zip(root: Path, names: Iterable[str]) -> Iterator[bytes]:
    """Yield the bytes of a zip file of the named files below ``root``.

    A file that vanishes before its turn is left out; one that grows is cut at the size it had.
    """
    sink = _Sink()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_STORED) as archive:
        for name in names:
            with suppress(FileNotFoundError):
                yield from _entry(archive, sink, root / name, name)
    yield sink.take()


def _entry(archive: zipfile.ZipFile, sink: _Sink, path: Path, name: str) -> Iterator[bytes]:
    with path.open("rb") as source:
        stat = path.stat()
        info = zipfile.ZipInfo(name, max(time.gmtime(stat.st_mtime)[:6], _EARLIEST))
        info.external_attr = 0o644 << 16
        remaining_bytes = info.file_size = stat.st_size
        with archive.open(info, "w") as target:
            while piece := source.read(min(PIECE_BYTES, remaining_bytes)):
                target.write(piece)
                remaining_bytes -= len(piece)
                yield sink.take()


class _Sink(io.RawIOBase):
    """Collects written bytes until they are taken. It cannot seek, so the size and checksum of an entry follow its
    bytes.
    """

    def __init__(self) -> None:
        self._pieces = bytearray()

    def writable(self) -> bool:
        return True

    def write(self, piece: bytes) -> int:  # type: ignore[override]
        self._pieces += piece
        return len(piece)

    def take(self) -> bytes:
        """Return the bytes written since the last call."""
        taken = bytes(self._pieces)
        self._pieces.clear()
        return taken
