"""Read triangle surfaces from VTK XML PolyData (.vtp): ASCII, base64 and raw data, inline or appended, uncompressed or
compressed by zlib.

Source: The VTK User's Guide, "VTK File Formats", XML file formats; the binary layout is that of vtkXMLDataParser.
"""

from __future__ import annotations

import base64
import binascii
import zlib
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from services.core.errors import CaptureInputError
from services.core.files.surface_files import require_file

NUMBER_TYPES = {
    f"{kind}{bits}": f"{letter}{bits // 8}"
    for kind, letter in (("Int", "i"), ("UInt", "u"))
    for bits in (8, 16, 32, 64)
} | {
    "Float32": "f4",
    "Float64": "f8",
}
COMPRESSOR = "vtkZLibDataCompressor"


@dataclass(frozen=True)
class PolyData:
    """Points (V, 3) in the unit of the file, triangles (F, 3), and arrays of each triangle by name, (F,) or (F,
    components).
    """

    points: NDArray[np.float64]
    triangles: NDArray[np.int32]
    cell_arrays: dict[str, NDArray[Any]]


@dataclass
class _Document:
    # The XML without the appended bytes: attributes of the file and of its pieces, and every DataArray as its section,
    # attributes and text.
    file: dict[str, str] = field(default_factory=dict)
    pieces: list[dict[str, str]] = field(default_factory=list)
    appended: dict[str, str] = field(default_factory=dict)
    arrays: list[tuple[str, dict[str, str], str]] = field(default_factory=list)


def read_polydata(path: Path) -> PolyData:
    """Read a file that holds one piece of triangles.

    Raises:
        CaptureInputError: the file is absent, truncated, of another VTK type, or has polygons that are no triangles.
    """
    require_file(path)
    try:
        return _polydata(path, path.read_bytes())
    except (expat.ExpatError, KeyError, ValueError, IndexError, zlib.error, binascii.Error) as problem:
        raise CaptureInputError(
            f"Mesh file {path} is truncated or no VTK XML file ({problem}); export it again as VTK PolyData (.vtp)."
        ) from problem


def _polydata(path: Path, content: bytes) -> PolyData:
    head, payload = _split(content)
    document = _parse(head)
    if document.file.get("type") != "PolyData":
        raise CaptureInputError(
            f"Mesh file {path} holds VTK {document.file.get('type', 'data of no type')}; export the surface as PolyData"
            " (.vtp)."
        )
    compressor = document.file.get("compressor", COMPRESSOR)
    if compressor != COMPRESSOR:
        raise CaptureInputError(
            f"Mesh file {path} is compressed by {compressor}; export it with zlib compression or none."
        )
    if len(document.pieces) != 1:
        raise CaptureInputError(f"Mesh file {path} is in {len(document.pieces)} pieces; export it as one.")

    counts = {key: int(value) for key, value in document.pieces[0].items()}
    arrays = {
        (section, attributes["Name"]): _values(attributes, text, document, payload)
        for section, attributes, text in document.arrays
    }
    (points,) = (values for (section, _), values in arrays.items() if section == "Points")
    connectivity, offsets = (arrays["Polys", name].astype(np.int64) for name in ("connectivity", "offsets"))
    if counts.get("NumberOfStrips", 0) or not np.array_equal(
        np.diff(offsets, prepend=0), np.full(counts["NumberOfPolys"], 3)
    ):
        raise CaptureInputError(
            f"Mesh file {path} holds polygons or strips besides triangles; triangulate it and export it again."
        )
    triangles = connectivity.reshape(counts["NumberOfPolys"], 3)
    points = points.astype(np.float64).reshape(counts["NumberOfPoints"], 3)
    if len(triangles) == 0:
        raise CaptureInputError(f"Mesh file {path} holds no triangle; export the surface, not a point cloud.")
    if triangles.min() < 0 or triangles.max() >= len(points):
        raise ValueError(f"a triangle names point {triangles.max()} of {len(points)}")
    cells = {name: values for (section, name), values in arrays.items() if section == "CellData"}
    for name, values in cells.items():
        if len(values) != len(triangles):
            raise ValueError(f"cell array {name} has {len(values)} values for {len(triangles)} triangles")
    return PolyData(points, triangles.astype(np.int32), cells)


def _split(content: bytes) -> tuple[bytes, bytes]:
    # Appended bytes may be raw, which no XML parser reads. They lie between the first underscore after the opening tag
    # and the last closing tag.
    opening = content.find(b"<AppendedData")
    if opening < 0:
        return content, b""
    start, end = content.index(b"_", content.index(b">", opening)) + 1, content.rfind(b"</AppendedData>")
    if end < 0:
        raise ValueError("its appended data do not end")
    return content[: start - 1] + content[end:], content[start:end]


def _parse(head: bytes) -> _Document:
    document, open_tags, text = _Document(), [""], [""]

    def start(tag: str, attributes: dict[str, str]) -> None:
        open_tags.append(tag)
        if tag == "VTKFile":
            document.file = attributes
        elif tag == "Piece":
            document.pieces.append(attributes)
        elif tag == "AppendedData":
            document.appended = attributes
        elif tag == "DataArray":
            document.arrays.append((open_tags[-2], attributes, ""))
            text[:] = []

    def end(tag: str) -> None:
        open_tags.pop()
        if tag == "DataArray":
            section, attributes, _ = document.arrays[-1]
            document.arrays[-1] = section, attributes, "".join(text)

    def refuse(*_: Any) -> None:
        raise ValueError("it declares XML entities")

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = start, end, text.append
    parser.EntityDeclHandler = refuse
    parser.Parse(head, True)
    return document


def _values(attributes: dict[str, str], text: str, document: _Document, payload: bytes) -> NDArray[Any]:
    kind, form, columns = (
        NUMBER_TYPES[attributes["type"]],
        attributes["format"],
        int(attributes.get("NumberOfComponents", 1)),
    )
    if form == "ascii":
        values = np.array(text.split(), dtype=kind)
    else:
        order = ">" if document.file.get("byte_order") == "BigEndian" else "<"
        header = order + NUMBER_TYPES[document.file.get("header_type", "UInt32")]
        encoded = form == "binary" or document.appended.get("encoding") != "raw"
        source = text.strip().encode() if form == "binary" else payload[int(attributes["offset"]) :]
        values = np.frombuffer(
            _decoded(source, header, encoded=encoded, compressed="compressor" in document.file), order + kind
        )
    return values.reshape(-1, columns) if columns > 1 else values


def _decoded(source: bytes, header: str, *, encoded: bool, compressed: bool) -> bytes:
    width, at = np.dtype(header).itemsize, 0

    def take(count: int) -> bytes:
        nonlocal at
        length = 4 * (-(-count // 3)) if encoded else count
        piece = source[at : at + length]
        data = base64.b64decode(piece, validate=True) if encoded else piece
        if len(data) < count:
            raise ValueError(f"{count} bytes are announced and {len(data)} are there")
        at += length
        return data[:count]

    def numbers(count: int) -> list[int]:
        return [int(value) for value in np.frombuffer(take(width * count), header)]

    if compressed:
        # The header holds the number of blocks, their size, the last block's size where it differs, and then the
        # compressed size of each block.
        blocks = numbers(1)[0]
        at = 0
        sizes = numbers(3 + blocks)[3:]
        data, ends = take(sum(sizes)), np.cumsum([0, *sizes])
        return b"".join(zlib.decompress(data[low:high]) for low, high in pairwise(ends))
    if encoded and not source[: 4 * (-(-width // 3))].endswith(b"="):
        # Some writers encode the length and the bytes as one stream.
        count = int(np.frombuffer(base64.b64decode(source[:16])[:width], header)[0])
        return take(width + count)[width:]
    return take(numbers(1)[0])
